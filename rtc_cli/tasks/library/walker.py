"""Walk a biped to a post, away from a wall that follows it.

A torso stands on two legs, each with a thigh, a shin and a round foot; four motors turn hips and
knees. Solved when the torso touches the post, 2 m to the right. Failed when the torso touches the
bar, 0.3 m above the ground, or the wall, which comes from the left at 0.18 m/s. Legs pass through
the bar and touch the ground only.

What makes it dynamic: the motors set speeds, not angles, so that the noise of every action stays
in the pose until it is corrected. Each step leaves the torso on one foot, from which it topples,
and only the next step in the right place catches it. Standing still fails too: the wall arrives.

Time constant: balanced on one foot, the other leg drawn up and the motors at rest, a tilt grows by
e in 0.35 s (10 control steps), computed. A solved episode takes about 105 control steps, 11 of
these.

| observation | unit | range |
| --- | --- | --- |
| torso.position.x, y | m | −10 to 10 |
| torso.velocity.vx, vy | m/s | −10 to 10 |
| torso.angle.cos, sin | 1 | −1 to 1 |
| torso.angular_velocity | rad/s | −10 to 10 |
| torso.relative_angle.left_thigh.cos, sin | 1 | −1 to 1 |
| left_thigh.relative_angle.left_shin.cos, sin | 1 | −1 to 1 |
| left_thigh.angular_velocity | rad/s | −10 to 10 |
| left_shin.angular_velocity | rad/s | −10 to 10 |
| torso.relative_angle.right_thigh.cos, sin | 1 | −1 to 1 |
| right_thigh.relative_angle.right_shin.cos, sin | 1 | −1 to 1 |
| right_thigh.angular_velocity | rad/s | −10 to 10 |
| right_shin.angular_velocity | rad/s | −10 to 10 |
| wall.x | m | −10 to 10 |

| action | unit | range |
| --- | --- | --- |
| left_hip | fraction of 1.2 rad/s | −1 to 1 |
| left_knee | fraction of 1.2 rad/s | −1 to 1 |
| right_hip | fraction of 1.2 rad/s | −1 to 1 |
| right_knee | fraction of 1.2 rad/s | −1 to 1 |

Angles count anticlockwise: of the torso from upright, of a thigh from the torso's axis, of a shin
from its thigh. Positive hip rates swing a leg forward, positive knee rates stretch it.
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

TORSO_WIDTH = 0.22
TORSO_HEIGHT = 0.45
TORSO_KG = 2.0
TARGET_X = 2.0
BAR_Y = 0.3
WALL = (-1.1, 0.75)  # m, its middle at the start
WALL_SPEED = 0.18  # m/s


def _leg(side: str, thigh: float, knee: float) -> Leg:
    return Leg(
        side=side,
        hip_x=0.0,
        thigh=thigh,
        knee=knee,
        bone=0.4,
        thigh_kg=0.3,
        shin_kg=0.2,
        foot_radius=0.1,
        hip_limits=(-0.8, 1.1),
        knee_limits=(-1.3, -0.05),
        rate=1.2,
        hip_torque=20.0,
        knee_torque=15.0,
    )


LEFT, RIGHT = _leg("left", 0.5, -0.5), _leg("right", 0.0, -0.6)
HIP_Y = max(LEFT.reach, RIGHT.reach) + 0.02  # the jitter of the legs needs some room


def _surroundings() -> tuple[Body, ...]:
    track = (legs.ground(-3.0, TARGET_X + 3.0), legs.bar(TARGET_X, BAR_Y - 0.01))
    return (
        Body(name="ground", static=True, shapes=track),
        legs.post(TARGET_X, height=1.6),
        legs.wall(WALL, height=1.3, speed=WALL_SPEED),
    )


def _torso() -> Body:
    shape = Box(
        width=TORSO_WIDTH,
        height=TORSO_HEIGHT,
        offset=(0.0, TORSO_HEIGHT / 2),
        density=TORSO_KG / (TORSO_WIDTH * TORSO_HEIGHT),
        role=Role.GOAL,
        group=PARTS,
        category=TORSO,
        mask=AROUND,
    )
    return Body(name="torso", position=(0.0, HIP_Y), shapes=(shape,))


SCENE = Scene(
    name="walker",
    description=__doc__ or "",
    bodies=(*_surroundings(), _torso(), *LEFT.bodies(HIP_Y), *RIGHT.bodies(HIP_Y)),
    joints=(
        legs.wall_rail(WALL),
        *LEFT.hinges(HIP_Y),
        *RIGHT.hinges(HIP_Y),
    ),
    motors=(*LEFT.motors(), *RIGHT.motors()),
    actions=legs.actions(LEFT, RIGHT),
    observations=legs.observations(LEFT, RIGHT),
    progress_terms=(Distance(observation="torso.position", target=(TARGET_X, HIP_Y)),),
    progress_scale=1.0,
    jitters=legs.jitters(LEFT, RIGHT, place=0.05, swing=0.2),
    view=(-1.4, -0.15, TARGET_X + 0.4, 1.65),
)
