"""Run on a front and a hind leg to a post, between a bar and a ceiling, away from a wall.

A long torso stands on two legs, each with a thigh, a shin and a round foot; four motors turn hips
and knees. Solved when the torso touches the post, 1.4 m ahead of its nose. Failed when the torso
touches the bar, 0.2 m above the ground, the ceiling at 0.85 m, or the wall, which comes from behind
at 0.25 m/s. Legs pass through the bar and touch the ground only.

What makes it dynamic: the motors set speeds, not angles, so that the noise of every action stays
in the pose until it is corrected. A foot that is lifted leaves that end of the torso without
support, so that it drops towards the bar, and a push that is too strong throws the other end at
the ceiling. Standing still fails too: the wall arrives.

Time constant: on the hind foot alone, balanced, the other leg drawn up and the motors at rest, a
tilt grows by e in 0.27 s (8 control steps), computed. A solved episode takes about 120 control
steps, 15 of these.

| observation | unit | range |
| --- | --- | --- |
| torso.position.x, y | m | −10 to 10 |
| torso.velocity.vx, vy | m/s | −10 to 10 |
| torso.angle.cos, sin | 1 | −1 to 1 |
| torso.angular_velocity | rad/s | −10 to 10 |
| torso.relative_angle.hind_thigh.cos, sin | 1 | −1 to 1 |
| hind_thigh.relative_angle.hind_shin.cos, sin | 1 | −1 to 1 |
| hind_thigh.angular_velocity | rad/s | −10 to 10 |
| hind_shin.angular_velocity | rad/s | −10 to 10 |
| torso.relative_angle.front_thigh.cos, sin | 1 | −1 to 1 |
| front_thigh.relative_angle.front_shin.cos, sin | 1 | −1 to 1 |
| front_thigh.angular_velocity | rad/s | −10 to 10 |
| front_shin.angular_velocity | rad/s | −10 to 10 |
| wall.x | m | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| hind_hip | fraction of 1.1 rad/s | −1 to 1 |
| hind_knee | fraction of 1.1 rad/s | −1 to 1 |
| front_hip | fraction of 1.1 rad/s | −1 to 1 |
| front_knee | fraction of 1.1 rad/s | −1 to 1 |

Angles count anticlockwise: of the torso from level, of a thigh from straight down under a level
torso, of a shin from its thigh. Positive hip rates swing a leg forward, positive knee rates
stretch it.
"""

from __future__ import annotations

from rtc_cli.tasks import legs
from rtc_cli.tasks.legs import AROUND, PARTS, TORSO, Leg
from rtc_cli.tasks.scene import (
    Body,
    Box,
    Distance,
    Role,
    Scene,
)

TORSO_LENGTH = 0.8
TORSO_HEIGHT = 0.14
TORSO_KG = 2.0
TARGET_X = 1.8
BAR_Y = 0.2
CEILING_Y = 0.85
WALL = (-1.2, 0.53)  # m, its middle at the start
WALL_SPEED = 0.25  # m/s


def _leg(side: str, hip_x: float) -> Leg:
    return Leg(
        side=side,
        hip_x=hip_x,
        thigh=0.35,
        knee=-0.7,
        bone=0.25,
        thigh_kg=0.2,
        shin_kg=0.15,
        foot_radius=0.05,
        hip_limits=(-0.8, 0.8),
        knee_limits=(-1.3, -0.1),
        rate=1.1,
        hip_torque=15.0,
        knee_torque=12.0,
    )


HIND, FRONT = _leg("hind", -0.3), _leg("front", 0.3)
HIP_Y = HIND.reach + 0.02  # the jitter of the legs needs some room


def _surroundings() -> tuple[Body, ...]:
    bars = (legs.bar(TARGET_X, BAR_Y), legs.bar(TARGET_X, CEILING_Y))
    return (
        Body(name="track", static=True, shapes=(legs.ground(-3.0, TARGET_X + 3.0), *bars)),
        legs.post(TARGET_X, height=CEILING_Y),
        legs.wall(WALL, height=0.6, speed=WALL_SPEED),
    )


def _torso() -> Body:
    shape = Box(
        width=TORSO_LENGTH,
        height=TORSO_HEIGHT,
        density=TORSO_KG / (TORSO_LENGTH * TORSO_HEIGHT),
        role=Role.GOAL,
        group=PARTS,
        category=TORSO,
        mask=AROUND,
    )
    return Body(name="torso", position=(0.0, HIP_Y), shapes=(shape,))


SCENE = Scene(
    name="half_cheetah",
    description=__doc__ or "",
    bodies=(*_surroundings(), _torso(), *HIND.bodies(HIP_Y), *FRONT.bodies(HIP_Y)),
    joints=(
        legs.wall_rail(WALL),
        *HIND.hinges(HIP_Y),
        *FRONT.hinges(HIP_Y),
    ),
    motors=(*HIND.motors(), *FRONT.motors()),
    actions=legs.actions(HIND, FRONT),
    observations=legs.observations(HIND, FRONT),
    progress_terms=(Distance(observation="torso.position", target=(TARGET_X, HIP_Y)),),
    progress_scale=1.0,
    jitters=legs.jitters(HIND, FRONT, place=0.1, swing=0.15),
    view=(-1.5, -0.15, TARGET_X + 0.3, 1.0),
)
