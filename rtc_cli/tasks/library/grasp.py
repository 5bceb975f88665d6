"""Catch a ball between two fingers that point upwards, hold it, and carry it to the plate.

Two fingers, each on a motor, form a V on a cart; the cart runs on a rail with viscous friction and
has a thruster on each side. A ball falls on a tilting flap, which hits it off to the right and down
to the hand. Solved when the ball touches the plate, 5 m to the right. Failed when it falls on the
floor or touches the wall behind the start.

What makes it dynamic: the flap wanders with the noise of its weak motor, and its tilt tells more
and more precisely where it will send the ball. From there the ball is at the hand so soon that the
hand must have followed the flap all along, with a cart that starts and stops slowly.

Time constant: the cart's speed decays by e in 0.33 s (10 control steps), measured. From flap to
fingertips the ball takes 6 control steps (median) and comes down 0.3 to 1.9 m to the right (5% to
95%); in 6 steps a cart at rest gets 0.32 m far, in 2 only 0.03 m, measured too. A hand that does
not move catches the ball in 33% of the episodes. A solved episode takes about 58 control steps.

| observation | unit | range |
| --- | --- | --- |
| ball.position.x, y | m | −10 to 10 |
| ball.velocity.vx, vy | m/s | −10 to 10 |
| cart.relative_position.ball.dx, dy | m, ball minus cart | −10 to 10 |
| cart.vx | m/s | −10 to 10 |
| left_finger.angle.cos, sin | 1 | −1 to 1 |
| right_finger.angle.cos, sin | 1 | −1 to 1 |
| flap.angle.cos | 1, twice the cosine | −2 to 2 |
| flap.angle.sin | 1, twice the sine | −2 to 2 |

| action | unit | range |
| --- | --- | --- |
| push_right | fraction of 22 N | 0 to 1 |
| push_left | fraction of 22 N | 0 to 1 |
| left_finger | fraction of 4 rad/s | −1 to 1 |
| right_finger | fraction of 4 rad/s | −1 to 1 |
| flap | fraction of 30 rad/s | −0.1 to 0.1 |

Angles count anticlockwise, a finger's from upright, the flap's from level. The fingers' and the
flap's speeds are not observed: the motors hold them at what the last action asked for.
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
    Segment,
    Spring,
)

TARGET_X = 5.0
WALL_X = -1.0
FLOOR_Y = -0.3
HAND_X = 0.75  # m to the right of the flap, at the start
HAND_JITTER = 0.45  # m to either side
CART_KG = 0.8
THRUST_N = 22.0
DRAG = 3.0  # N·s/m
FINGER_LENGTH = 0.24
FINGER_KG = 0.1
FINGER_OPEN = 0.8  # rad from upright, at the start
FINGER_LIMITS = (0.2, 1.2)  # rad from upright
FINGER_RATE = 4.0  # rad/s
FINGER_TORQUE = 3.0  # N·m
FLAP_LENGTH = 0.6
FLAP_TILT = -1.1  # rad from level
FLAP_LIMIT = 0.35  # rad to either side
FLAP_RATE = 30.0  # rad/s that an action of 1 would ask for
FLAP_RANGE = 0.1  # no more than the action noise
BALL_RADIUS = 0.08
BALL_KG = 0.1
DROP = 1.0  # m from the ball to the flap
FALL = 0.45  # m from the flap down to the tips of the fingers

_KNUCKLE = (0.05, 0.05)  # of the right finger, from the middle of the cart
_FLAP_Y = _KNUCKLE[1] + FINGER_LENGTH * math.cos(FINGER_OPEN) + FALL
_BALL, _HAND, _ROOM = 1, 2, 4  # collision categories: the hand meets nothing but the ball


def _surroundings() -> tuple[Body, ...]:
    top = _FLAP_Y + 0.9
    middle, length = (TARGET_X + WALL_X) / 2, TARGET_X - WALL_X + 0.2
    floor = Box(
        width=length, height=0.1, offset=(middle, FLOOR_Y - 0.05), role=Role.HAZARD, category=_ROOM
    )
    wall = Box(
        width=0.1,
        height=top - FLOOR_Y,
        offset=(WALL_X, (top + FLOOR_Y) / 2),
        role=Role.HAZARD,
        category=_ROOM,
    )
    plate = Box(width=0.1, height=1.3, role=Role.TARGET, category=_ROOM)
    return (
        Body(name="room", static=True, shapes=(floor, wall)),
        Body(name="plate", static=True, position=(TARGET_X, FLOOR_Y + 0.65), shapes=(plate,)),
    )


def _finger(name: str, side: int) -> Body:
    """A finger that leans outwards; its body's +y runs along it."""
    bone = Segment(
        start=(0.0, 0.0),
        end=(0.0, FINGER_LENGTH),
        radius=0.02,
        density=FINGER_KG / (0.04 * FINGER_LENGTH),
        friction=0.5,
        category=_HAND,
        mask=_BALL,
    )
    place = (HAND_X + side * _KNUCKLE[0], _KNUCKLE[1])
    return Body(name=name, position=place, angle=-side * FINGER_OPEN, shapes=(bone,))


