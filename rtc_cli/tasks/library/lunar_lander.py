"""Fly a lander on two engines through a corridor of hazards to the pad at its end.

A hull with an engine under each side and two legs on motors hovers in a corridor that is 2 m high.
Solved when hull or leg touches the pad, 7.5 m to the right. Failed when either touches the floor,
the ceiling or the wall behind the start.

What makes it dynamic: nothing holds the hull level. To move sideways it must tilt, a tilt grows
into a fall, and the difference of the two engines turns the hull so strongly that the noise of
every action must be corrected by the next ones. Swinging the legs turns the hull the other way.

Time constant: from level, one engine alone at full power tilts the hull by 0.6 rad, far enough to
lose the corridor, in 0.23 s (7 control steps), measured. A solved episode takes about 55 control
steps, 8 of these.

| observation | unit | range |
| --- | --- | --- |
| hull.position.x, y | m | −10 to 10 |
| hull.velocity.vx, vy | m/s | −10 to 10 |
| hull.angle.cos, sin | 1 | −1 to 1 |
| hull.angular_velocity | rad/s | −10 to 10 |
| hull.relative_angle.left_leg.cos, sin | 1 | −1 to 1 |
| hull.relative_angle.right_leg.cos, sin | 1 | −1 to 1 |

| action | unit | range |
| --- | --- | --- |
| left_engine | fraction of 8 N | 0 to 1 |
| right_engine | fraction of 8 N | 0 to 1 |
| left_leg | fraction of 4 rad/s | −1 to 1 |
| right_leg | fraction of 4 rad/s | −1 to 1 |

Angles count from level, anticlockwise; a leg's from straight down. The legs' own speed is not
observed: the motors hold it at what the last action asked for.
"""

from __future__ import annotations

import numpy as np

from rtc_cli.tasks.scene import (
    Action,
    Body,
    Box,
    Distance,
    FloatArray,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Role,
    Scene,
    Thruster,
)

HALF_HEIGHT = 1.0  # m from the corridor's middle to floor and ceiling
PAD_X = 7.5
WALL_X = -1.4
HULL_WIDTH = 0.7
HULL_HEIGHT = 0.25
HULL_KG = 1.0
LEG_LENGTH = 0.34
LEG_KG = 0.05
THRUST_N = 8.0
ENGINE_X = 0.2  # m from the hull's middle
LEG_RATE = 4.0  # rad/s
LEG_TORQUE = 0.6  # N·m

_HIP = (HULL_WIDTH / 2 - 0.06, -HULL_HEIGHT / 2)
_CRAFT = 1  # collision group: the parts of the lander do not touch each other


def _leg(name: str, side: int) -> Body:
    shape = Box(
        width=0.07,
        height=LEG_LENGTH,
        offset=(0.0, -LEG_LENGTH / 2),
        density=LEG_KG / (0.07 * LEG_LENGTH),
        role=Role.GOAL,
        group=_CRAFT,
    )
    return Body(name=name, position=(side * _HIP[0], _HIP[1]), shapes=(shape,))


def _bodies() -> tuple[Body, ...]:
    middle, length = PAD_X / 2 + WALL_X / 2, PAD_X - WALL_X + 0.2
    level = HALF_HEIGHT + 0.1
    walls = (
        Box(width=length, height=0.2, offset=(middle, -level), role=Role.HAZARD),
        Box(width=length, height=0.2, offset=(middle, level), role=Role.HAZARD),
        Box(width=0.2, height=2 * level + 0.2, offset=(WALL_X, 0.0), role=Role.HAZARD),
    )
    pad = Box(width=0.15, height=2 * HALF_HEIGHT, role=Role.TARGET)
    hull = Box(
        width=HULL_WIDTH,
        height=HULL_HEIGHT,
        density=HULL_KG / (HULL_WIDTH * HULL_HEIGHT),
        role=Role.GOAL,
        group=_CRAFT,
    )
    return (
        Body(name="corridor", static=True, shapes=walls),
        Body(name="pad", static=True, position=(PAD_X, 0.0), shapes=(pad,)),
        Body(name="hull", shapes=(hull,)),
        _leg("left_leg", -1),
        _leg("right_leg", 1),
    )


def _engine(action: str, side: int) -> Thruster:
    point = (side * ENGINE_X, -HULL_HEIGHT / 2)
    return Thruster(body="hull", action=action, max_force=THRUST_N, point=point)


def _motor(leg: str) -> Motor:
    return Motor(a="hull", b=leg, action=leg, max_rate=LEG_RATE, max_torque=LEG_TORQUE)


SCENE = Scene(
    name="lunar_lander",
    description=__doc__ or "",
    bodies=_bodies(),
    joints=(
        Pivot(a="hull", b="left_leg", anchor=(-_HIP[0], _HIP[1]), limits=(-0.9, 0.3)),
        Pivot(a="hull", b="right_leg", anchor=_HIP, limits=(-0.3, 0.9)),
    ),
    motors=(_motor("left_leg"), _motor("right_leg")),
    actions=(
        Action(name="left_engine", low=0.0),
        Action(name="right_engine", low=0.0),
        Action(name="left_leg"),
        Action(name="right_leg"),
    ),
    thrusters=(_engine("left_engine", -1), _engine("right_engine", 1)),
    observations=(
        Observe(kind="position", body="hull"),
        Observe(kind="velocity", body="hull"),
        Observe(kind="angle", body="hull"),
        Observe(kind="angular_velocity", body="hull"),
        Observe(kind="relative_angle", body="hull", other="left_leg"),
        Observe(kind="relative_angle", body="hull", other="right_leg"),
    ),
    progress_terms=(Distance(observation="hull.position", target=(PAD_X, 0.0)),),
    jitters=(
        Jitter(
            bodies=("hull", "left_leg", "right_leg"),
            position=(0.1, 0.1),
            angle=0.05,
            velocity=(0.05, 0.05),
        ),
    ),
)


def controller(obs: FloatArray) -> FloatArray:
    """Feedback written by hand: observations (n, 11) -> actions (n, 4).

    The speed wanted sets the tilt wanted; thrust holds the height; the legs stay still.
    """
    y, vx, vy, cosine, sine, spin = (obs[:, i] for i in range(1, 7))
    tilt = np.clip(0.25 * (vx - 4.0), -0.35, 0.35)
    weight = HULL_KG + 2 * LEG_KG
    thrust = weight * (9.81 + 8.0 * (0.1 - y) - 4.0 * vy) / np.maximum(cosine, 0.5)
    torque = 1.8 * (tilt - sine) - 0.48 * spin
    left, right = (thrust + side * torque / ENGINE_X for side in (-1, 1))
    engines = np.stack([left, right], axis=1).clip(0.0, 2 * THRUST_N) / (2 * THRUST_N)
    return np.concatenate([engines, np.zeros_like(engines)], axis=1).astype(np.float32)
