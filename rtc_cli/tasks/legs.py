"""Legs for tasks that walk and run: a thigh, a shin and a round foot, with motors at hip and knee.

Legs touch the ground only, torsos everything but the ground. That keeps contacts few, and a torso
can be failed well above the ground. The way to the post, and the wall that comes from behind, are
here too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rtc_cli.tasks.scene import (
    NOTHING,
    WORLD,
    Action,
    Body,
    Box,
    Circle,
    Groove,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Role,
    Vec,
)

BONE_WIDTH = 0.07  # m
FRICTION = 1.2  # of feet and of the ground
PARTS = 1  # collision group: the parts of a runner do not touch each other
TORSO, FEET, GROUND, AROUND = 1, 2, 4, 8  # collision categories


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A leg of the body "torso", by its declared pose; metres, kilograms, radians.

    side: the first part of the names of its bodies and actions; hip_x: place of the hip; thigh:
    angle of the thigh from straight down, forward is positive; knee: angle of the shin from the
    thigh; limits are those of thigh against torso and of shin against thigh.
    """

    side: str
    hip_x: float
    thigh: float
    knee: float
    bone: float
    thigh_kg: float
    shin_kg: float
    foot_radius: float
    hip_limits: Vec
    knee_limits: Vec
    rate: float  # rad/s of both motors
    hip_torque: float  # N·m
    knee_torque: float

    @property
    def names(self) -> tuple[str, str]:
        """Names of thigh and shin."""
        return (f"{self.side}_thigh", f"{self.side}_shin")

    @property
    def reach(self) -> float:
        """Height of the hip above the sole of the foot."""
        return self.bone * (math.cos(self.thigh) + math.cos(self.thigh + self.knee)) + (
            self.foot_radius
        )

    def bodies(self, hip_y: float) -> tuple[Body, Body]:
        """Thigh, and shin with foot."""
        foot = Circle(
            radius=self.foot_radius,
            offset=(0.0, -self.bone),
            friction=FRICTION,
            group=PARTS,
            category=FEET,
            mask=GROUND,
        )
        thigh, shin = self.names
        return (
            Body(
                name=thigh,
                position=(self.hip_x, hip_y),
                angle=self.thigh,
                shapes=(self._bone(self.thigh_kg),),
            ),
            Body(
                name=shin,
                position=self._knee_at(hip_y),
                angle=self.thigh + self.knee,
                shapes=(self._bone(self.shin_kg), foot),
            ),
        )

    def hinges(self, hip_y: float) -> tuple[Pivot, Pivot]:
        """Hip and knee."""
        thigh, shin = self.names
        hip = (self.hip_x, hip_y)
        return (
            Pivot(a="torso", b=thigh, anchor=hip, limits=self.hip_limits),
            Pivot(a=thigh, b=shin, anchor=self._knee_at(hip_y), limits=self.knee_limits),
        )

    def motors(self) -> tuple[Motor, Motor]:
        """Motors of hip and knee."""
        thigh, shin = self.names
        hip, knee, rate = f"{self.side}_hip", f"{self.side}_knee", self.rate
        return (
            Motor(a="torso", b=thigh, action=hip, max_rate=rate, max_torque=self.hip_torque),
            Motor(a=thigh, b=shin, action=knee, max_rate=rate, max_torque=self.knee_torque),
        )

    def observations(self) -> tuple[Observe, ...]:
        """Angles of the two joints, and how fast thigh and shin turn."""
        thigh, shin = self.names
        return (
            Observe(kind="relative_angle", body="torso", other=thigh),
            Observe(kind="relative_angle", body=thigh, other=shin),
            Observe(kind="angular_velocity", body=thigh),
            Observe(kind="angular_velocity", body=shin),
        )

    def _knee_at(self, hip_y: float) -> Vec:
        return (
            self.hip_x + self.bone * math.sin(self.thigh),
            hip_y - self.bone * math.cos(self.thigh),
        )

    def _bone(self, mass: float) -> Box:
        """A bone that hangs from its body's origin and touches nothing."""
        return Box(
            width=BONE_WIDTH,
            height=self.bone,
            offset=(0.0, -self.bone / 2),
            density=mass / (BONE_WIDTH * self.bone),
            group=PARTS,
            mask=NOTHING,
        )


def ground(left: float, right: float) -> Box:
    """Ground with its surface at height 0, for feet only."""
    return Box(
        width=right - left,
        height=0.3,
        offset=((left + right) / 2, -0.15),
        friction=FRICTION,
        category=GROUND,
        mask=FEET,
    )


def bar(target_x: float, y: float) -> Box:
    """A hazard along the whole way, for the torso only."""
    return Box(
        width=target_x + 6.0,
        height=0.02,
        offset=(target_x / 2, y),
        role=Role.HAZARD,
        category=AROUND,
        mask=TORSO,
    )


def post(x: float, height: float) -> Body:
    """The post to reach, from the ground up."""
    shape = Box(
        width=0.1,
        height=height,
        offset=(0.0, height / 2),
        role=Role.TARGET,
        category=AROUND,
        mask=TORSO,
    )
    return Body(name="post", static=True, position=(x, 0.0), shapes=(shape,))


def wall(place: Vec, height: float, speed: float) -> Body:
    """The wall that comes from behind at `speed` (m/s); it needs a `wall_rail`."""
    shape = Box(
        width=0.1, height=height, density=10.0, role=Role.HAZARD, category=AROUND, mask=TORSO
    )
    return Body(name="wall", position=place, velocity=(speed, 0.0), rotates=False, shapes=(shape,))


def wall_rail(place: Vec) -> Groove:
    """The rail of the wall that stands at `place`."""
    x, y = place
    return Groove(a=WORLD, b="wall", start=(x - 1.0, y), end=(x + 5.0, y), anchor=place)


def actions(*legs: Leg) -> tuple[Action, ...]:
    """Hip and knee of each leg."""
    return tuple(Action(name=motor.action) for leg in legs for motor in leg.motors())


def observations(*legs: Leg) -> tuple[Observe, ...]:
    """Torso, legs, and where the wall is."""
    return (
        Observe(kind="position", body="torso"),
        Observe(kind="velocity", body="torso"),
        Observe(kind="angle", body="torso"),
        Observe(kind="angular_velocity", body="torso"),
        *(entry for leg in legs for entry in leg.observations()),
        Observe(kind="x", body="wall"),
    )


def jitters(*legs: Leg, place: float, swing: float) -> tuple[Jitter, ...]:
    """Where the machine stands (m) and how, how each leg is set (rad), and where the wall is."""
    names = [name for leg in legs for name in leg.names]
    return (
        Jitter(bodies=("torso", *names), position=(place, 0.0), angle=0.03, velocity=(0.1, 0.0)),
        *(Jitter(bodies=leg.names, angle=swing) for leg in legs),
        Jitter(bodies=("wall",), position=(0.1, 0.0)),
    )
