"""Fly a lander on two engines through a cave and set the load on its chain down on the pad.

A hull with an engine under each side carries a ball on a chain of two links, hung in the middle of
the hull. Solved when ball or hull touches the pad, a block on the floor 6.4 m to the right. Failed
when either touches the floor, the ceiling, the wall behind the start or the wall behind the pad.

What makes it dynamic: nothing holds the hull level. To move sideways it must tilt, a tilt grows
into a fall, and the difference of the two engines turns the hull strongly. The load swings below
and pulls after the hull has moved; it may pass under the ceiling and over the floor by less than a
metre, and the hull has to come down by as much before the pad and no more.

Time constant: from level, one engine alone at full power tilts the hull by 0.6 rad in 0.27 s (8
control steps), measured. A solved episode takes about 55 control steps, 7 of these.

| observation | unit | range |
| --- | --- | --- |
| hull.position.x, y | m | −10 to 10 |
| hull.velocity.vx, vy | m/s | −10 to 10 |
| hull.angle.cos, sin | 1 | −1 to 1 |
| hull.angular_velocity | rad/s | −10 to 10 |
| link.angle.cos, sin | 1 | −1 to 1 |
| link.angular_velocity | rad/s | −10 to 10 |
| load.angle.cos, sin | 1 | −1 to 1 |
| load.angular_velocity | rad/s | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| left_engine | fraction of 10 N | 0 to 1 |
| right_engine | fraction of 10 N | 0 to 1 |

The hull's angle counts from level, those of the upper link and of the load (the lower link with
the ball) from hanging straight down; all anticlockwise.
"""

from __future__ import annotations

import math

from rtc_cli.tasks.scene import (
    Action,
    Body,
    Box,
    Circle,
    Distance,
    Jitter,
    Observe,
    Pivot,
    Role,
    Scene,
    Shape,
    Thruster,
)

HULL_WIDTH = 0.8
HULL_HEIGHT = 0.22
HULL_KG = 1.0
ENGINE_X = 0.12  # m from the hull's middle
THRUST_N = 10.0
LINK_LENGTH = 0.4
LINK_KG = 0.05
BALL_RADIUS = 0.13
BALL_KG = 0.3
CEILING_Y = 1.0
FLOOR_Y = -2.0
WALL_X = -1.4
PAD_X = 7.0
PAD_WIDTH = 1.2
PAD_Y = -1.3  # its top

_END_X = PAD_X + PAD_WIDTH / 2 + 0.3
_CRAFT = 1  # collision group: hull and chain do not touch each other


def _surroundings() -> tuple[Body, ...]:
    middle, level = (_END_X + WALL_X) / 2, (CEILING_Y + FLOOR_Y) / 2
    length, height = _END_X - WALL_X + 0.2, CEILING_Y - FLOOR_Y + 0.4
    cave = (
        Box(width=length, height=0.2, offset=(middle, CEILING_Y + 0.1), role=Role.HAZARD),
        Box(width=length, height=0.2, offset=(middle, FLOOR_Y - 0.1), role=Role.HAZARD),
        Box(width=0.2, height=height, offset=(WALL_X, level), role=Role.HAZARD),
        Box(width=0.2, height=height, offset=(_END_X, level), role=Role.HAZARD),
    )
    pad = Box(width=PAD_WIDTH, height=PAD_Y - FLOOR_Y, role=Role.TARGET)
    return (
        Body(name="cave", static=True, shapes=cave),
        Body(name="pad", static=True, position=(PAD_X, (PAD_Y + FLOOR_Y) / 2), shapes=(pad,)),
    )


def _link(name: str, top: float, *ball: Shape) -> Body:
    """A link that hangs from (0, top); its role is none, so that only the ball counts."""
    bar = Box(
        width=0.05,
        height=LINK_LENGTH,
        offset=(0.0, -LINK_LENGTH / 2),
        density=LINK_KG / (0.05 * LINK_LENGTH),
        group=_CRAFT,
    )
    return Body(name=name, position=(0.0, top), shapes=(bar, *ball))


def _craft() -> tuple[Body, ...]:
    hull = Box(
        width=HULL_WIDTH,
        height=HULL_HEIGHT,
        density=HULL_KG / (HULL_WIDTH * HULL_HEIGHT),
        role=Role.GOAL,
        group=_CRAFT,
    )
    ball = Circle(
        radius=BALL_RADIUS,
        offset=(0.0, -LINK_LENGTH),
        density=BALL_KG / (math.pi * BALL_RADIUS**2),
        role=Role.GOAL,
        group=_CRAFT,
    )
    return (
        Body(name="hull", shapes=(hull,)),
        _link("link", 0.0),
        _link("load", -LINK_LENGTH, ball),
    )


def _engine(action: str, side: int) -> Thruster:
    point = (side * ENGINE_X, -HULL_HEIGHT / 2)
    return Thruster(body="hull", action=action, max_force=THRUST_N, point=point)


SCENE = Scene(
    name="chain_lander",
    description=__doc__ or "",
    bodies=(*_surroundings(), *_craft()),
    joints=(
        Pivot(a="hull", b="link", anchor=(0.0, 0.0)),
        Pivot(a="link", b="load", anchor=(0.0, -LINK_LENGTH)),
    ),
    actions=(Action(name="left_engine", low=0.0), Action(name="right_engine", low=0.0)),
    thrusters=(_engine("left_engine", -1), _engine("right_engine", 1)),
    observations=(
        Observe(kind="position", body="hull"),
        Observe(kind="velocity", body="hull"),
        Observe(kind="angle", body="hull"),
        Observe(kind="angular_velocity", body="hull"),
        Observe(kind="angle", body="link"),
        Observe(kind="angular_velocity", body="link"),
        Observe(kind="angle", body="load"),
        Observe(kind="angular_velocity", body="load"),
    ),
    progress_terms=(
        Distance(
            observation="hull.position", target=(PAD_X, PAD_Y + BALL_RADIUS + 2 * LINK_LENGTH)
        ),
    ),
    jitters=(
        Jitter(bodies=("hull", "link", "load"), position=(0.2, 0.2), velocity=(0.25, 0.25)),
        Jitter(bodies=("hull",), angle=0.1),
        Jitter(bodies=("link", "load"), angle=0.2, pivot=(0.0, 0.0)),
    ),
)