def _moving() -> tuple[Body, ...]:
    frame = Box(
        width=0.3,
        height=0.1,
        density=CART_KG / 0.03,
        friction=0.5,
        category=_HAND,
        mask=_BALL,
    )
    flap = Box(
        width=FLAP_LENGTH,
        height=0.05,
        density=0.3 / (0.05 * FLAP_LENGTH),
        restitution=1.0,
        friction=0.0,
        category=_ROOM,
    )
    ball = Circle(
        radius=BALL_RADIUS,
        density=BALL_KG / (math.pi * BALL_RADIUS**2),
        friction=0.5,
        restitution=1.0,
        role=Role.GOAL,
        category=_BALL,
    )
    return (
        Body(name="cart", position=(HAND_X, 0.0), rotates=False, shapes=(frame,)),
        _finger("left_finger", -1),
        _finger("right_finger", 1),
        Body(name="flap", position=(0.0, _FLAP_Y), angle=FLAP_TILT, shapes=(flap,)),
        Body(name="ball", position=(0.0, _FLAP_Y + DROP + BALL_RADIUS + 0.03), shapes=(ball,)),
    )


def _joints() -> tuple[Pivot | Groove | Spring, ...]:
    knuckles = {side: (HAND_X + side * _KNUCKLE[0], _KNUCKLE[1]) for side in (-1, 1)}
    closed, opened = FINGER_LIMITS
    return (
        Groove(
            a=WORLD, b="cart", start=(-2.0, 0.0), end=(TARGET_X + 4.0, 0.0), anchor=(HAND_X, 0.0)
        ),
        rail_friction("cart", (HAND_X, 0.0), DRAG),
        Pivot(a="cart", b="left_finger", anchor=knuckles[-1], limits=(closed, opened)),
        Pivot(a="cart", b="right_finger", anchor=knuckles[1], limits=(-opened, -closed)),
        Pivot(
            a=WORLD,
            b="flap",
            anchor=(0.0, _FLAP_Y),
            limits=(FLAP_TILT - FLAP_LIMIT, FLAP_TILT + FLAP_LIMIT),
        ),
    )


def _knuckle(finger: str) -> Motor:
    return Motor(a="cart", b=finger, action=finger, max_rate=FINGER_RATE, max_torque=FINGER_TORQUE)


SCENE = Scene(
    name="grasp",
    description=__doc__ or "",
    bodies=(*_surroundings(), *_moving()),
    joints=_joints(),
    motors=(
        _knuckle("left_finger"),
        _knuckle("right_finger"),
        Motor(a=WORLD, b="flap", action="flap", max_rate=FLAP_RATE, max_torque=50.0),
    ),
    actions=(
        Action(name="push_right", low=0.0),
        Action(name="push_left", low=0.0),
        Action(name="left_finger"),
        Action(name="right_finger"),
        Action(name="flap", low=-FLAP_RANGE, high=FLAP_RANGE),
    ),
    thrusters=side_thrusters("cart", 0.15, THRUST_N),
    observations=(
        Observe(kind="position", body="ball"),
        Observe(kind="velocity", body="ball"),
        Observe(kind="relative_position", body="cart", other="ball"),
        Observe(kind="vx", body="cart"),
        Observe(kind="angle", body="left_finger"),
        Observe(kind="angle", body="right_finger"),
        Observe(kind="angle", body="flap", scale=0.5),
    ),
    progress_terms=(Distance(observation="ball.position", target=(TARGET_X, 0.4)),),
    jitters=(
        Jitter(bodies=("cart", "left_finger", "right_finger"), position=(HAND_JITTER, 0.0)),
        Jitter(bodies=("ball",), position=(0.02, 0.03)),
    ),
    view=(WALL_X - 0.2, FLOOR_Y - 0.15, TARGET_X + 0.2, _FLAP_Y + DROP + 0.25),
)
