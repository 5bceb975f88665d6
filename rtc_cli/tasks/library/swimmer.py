"""Swim a chain of three links to a float, pushed by a screw and steered by bending.

Three links in a row, with motors at the two joints, lie in a pool seen from above: no gravity, and
water that takes away speed. A screw at the end of the tail pushes along the tail; the angle of the
joints turns the chain, and nothing else does. Solved when any link touches the float, 3.6 m ahead
and 2.4 m to the left. Failed when a link touches a wall of the pool.

What makes it dynamic: the screw pushes from behind, the chain turns only while it swims, and a
bend of the joints stays until a motor takes it back. A bend on its own would move the chain
nowhere: the water slows all directions alike, so that no stroke can push it off.

Time constant: nothing is unstable. Without thrust speed and turning fall by e in 0.53 s (16 control
steps), measured. A solved episode takes about 125 control steps. It is meant as the suite's
negative control, on which an action that is 0.13 s old is nearly as good as a fresh one; how near
is in the results.

| observation | unit | range |
| --- | --- | --- |
| head.relative_position.float.dx, dy | m | −10 to 10 |
| head.velocity.vx, vy | m/s | −10 to 10 |
| head.angle.cos, sin | 1 | −1 to 1 |
| head.angular_velocity | rad/s | −10 to 10 |
| head.relative_angle.middle.cos, sin | 1 | −1 to 1 |
| middle.relative_angle.tail.cos, sin | 1 | −1 to 1 |

| action | unit | range |
| --- | --- | --- |
| screw | fraction of 0.8 N | 0 to 1 |
| bend_neck | fraction of 0.85 rad/s | −1 to 1 |
| bend_tail | fraction of 0.85 rad/s | −1 to 1 |

Angles count anticlockwise from ahead. The joints' own speed is not observed: the motors hold it at
what the last action asked for.
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
    Thruster,
)

LINK_LENGTH = 0.3
LINK_WIDTH = 0.12
LINK_KG = 0.1
TARGET = (3.6, 2.4)
TARGET_RADIUS = 0.34
SCREW_N = 0.8
JOINT_RATE = 0.85  # rad/s
JOINT_TORQUE = 0.3  # N·m
JOINT_LIMIT = 0.35  # rad
DAMPING = 0.15  # share of the speed that is left after a second without thrust

POOL = (-2.0, -2.0, 6.0, 5.0)  # m, left, bottom, right, top: inner edges of the walls

_CHAIN = 1  # collision group: the links do not touch each other
_LINKS = ("head", "middle", "tail")


def _walls() -> tuple[Box, ...]:
    left, bottom, right, top = POOL
    middle, width, height = ((left + right) / 2, (bottom + top) / 2), right - left, top - bottom
    return (
        Box(width=0.1, height=height + 0.2, offset=(left - 0.05, middle[1]), role=Role.HAZARD),
        Box(width=0.1, height=height + 0.2, offset=(right + 0.05, middle[1]), role=Role.HAZARD),
        Box(width=width, height=0.1, offset=(middle[0], bottom - 0.05), role=Role.HAZARD),
        Box(width=width, height=0.1, offset=(middle[0], top + 0.05), role=Role.HAZARD),
    )


def _link(index: int) -> Body:
    shape = Box(
        width=LINK_LENGTH,
        height=LINK_WIDTH,
        density=LINK_KG / (LINK_LENGTH * LINK_WIDTH),
        role=Role.GOAL,
        group=_CHAIN,
    )
    return Body(name=_LINKS[index], position=(-index * LINK_LENGTH, 0.0), shapes=(shape,))


def _joint(index: int) -> Pivot:
    anchor = (-(index + 0.5) * LINK_LENGTH, 0.0)
    limits = (-JOINT_LIMIT, JOINT_LIMIT)
    return Pivot(a=_LINKS[index], b=_LINKS[index + 1], anchor=anchor, limits=limits)


def _motor(action: str, index: int) -> Motor:
    return Motor(
        a=_LINKS[index],
        b=_LINKS[index + 1],
        action=action,
        max_rate=JOINT_RATE,
        max_torque=JOINT_TORQUE,
    )


SCENE = Scene(
    name="swimmer",
    description=__doc__ or "",
    bodies=(
        Body(
            name="float",
            static=True,
            position=TARGET,
            shapes=(Circle(radius=TARGET_RADIUS, role=Role.TARGET),),
        ),
        Body(name="pool", static=True, shapes=_walls()),
        *(_link(i) for i in range(3)),
    ),
    joints=(_joint(0), _joint(1)),
    motors=(_motor("bend_neck", 0), _motor("bend_tail", 1)),
    actions=(
        Action(name="screw", low=0.0),
        Action(name="bend_neck"),
        Action(name="bend_tail"),
    ),
    thrusters=(
        Thruster(
            body="tail",
            action="screw",
            max_force=SCREW_N,
            point=(-LINK_LENGTH / 2, 0.0),
            direction=(1.0, 0.0),
        ),
    ),
    observations=(
        Observe(kind="relative_position", body="head", other="float"),
        Observe(kind="velocity", body="head"),
        Observe(kind="angle", body="head"),
        Observe(kind="angular_velocity", body="head"),
        Observe(kind="relative_angle", body="head", other="middle"),
        Observe(kind="relative_angle", body="middle", other="tail"),
    ),
    progress_terms=(Distance(observation="head.relative_position.float"),),
    jitters=(Jitter(bodies=_LINKS, position=(0.4, 0.4), angle=0.35),),
    progress_scale=1.0,
    gravity=(0.0, 0.0),
    damping=DAMPING,
    view=(POOL[0] - 0.1, POOL[1] - 0.1, POOL[2] + 0.1, POOL[3] + 0.1),
)
