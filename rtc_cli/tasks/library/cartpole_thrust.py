"""Carry a pole upright on a cart to a far target, with two thrusters and no brakes.

A cart slides without friction on a rail and is pushed by a thruster on each side. A pole with a
ball on its top is hinged on it and falls by itself. Solved when the pole touches the target, which
hangs where the top of an upright pole passes, 4 m to the right. Failed when the pole touches one
of the two spikes on the cart, 0.6 rad to either side, or the barrier behind the start.

What makes it dynamic: upright is unstable, and the spikes are always near. To get going the cart
must first drive to the left, so that the pole leans to the right, and then stay under a pole that
it lets fall on purpose. A stale push is a push the wrong way.

Time constant: a tilt grows by e in 0.37 s (11 control steps), measured with thrusters off. A
solved episode takes about 85 control steps, which is 8 time constants.

| observation | unit | range |
| --- | --- | --- |
| cart.x | m | −10 to 10 |
| cart.vx | m/s | −10 to 10 |
| pole.angle.cos | 1, twice the cosine | −2 to 2 |
| pole.angle.sin | 1, twice the sine | −2 to 2 |
| pole.angular_velocity | rad/s | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| push_right | fraction of 10 N | 0 to 1 |
| push_left | fraction of 10 N | 0 to 1 |

Angles count from upright, anticlockwise. Thrusters may fire together; then they cancel.
"""

from __future__ import annotations

import math

import numpy as np

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
    Thruster,
)

CART_WIDTH = 0.9
CART_HEIGHT = 0.3
POLE_LENGTH = 2.0
SPIKE_ANGLE = 0.6  # rad between the upright pole and the tip of a spike
SPIKE_REACH = 0.6  # m from the hinge to the tip of a spike
TARGET_X = 4.0
BARRIER_X = -1.3
THRUST_N = 10.0

_HINGE_Y = CART_HEIGHT / 2
_TOP_Y = _HINGE_Y + POLE_LENGTH + 0.15
_PARTS = 1  # collision group of what is fixed to the cart


def _spike(side: int) -> Polygon:
    """A hazard on the cart that leaves the pole SPIKE_ANGLE to fall to one side."""
    tip = (side * SPIKE_REACH * math.sin(SPIKE_ANGLE), SPIKE_REACH * math.cos(SPIKE_ANGLE))
    inner, outer = (side * 0.25, CART_HEIGHT / 2), (side * 0.45, CART_HEIGHT / 2)
    corners = (inner, outer, tip) if side > 0 else (outer, inner, tip)
    return Polygon(vertices=corners, role=Role.HAZARD, density=0.5, group=_PARTS)


def _post(name: str, x: float, height: float, role: Role) -> Body:
    """A bar that hangs at the height of the pole's top."""
    bar = Box(width=0.12, height=height, offset=(0.0, _TOP_Y), role=role)
    return Body(name=name, static=True, position=(x, 0.0), shapes=(bar,))


def _bodies() -> tuple[Body, ...]:
    rail = Box(width=TARGET_X + 8, height=0.04, offset=(TARGET_X / 2, -0.04))
    box = Box(width=CART_WIDTH, height=CART_HEIGHT, density=3.7, group=_PARTS, mask=NOTHING)
    rod = Box(
        width=0.06, height=POLE_LENGTH, offset=(0, POLE_LENGTH / 2), density=2.0, role=Role.GOAL
    )
    ball = Circle(radius=0.12, offset=(0, POLE_LENGTH), density=3.0, role=Role.GOAL)
    start = (0.0, _HINGE_Y)
    return (
        Body(name="rail", static=True, shapes=(rail,)),
        _post("target", TARGET_X, 0.5, Role.TARGET),
        _post("barrier", BARRIER_X, 0.6, Role.HAZARD),
        Body(name="cart", position=start, rotates=False, shapes=(box, _spike(1), _spike(-1))),
        Body(name="pole", position=start, shapes=(rod, ball)),
    )


SCENE = Scene(
    name="cartpole_thrust",
    description=__doc__ or "",
    bodies=_bodies(),
    joints=(
        Groove(
            a=WORLD,
            b="cart",
            start=(-4.0, _HINGE_Y),
            end=(TARGET_X + 4, _HINGE_Y),
            anchor=(0.0, _HINGE_Y),
        ),
        Pivot(a="cart", b="pole", anchor=(0.0, _HINGE_Y), collide=True),
    ),
    actions=(Action(name="push_right", low=0.0), Action(name="push_left", low=0.0)),
    thrusters=(
        Thruster(
            body="cart",
            action="push_right",
            max_force=THRUST_N,
            point=(-CART_WIDTH / 2, 0.0),
            direction=(1.0, 0.0),
        ),
        Thruster(
            body="cart",
            action="push_left",
            max_force=THRUST_N,
            point=(CART_WIDTH / 2, 0.0),
            direction=(-1.0, 0.0),
        ),
    ),
    observations=(
        Observe(kind="x", body="cart"),
        Observe(kind="vx", body="cart"),
        Observe(kind="angle", body="pole", scale=0.5),
        Observe(kind="angular_velocity", body="pole"),
    ),
    progress_terms=(Distance(observation="cart.x", target=(TARGET_X,)),),
    jitters=(
        Jitter(bodies=("cart", "pole"), position=(0.1, 0.0)),
        Jitter(bodies=("pole",), angle=0.05, angular_velocity=0.1),
    ),
    view=(-1.8, -0.15, TARGET_X + 1.2, _TOP_Y + 0.45),
)


def controller(obs: FloatArray) -> FloatArray:
    """Feedback written by hand: observations (n, 5) -> actions (n, 2).

    The speed wanted sets the lean wanted, and the lean sets the push.
    """
    speed, sine, spin = obs[:, 1], 0.5 * obs[:, 3], obs[:, 4]
    lean = np.clip(0.25 * (speed - 3.0), -0.25, 0.25)
    push = -5.0 * (sine - lean) - 1.5 * spin
    return np.stack([push, -push], axis=1).clip(0.0, 1.0).astype(np.float32)
