"""Drive a car off a ramp, keep it level in flight and land it on its wheels inside the garage.

A car with a motor on each wheel has 1.5 m of road and a ramp of 3 m in which to gain speed, flies
over a gap of 6 m on a small planet (5 m/s² of gravity), and has to roll to the back of a garage.
Solved when the body of the car touches the garage's back wall. Failed when it touches the wall
behind the start, the ground, or the floor or roof of the garage: only wheels may touch these.

What makes it dynamic: speed decides where the car comes down, and is decided on the ramp; the
front wheels leave the ramp first, and the car begins to pitch forward. In flight two pairs of jets
turn the car, strongly, and nothing holds it level: the noise of every action must be corrected by
the next ones until the wheels are down.

Time constant: from level in flight, one pair of jets at full power pitches the car by 0.6 rad in
0.30 s (9 control steps), measured. A solved episode takes about 75 control steps, 8 of these.

| observation | unit | range |
| --- | --- | --- |
| car.position.x, y | m, a third of it | −10 to 10 |
| car.velocity.vx, vy | m/s, a third of it | −10 to 10 |
| car.angle.cos | 1, twice the cosine | −2 to 2 |
| car.angle.sin | 1, twice the sine | −2 to 2 |
| car.angular_velocity | rad/s | −10 to 10 |
| rear_wheel.angular_velocity | rad/s, a tenth of it | −10 to 10 |
| front_wheel.angular_velocity | rad/s, a tenth of it | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| drive | fraction of 40 rad/s of both wheels | −1 to 1 |
| nose_up | fraction of 7 N at each end | 0 to 1 |
| nose_down | fraction of 7 N at each end | 0 to 1 |

Angles count from level, anticlockwise. Jets may fire together; then they cancel.
"""

from __future__ import annotations

import math

from rtc_cli.tasks.scene import (
    Action,
    Along,
    Body,
    Box,
    Circle,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Polygon,
    Role,
    Scene,
    Thruster,
    Vec,
)

GRAVITY = 5.0  # m/s²
CAR_LENGTH = 1.4
CAR_HEIGHT = 0.22
CAR_KG = 2.0
WHEEL_RADIUS = 0.2
WHEEL_X = 0.42  # m from the car's middle
WHEEL_KG = 0.25
DRIVE_RATE = 40.0  # rad/s
DRIVE_TORQUE = 3.0  # N·m per wheel
JET_N = 7.0
JET_X = 0.5  # m from the car's middle
WALL_X = -1.5
RAMP_X = 1.5  # where the ramp begins
RAMP_LENGTH = 3.0
RAMP_SLOPE = 0.35  # rad
GARAGE_X = 10.2  # its entrance
GARAGE_DEPTH = 2.4
FLOOR_Y = 0.25  # of the garage
ROOF_Y = 1.45
GROUND_Y = -0.75

_CAR = 1  # collision group: car and wheels do not touch each other
_GRIP = 1.5  # friction of wheels and road, each
_RIDE_Y = WHEEL_RADIUS + 0.08  # m from the road to the car's middle
_RAMP_END: Vec = (
    RAMP_X + RAMP_LENGTH * math.cos(RAMP_SLOPE),
    RAMP_LENGTH * math.sin(RAMP_SLOPE),
)
_BACK_X = GARAGE_X + GARAGE_DEPTH


