"""Balance a cup on a falling stem and be under the ball when it comes down.

A cart with a thruster on each side slides without friction on a rail. A stem that carries a cup is
hinged on it and falls by itself. A ball rolls down a ramp for two seconds, leaves it, and falls.
Solved when the ball touches the bottom of the cup. Failed when the stem touches a spike on the
cart, 0.7 rad to either side, when the ball falls on the ground or on a spike, or when the stem
touches a barrier far out.

What makes it dynamic: control decides, not prediction. The way of the ball is the same in every
episode but for a jitter of its first speed; where it will come down can be read off long before.
But the cup stands on a stem that falls all the time, with spikes near it, and at the moment of the
catch it must be in the right place and level enough to let the ball in.

Time constant: a tilt of the stem grows by e in 0.38 s (11 control steps), measured with thrusters
off. A solved episode takes 75 control steps, because the ball decides; that is 7 time constants.

| observation | unit | range |
| --- | --- | --- |
| cart.x | m | −10 to 10 |
| cart.vx | m/s | −10 to 10 |
| stem.angle.cos | 1, twice the cosine | −2 to 2 |
| stem.angle.sin | 1, twice the sine | −2 to 2 |
| stem.angular_velocity | rad/s | −10 to 10 |
| cart.relative_position.ball.dx, dy | m, ball minus cart | −10 to 10 |
| ball.velocity.vx, vy | m/s | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| push_right | fraction of 6 N | 0 to 1 |
| push_left | fraction of 6 N | 0 to 1 |

Angles count from upright, anticlockwise. Thrusters may fire together; then they cancel.
"""

from __future__ import annotations

import math

import numpy as np

from rtc_cli.tasks.carts import side_thrusters
from rtc_cli.tasks.scene import (
    NOTHING,
    WORLD,
    Action,
    Body,
    Box,
    Circle,
    Distance,
    FloatArray,
    Groove,
    Jitter,
    Observe,
    Pivot,
    Polygon,
    Role,
    Scene,
    Segment,
)

CART_WIDTH = 0.9
CART_HEIGHT = 0.3
STEM_LENGTH = 2.0
CUP_WIDTH = 1.0
SPIKE_ANGLE = 0.7  # rad between the upright stem and the tip of a spike
SPIKE_REACH = 0.55  # m from the hinge to the tip of a spike
BARRIER_X = 3.2
THRUST_N = 6.0
RAMP_LENGTH = 2.6
RAMP_SLOPE = 0.2  # rad
RAMP_END_X = -0.7
BALL_RADIUS = 0.11
LANDING_X = 0.55  # m, where the ball passes the height of the cup

_HINGE_Y = CART_HEIGHT / 2
_CUP_Y = _HINGE_Y + STEM_LENGTH
_RAMP_END_Y = _CUP_Y + 1.8
_PARTS = 1  # collision group of what is fixed to the cart


def _spike(side: int) -> Polygon:
    """A hazard on the cart that leaves the stem SPIKE_ANGLE to fall to one side."""
    tip = (side * SPIKE_REACH * math.sin(SPIKE_ANGLE), SPIKE_REACH * math.cos(SPIKE_ANGLE))
    inner, outer = (side * 0.25, CART_HEIGHT / 2), (side * 0.45, CART_HEIGHT / 2)
    corners = (inner, outer, tip) if side > 0 else (outer, inner, tip)
    return Polygon(vertices=corners, role=Role.HAZARD, density=0.5, group=_PARTS)


def _surroundings() -> tuple[Body, ...]:
    ground = Box(width=10.0, height=0.04, offset=(0.0, -0.04), role=Role.HAZARD)
    barriers = tuple(
        Box(width=0.1, height=0.6, offset=(side * BARRIER_X, _CUP_Y + 0.15), role=Role.HAZARD)
        for side in (-1, 1)
    )
    ramp = Segment(
        start=_on_ramp(RAMP_LENGTH), end=(RAMP_END_X, _RAMP_END_Y), radius=0.03, friction=1.0
    )
    return (
        Body(name="ground", static=True, shapes=(ground, *barriers)),
        Body(name="ramp", static=True, shapes=(ramp,)),
    )


