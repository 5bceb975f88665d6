"""Ride a unicycle under a tall mast to a far target without letting the mast fall.

A wheel rolls on the ground; a mast with a weight on its top stands on the wheel's axle and falls by
itself. The only drive is a motor between the two, so that whatever turns the wheel pushes the mast
the other way. Solved when the mast or its weight touches the target, which hangs where an upright
mast passes, 6 m to the right. Failed when either touches the ground or the barrier behind the
start.

What makes it dynamic: upright is unstable, and the motor is too weak to bring back a mast that
leans far. To get going the wheel must first roll to the left, so that the mast leans to the right,
and then run under a mast that it lets fall on purpose. There is no standing still: a motor that
asks for no speed is a brake, and brakes throw the rider.

Time constant: a tilt of the mast grows by e in 0.37 s (11 control steps), measured on the way from
0.06 to 0.35 rad with the motor taken out and the wheel free to roll. A solved episode takes about
95 control steps, which is 9 time constants.

| observation | unit | range |
| --- | --- | --- |
| mast.x | m, of its top | −10 to 10 |
| mast.y | m, of its top | −10 to 10 |
| mast.velocity.vx, vy | m/s | −10 to 10 |
| mast.angle.cos | 1, twice the cosine | −2 to 2 |
| mast.angle.sin | 1, twice the sine | −2 to 2 |
| mast.angular_velocity | rad/s | −10 to 10 |
| wheel.angular_velocity | rad/s, a fifth of it | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| pedal | fraction of 14 rad/s between wheel and mast | −1 to 1 |

Angles count from upright, anticlockwise; pedalling forward rolls to the right. The motor gives at
most 4 N·m until the speed asked for is reached.
"""

from __future__ import annotations

from rtc_cli.tasks.scene import (
    Action,
    Body,
    Box,
    Circle,
    Distance,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Role,
    Scene,
)

WHEEL_RADIUS = 0.3
MAST_LENGTH = 2.2
TARGET_X = 6.0
BARRIER_X = -1.3
PEDAL_RATE = 14.0  # rad/s
PEDAL_TORQUE = 4.0  # N·m

_AXLE = (0.0, WHEEL_RADIUS)
_TOP_Y = WHEEL_RADIUS + MAST_LENGTH
_RIDER = 1  # collision group: wheel and mast do not touch each other
_GRIP = 1.2  # friction of wheel and ground, each


def _post(name: str, x: float, height: float, role: Role) -> Body:
    """A bar that hangs at the height of the mast's top."""
    bar = Box(width=0.12, height=height, role=role)
    return Body(name=name, static=True, position=(x, _TOP_Y + 0.1), shapes=(bar,))


def _bodies() -> tuple[Body, ...]:
    # A hazard for the mast only: the wheel has no role.
    middle = TARGET_X / 2
    ground = Box(
        width=TARGET_X + 8, height=0.2, offset=(middle, -0.1), friction=_GRIP, role=Role.HAZARD
    )
    wheel = Circle(radius=WHEEL_RADIUS, density=2.0, friction=_GRIP, group=_RIDER)
    rod = Box(
        width=0.07,
        height=MAST_LENGTH,
        offset=(0.0, -MAST_LENGTH / 2),
        density=2.0,
        role=Role.GOAL,
        group=_RIDER,
    )
    weight = Circle(radius=0.14, density=4.0, role=Role.GOAL, group=_RIDER)
    return (
        Body(name="ground", static=True, shapes=(ground,)),
        _post("target", TARGET_X, 0.5, Role.TARGET),
        _post("barrier", BARRIER_X, 0.6, Role.HAZARD),
        Body(name="wheel", position=_AXLE, shapes=(wheel,)),
        # The origin is the top: progress is then made by the top. Were it made by the wheel, to
        # let the mast fall backwards would pay.
        Body(name="mast", position=(0.0, _TOP_Y), shapes=(rod, weight)),
    )


SCENE = Scene(
    name="unicycle",
    description=__doc__ or "",
    bodies=_bodies(),
    joints=(Pivot(a="wheel", b="mast", anchor=_AXLE),),
    motors=(
        # From wheel to mast, so that a positive action turns the wheel clockwise: to the right.
        Motor(a="wheel", b="mast", action="pedal", max_rate=PEDAL_RATE, max_torque=PEDAL_TORQUE),
    ),
    actions=(Action(name="pedal"),),
    observations=(
        Observe(kind="x", body="mast"),
        Observe(kind="y", body="mast"),
        Observe(kind="velocity", body="mast"),
        Observe(kind="angle", body="mast", scale=0.5),
        Observe(kind="angular_velocity", body="mast"),
        Observe(kind="angular_velocity", body="wheel", scale=5.0),
    ),
    progress_terms=(
        Distance(observation="mast.x", target=(TARGET_X,)),
        # Without it experts learn to fall forward ever faster, which ends at the motor's speed.
        Distance(observation="mast.y", target=(_TOP_Y,), weight=3.0),
    ),
    jitters=(
        Jitter(bodies=("wheel", "mast"), position=(0.1, 0.0)),
        Jitter(bodies=("mast",), angle=0.05, angular_velocity=0.1, pivot=_AXLE),
    ),
    view=(-1.9, -0.25, TARGET_X + 1.2, _TOP_Y + 0.6),
)
