"""Bounce a ball along a room on a trampoline cart, to the plate at the far end.

A cart with a thruster on each side slides without friction on a rail and carries a bed on which a
ball bounces, a hand's breadth high. The bed is hinged on the cart, and the motor that levels it is
a rough one: the noise of its action (σ = 0.1, as everywhere) is as large as its largest command.
Solved when the ball touches the plate, 3.5 m to the right. Failed when the ball falls on the floor
beside the bed or touches the wall behind the start.

What makes it dynamic: every bounce sends the ball off in a direction that the noise of the last
few steps has decided, and 0.3 s later the bed must be where the ball comes down. Nothing can be
predicted before the bounce and there is little time after it: delay costs information here.

Time constant: none in the usual sense, no mode grows by itself. What counts is the flight from one
bounce to the next, 9 or 10 control steps. In 9 steps a cart at rest gets 0.13 m far, in 5 only
0.04 m. The first bounce on a bed that nobody levels changes the ball's speed along the rail by
0.36 m/s (standard deviation), which is 0.12 m by the next one. All measured. A solved episode takes
about 60 control steps, which is 6 flights.

| observation | unit | range |
| --- | --- | --- |
| cart.relative_position.ball.dx, dy | m, in units of 0.2 m, ball minus cart | −10 to 10 |
| ball.velocity.vx, vy | m/s | −10 to 10 |
| cart.vx | m/s | −10 to 10 |
| ball.x | m | −10 to 10 |
| bed.angle.cos | 1, twice the cosine | −2 to 2 |
| bed.angle.sin | 1, twice the sine | −2 to 2 |

| action | unit | range |
| --- | --- | --- |
| push_right | fraction of 4 N | 0 to 1 |
| push_left | fraction of 4 N | 0 to 1 |
| tilt | fraction of 25 rad/s | −0.1 to 0.1 |

Angles count from level, anticlockwise. The bed's own speed is not observed: its motor holds it at
what the last action asked for.
"""

from __future__ import annotations

import math

from rtc_cli.tasks.carts import side_thrusters
from rtc_cli.tasks.scene import (
    NOTHING,
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
)

TARGET_X = 3.5
WALL_X = -1.0
FLOOR_Y = -0.35  # m below the bed
BED_WIDTH = 0.6
BED_LIMIT = 0.25  # rad to either side
TILT_RATE = 25.0  # rad/s that an action of 1 would ask for
TILT_RANGE = 0.1  # no more than the action noise
CART_WIDTH = 0.3
CART_KG = 1.0
BED_KG = 0.3
THRUST_N = 4.0
BALL_RADIUS = 0.08
BALL_KG = 0.05
DROP = 0.1  # m from which the ball falls, and to which it bounces
SPEED = 0.6  # m/s of the ball to the right, at the start

_RAIL_Y = -0.1


def _surroundings() -> tuple[Body, ...]:
    middle, length = (TARGET_X + WALL_X) / 2, TARGET_X - WALL_X + 0.2
    floor = Box(width=length, height=0.1, offset=(middle, FLOOR_Y - 0.05), role=Role.HAZARD)
    height = 1.0 - FLOOR_Y
    wall = Box(width=0.1, height=height, offset=(WALL_X, FLOOR_Y + height / 2), role=Role.HAZARD)
    plate = Box(width=0.1, height=height, role=Role.TARGET)
    return (
        Body(name="room", static=True, shapes=(floor, wall)),
        Body(name="plate", static=True, position=(TARGET_X, FLOOR_Y + height / 2), shapes=(plate,)),
    )


def _moving() -> tuple[Body, ...]:
    frame = Box(width=CART_WIDTH, height=0.1, density=CART_KG / (0.1 * CART_WIDTH), mask=NOTHING)
    bed = Box(
        width=BED_WIDTH,
        height=0.06,
        offset=(0.0, -0.03),
        density=BED_KG / (0.06 * BED_WIDTH),
        restitution=1.0,
        friction=0.0,
    )
    ball = Circle(
        radius=BALL_RADIUS,
        density=BALL_KG / (math.pi * BALL_RADIUS**2),
        restitution=1.0,
        role=Role.GOAL,
    )
    return (
        Body(name="cart", position=(0.0, _RAIL_Y), rotates=False, shapes=(frame,)),
        Body(name="bed", shapes=(bed,)),
        Body(
            name="ball", position=(0.0, BALL_RADIUS + DROP), velocity=(SPEED, 0.0), shapes=(ball,)
        ),
    )


SCENE = Scene(
    name="trampoline",
    description=__doc__ or "",
    bodies=(*_surroundings(), *_moving()),
    joints=(
        Groove(
            a=WORLD,
            b="cart",
            start=(-4.0, _RAIL_Y),
            end=(TARGET_X + 4.0, _RAIL_Y),
            anchor=(0.0, _RAIL_Y),
        ),
        Pivot(a="cart", b="bed", anchor=(0.0, 0.0), limits=(-BED_LIMIT, BED_LIMIT)),
    ),
    motors=(Motor(a="cart", b="bed", action="tilt", max_rate=TILT_RATE, max_torque=50.0),),
    actions=(
        Action(name="push_right", low=0.0),
        Action(name="push_left", low=0.0),
        Action(name="tilt", low=-TILT_RANGE, high=TILT_RANGE),
    ),
    thrusters=side_thrusters("cart", CART_WIDTH / 2, THRUST_N),
    observations=(
        Observe(kind="relative_position", body="cart", other="ball", scale=0.2),
        Observe(kind="velocity", body="ball"),
        Observe(kind="vx", body="cart"),
        Observe(kind="x", body="ball"),
        Observe(kind="angle", body="bed", scale=0.5),
    ),
    progress_terms=(Distance(observation="ball.x", target=(TARGET_X,)),),
    jitters=(
        Jitter(bodies=("cart", "bed"), position=(0.05, 0.0)),
        Jitter(bodies=("ball",), position=(0.05, 0.02), velocity=(0.1, 0.1)),
    ),
    view=(WALL_X - 0.2, FLOOR_Y - 0.15, TARGET_X + 0.2, 1.0),
)