def _surroundings() -> tuple[Body, ...]:
    end_x, end_y = _RAMP_END
    road = Box(
        width=RAMP_X - WALL_X, height=0.3, offset=((RAMP_X + WALL_X) / 2, -0.15), friction=_GRIP
    )
    ramp = Polygon(
        vertices=((RAMP_X, -0.3), (end_x, -0.3), (end_x, end_y), (RAMP_X, 0.0)), friction=_GRIP
    )
    middle = GARAGE_X + GARAGE_DEPTH / 2
    hazards = (
        Box(width=0.2, height=1.2, offset=(WALL_X, 0.5), role=Role.HAZARD),
        Box(
            width=GARAGE_X - end_x,
            height=0.3,
            offset=((GARAGE_X + end_x) / 2, GROUND_Y - 0.15),
            role=Role.HAZARD,
        ),
        Box(width=GARAGE_DEPTH, height=1.0, offset=(middle, FLOOR_Y - 0.5), role=Role.HAZARD),
        Box(width=GARAGE_DEPTH, height=1.0, offset=(middle, ROOF_Y + 0.5), role=Role.HAZARD),
    )
    back = Box(width=0.2, height=ROOF_Y - FLOOR_Y, role=Role.TARGET)
    place = (_BACK_X + 0.1, (FLOOR_Y + ROOF_Y) / 2)
    return (
        Body(name="road", static=True, shapes=(road, ramp)),
        Body(name="hazards", static=True, shapes=hazards),
        Body(name="garage", static=True, position=place, shapes=(back,)),
    )


def _wheel(name: str, side: int) -> Body:
    tyre = Circle(
        radius=WHEEL_RADIUS,
        density=WHEEL_KG / (math.pi * WHEEL_RADIUS**2),
        friction=_GRIP,
        group=_CAR,
    )
    return Body(name=name, position=(side * WHEEL_X, WHEEL_RADIUS), shapes=(tyre,))


def _car() -> tuple[Body, ...]:
    box = Box(
        width=CAR_LENGTH,
        height=CAR_HEIGHT,
        density=CAR_KG / (CAR_LENGTH * CAR_HEIGHT),
        role=Role.GOAL,
        group=_CAR,
    )
    return (
        Body(name="car", position=(0.0, _RIDE_Y), shapes=(box,)),
        _wheel("rear_wheel", -1),
        _wheel("front_wheel", 1),
    )


def _jets(action: str, up: float) -> tuple[Thruster, Thruster]:
    """A jet at each end, in opposite directions: they turn the car and do not push it."""
    front, rear = (
        Thruster(
            body="car",
            action=action,
            max_force=JET_N,
            point=(side * JET_X, 0.0),
            direction=(0.0, side * up),
        )
        for side in (1, -1)
    )
    return front, rear


def _drive(wheel: str) -> Motor:
    # From wheel to car, so that a positive action turns the wheel clockwise: to the right.
    return Motor(a=wheel, b="car", action="drive", max_rate=DRIVE_RATE, max_torque=DRIVE_TORQUE)


SCENE = Scene(
    name="car_launch",
    description=__doc__ or "",
    gravity=(0.0, -GRAVITY),
    bodies=(*_surroundings(), *_car()),
    joints=(
        Pivot(a="car", b="rear_wheel", anchor=(-WHEEL_X, WHEEL_RADIUS)),
        Pivot(a="car", b="front_wheel", anchor=(WHEEL_X, WHEEL_RADIUS)),
    ),
    motors=(_drive("rear_wheel"), _drive("front_wheel")),
    actions=(
        Action(name="drive"),
        Action(name="nose_up", low=0.0),
        Action(name="nose_down", low=0.0),
    ),
    thrusters=(*_jets("nose_up", 1.0), *_jets("nose_down", -1.0)),
    observations=(
        Observe(kind="position", body="car", scale=3.0),
        Observe(kind="velocity", body="car", scale=3.0),
        Observe(kind="angle", body="car", scale=0.5),
        Observe(kind="angular_velocity", body="car"),
        Observe(kind="angular_velocity", body="rear_wheel", scale=10.0),
        Observe(kind="angular_velocity", body="front_wheel", scale=10.0),
    ),
    progress_terms=(
        Along(
            observation="car.position",
            points=((0.0, 0.3), (_RAMP_END[0], 1.5), (GARAGE_X + 1.2, 0.8)),
        ),
    ),
    jitters=(
        Jitter(
            bodies=("car", "rear_wheel", "front_wheel"),
            position=(0.4, 0.0),
            velocity=(0.5, 0.0),
        ),
    ),
    bounds=(-3.0, -3.0, _BACK_X + 3.0, 8.0),
    view=(-1.8, -1.0, _BACK_X + 0.4, 2.6),
)