def _on_ramp(distance: float, above: float = 0.0) -> tuple[float, float]:
    """The point `distance` up the ramp from its end, `above` its middle line."""
    c, s = math.cos(RAMP_SLOPE), math.sin(RAMP_SLOPE)
    return (RAMP_END_X - distance * c + above * s, _RAMP_END_Y + distance * s + above * c)


def _cup() -> tuple[Box, ...]:
    """A bottom, which is the target, between two rims that lean outwards."""
    bottom = Box(
        width=CUP_WIDTH,
        height=0.06,
        offset=(0.0, STEM_LENGTH + 0.03),
        density=2.0,
        friction=0.3,
        role=Role.TARGET,
    )
    rims = tuple(
        Box(
            width=0.05,
            height=0.22,
            offset=(side * (CUP_WIDTH / 2 + 0.02), STEM_LENGTH + 0.11),
            angle=-0.3 * side,
            density=2.0,
            friction=0.1,
        )
        for side in (-1, 1)
    )
    return (bottom, *rims)


def _moving() -> tuple[Body, ...]:
    box = Box(width=CART_WIDTH, height=CART_HEIGHT, density=3.7, group=_PARTS, mask=NOTHING)
    rod = Box(
        width=0.06, height=STEM_LENGTH, offset=(0.0, STEM_LENGTH / 2), density=2.0, role=Role.GOAL
    )
    ball = Circle(radius=BALL_RADIUS, density=1.5, friction=1.0, role=Role.GOAL)
    start = (0.0, _HINGE_Y)
    return (
        Body(name="cart", position=start, rotates=False, shapes=(box, _spike(1), _spike(-1))),
        Body(name="stem", position=start, shapes=(rod, *_cup())),
        Body(name="ball", position=_on_ramp(RAMP_LENGTH - 0.2, BALL_RADIUS + 0.03), shapes=(ball,)),
    )


SCENE = Scene(
    name="catcher",
    description=__doc__ or "",
    bodies=(*_surroundings(), *_moving()),
    joints=(
        Groove(
            a=WORLD,
            b="cart",
            start=(-5.0, _HINGE_Y),
            end=(5.0, _HINGE_Y),
            anchor=(0.0, _HINGE_Y),
        ),
        Pivot(a="cart", b="stem", anchor=(0.0, _HINGE_Y), collide=True),
    ),
    actions=(Action(name="push_right", low=0.0), Action(name="push_left", low=0.0)),
    thrusters=side_thrusters("cart", CART_WIDTH / 2, THRUST_N),
    observations=(
        Observe(kind="x", body="cart"),
        Observe(kind="vx", body="cart"),
        Observe(kind="angle", body="stem", scale=0.5),
        Observe(kind="angular_velocity", body="stem"),
        Observe(kind="relative_position", body="cart", other="ball"),
        Observe(kind="velocity", body="ball"),
    ),
    progress_terms=(
        Distance(observation="cart.relative_position.ball", target=(0.0, STEM_LENGTH)),
    ),
    jitters=(
        Jitter(bodies=("cart", "stem"), position=(0.1, 0.0)),
        Jitter(bodies=("stem",), angle=0.05, angular_velocity=0.1),
        Jitter(bodies=("ball",), velocity=(0.03, 0.0)),
    ),
    view=(-3.6, -0.15, 3.6, _RAMP_END_Y + 0.9),
)


def controller(obs: FloatArray) -> FloatArray:
    """Feedback written by hand: observations (n, 9) -> actions (n, 2).

    Linear feedback that balances the stem over the place where the ball will come down; the gains
    are a linear-quadratic regulator's for the linearised cart and stem.
    """
    place, speed, sine, spin = obs[:, 0], obs[:, 1], 0.5 * obs[:, 3], obs[:, 4]
    push = 2.0 * (place - LANDING_X) + 3.0 * speed - 21.0 * sine - 8.8 * spin
    return np.stack([push, -push], axis=1).clip(0.0, 1.0).astype(np.float32)
