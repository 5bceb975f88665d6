"""Throw a ball with a long arm, and have the basket under it when it comes down.

A motor at its foot swings an arm of 2.5 m over, against a stop shortly before upright. A ball lies
in a cup at the arm's end and flies on. A basket, little wider than the ball, is pushed along a rail
with viscous friction by a thruster on each side. Solved when the ball touches the basket. Failed
when the ball falls on the ground.

What makes it dynamic: the arm's motor follows its command at once, and the noise of its action (σ =
0.1, as everywhere) is almost half of the largest command. The ball leaves the cup where the arm
jerks back, at a speed that the noise of the last few steps has decided. Where it will come down is
not known before, and soon after it is there: delay costs information here. What the basket did
meanwhile matters little, for the rail takes its speed away.

Time constant: the basket's speed decays by e in 0.25 s (7.5 control steps). What counts is the
flight: at full swing the ball comes down 9 control steps after it left the cup, at 0.77 m from the
arm's foot, give or take 0.26 m (means, standard deviation). In 9 steps a basket at rest gets 0.40 m
far, in 5 only 0.14 m. All measured. A solved episode takes about 60 control steps.

| observation | unit | range |
| --- | --- | --- |
| arm.angle.cos, sin | 1 | −1 to 1 |
| arm.angular_velocity | rad/s | −10 to 10 |
| ball.position.x, y | m | −10 to 10 |
| ball.velocity.vx, vy | m/s, in units of 2 m/s | −10 to 10 |
| basket.relative_position.ball.dx, dy | m, ball minus basket | −10 to 10 |
| basket.vx | m/s | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| swing | fraction of 8 rad/s | 0 to 0.22 |
| push_right | fraction of 14 N | 0 to 1 |
| push_left | fraction of 14 N | 0 to 1 |

The arm's angle counts from pointing right, anticlockwise; it starts a little below pointing left,
and a positive swing turns it clockwise.
"""

from __future__ import annotations

import math

from rtc_cli.tasks.carts import rail_friction, side_thrusters
from rtc_cli.tasks.scene import (
    WORLD,
    Action,
    Body,
    Box,
    Circle,
    Distance,
    Groove,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Role,
    Scene,
    Vec,
)

ARM_LENGTH = 2.5
ARM_KG = 2.0
ARM_START = math.pi + 0.5  # rad from pointing right
ARM_STOP = 1.75
SWING_RATE = 8.0  # rad/s that an action of 1 would ask for
SWING_RANGE = 0.22  # little more than twice the action noise
SWING_TORQUE = 60.0  # N·m
CUP_DEPTH = 0.16
BALL_RADIUS = 0.08
BALL_KG = 0.1
BASKET_Y = 1.9
BASKET_WIDTH = 0.2
BASKET_KG = 1.0
BASKET_X = 1.2
BASKET_JITTER = 0.45  # m to either side
RAIL_START = 0.2  # m to the right of the arm's foot: the basket cannot meet the ball in the cup
THRUST_N = 14.0
DRAG = 4.0  # N·s/m
GROUND_Y = -1.8

_BALL, _ARM, _GROUND = 1, 2, 4  # collision categories: all touch the ball and nothing else
_THICK = 0.06


def _placed(point: Vec) -> Vec:
    """World coordinates of a point of the arm at its start."""
    c, s = math.cos(ARM_START), math.sin(ARM_START)
    return (c * point[0] - s * point[1], s * point[0] + c * point[1])


def _arm() -> Body:
    """A beam along +x of its body, with the cup's walls at its end on the −y side, which leads."""
    beam = Box(
        width=ARM_LENGTH,
        height=_THICK,
        offset=(ARM_LENGTH / 2, 0.0),
        density=ARM_KG / (ARM_LENGTH * _THICK),
        friction=0.8,
        category=_ARM,
        mask=_BALL,
    )
    walls = tuple(
        Box(
            width=0.05,
            height=CUP_DEPTH,
            offset=(x, -(_THICK + CUP_DEPTH) / 2),
            density=0.5,
            friction=0.3,
            category=_ARM,
            mask=_BALL,
        )
        for x in (ARM_LENGTH - 2 * BALL_RADIUS - 0.09, ARM_LENGTH - 0.02)
    )
    return Body(name="arm", angle=ARM_START, shapes=(beam, *walls))


def _bodies() -> tuple[Body, ...]:
    ground = Box(
        width=14.0, height=0.1, offset=(2.0, GROUND_Y - 0.05), role=Role.HAZARD, category=_GROUND
    )
    ball = Circle(
        radius=BALL_RADIUS,
        density=BALL_KG / (math.pi * BALL_RADIUS**2),
        friction=0.5,
        role=Role.GOAL,
        category=_BALL,
    )
    basket = Box(
        width=BASKET_WIDTH,
        height=0.08,
        density=BASKET_KG / (0.08 * BASKET_WIDTH),
        role=Role.TARGET,
        category=_ARM,
        mask=_BALL,
    )
    in_cup = _placed((ARM_LENGTH - BALL_RADIUS - 0.055, -_THICK / 2 - BALL_RADIUS - 0.005))
    return (
        Body(name="ground", static=True, shapes=(ground,)),
        _arm(),
        Body(name="ball", position=in_cup, shapes=(ball,)),
        Body(name="basket", position=(BASKET_X, BASKET_Y), rotates=False, shapes=(basket,)),
    )


SCENE = Scene(
    name="catapult",
    description=__doc__ or "",
    bodies=_bodies(),
    joints=(
        Pivot(a=WORLD, b="arm", anchor=(0.0, 0.0), limits=(ARM_STOP, ARM_START)),
        Groove(
            a=WORLD,
            b="basket",
            start=(RAIL_START, BASKET_Y),
            end=(6.0, BASKET_Y),
            anchor=(BASKET_X, BASKET_Y),
        ),
        rail_friction("basket", (BASKET_X, BASKET_Y), DRAG),
    ),
    motors=(
        Motor(a=WORLD, b="arm", action="swing", max_rate=-SWING_RATE, max_torque=SWING_TORQUE),
    ),
    actions=(
        Action(name="swing", low=0.0, high=SWING_RANGE),
        Action(name="push_right", low=0.0),
        Action(name="push_left", low=0.0),
    ),
    thrusters=side_thrusters("basket", BASKET_WIDTH / 2, THRUST_N),
    observations=(
        Observe(kind="angle", body="arm"),
        Observe(kind="angular_velocity", body="arm"),
        Observe(kind="position", body="ball"),
        Observe(kind="velocity", body="ball", scale=2.0),
        Observe(kind="relative_position", body="basket", other="ball"),
        Observe(kind="vx", body="basket"),
    ),
    progress_terms=(Distance(observation="basket.relative_position.ball"),),
    jitters=(Jitter(bodies=("basket",), position=(BASKET_JITTER, 0.0), velocity=(0.2, 0.0)),),
    view=(-3.0, GROUND_Y - 0.15, 3.6, 3.2),
)
