"""From the records of a level file to a scene: what is drawn, acted on, observed and rewarded.

The scene's declarations are for people and policies; the physics reads the level itself. Every
active shape is a body of its own, every active joint a hinge or a weld. Actions are the bindings
that something uses, motors first, in the order of their numbers: the others would do nothing, and a
policy would have to learn that.
"""

from __future__ import annotations

import itertools
import math
from typing import NoReturn

from rtc_cli.errors import UsageError
from rtc_cli.levels import Observation
from rtc_cli.tasks.kinetix.reading import Level, LevelJoint, LevelShape, LevelThruster
from rtc_cli.tasks.kinetix.scene import LevelScene
from rtc_cli.tasks.scene import (
    Action,
    Body,
    Circle,
    Fixed,
    Joint,
    Motor,
    Observe,
    Pivot,
    Polygon,
    Role,
    Shape,
    Thruster,
)

ARENA = (0.0, 0.0, 5.0, 5.0)  # m, x and y from, x and y to
MARGIN_M = 0.15
SPEED_SCALE = 3.0  # m/s
SPIN_SCALE = 10.0  # rad/s


def build_scene(level: Level, name: str, observation: Observation = "compact") -> LevelScene:
    """The scene of a level; UsageError for a level that cannot be a task."""
    _check_roles(level)
    return LevelScene(
        name=name,
        description=_description(level),
        level=level,
        observation=observation,
        bodies=tuple(_body(level, shape) for shape in level.shapes),
        joints=tuple(_joint(level, joint) for joint in level.acting),
        motors=tuple(_motor(level, joint) for joint in level.acting if joint.driven),
        thrusters=tuple(_thruster(level, each) for each in level.pushing),
        actions=_actions(level),
        observations=_observed(level),
        view=(ARENA[0] - MARGIN_M, ARENA[1] - MARGIN_M, ARENA[2] + MARGIN_M, ARENA[3] + MARGIN_M),
    )


def _refuse(level: Level, what: str) -> NoReturn:
    raise UsageError(f"{level.path}: {what}", "mend the level, or leave it out")


def _check_roles(level: Level) -> None:
    """A level can be solved only if something to move there can meet something to touch."""
    by_role = {role: [s for s in level.shapes if s.role == role] for role in Role}
    for role in (Role.GOAL, Role.TARGET):
        if not by_role[role]:
            _refuse(level, f"no active shape has role {int(role)} ({role.name.lower()})")
    pairs = list(itertools.product(by_role[Role.GOAL], by_role[Role.TARGET]))
    movable = [pair for pair in pairs if any(level.moves(shape) for shape in pair)]
    if not movable:
        _refuse(level, "no shape of role 1 or 2 can move (inverse_mass is 0 for all)")
    if not any(goal.touches(target) for goal, target in movable):
        _refuse(
            level,
            "collision_mode: no shape of role 1 touches one of role 2 of which one can move, so it "
            "cannot be solved",
        )


def _body(level: Level, shape: LevelShape) -> Body:
    return Body(
        name=shape.name,
        shapes=(_outline(shape),),
        position=shape.position,
        angle=shape.rotation,
        velocity=shape.velocity,
        angular_velocity=shape.spin,
        static=not level.moves(shape),
    )


def _outline(shape: LevelShape) -> Shape:
    if not shape.vertices:
        return Circle(radius=shape.radius, role=shape.role)
    return Polygon(vertices=shape.vertices[::-1], role=shape.role)


def _joint(level: Level, joint: LevelJoint) -> Joint:
    a, b = level.shape(joint.a), level.shape(joint.b)
    c, s = math.cos(a.rotation), math.sin(a.rotation)
    x, y = joint.on_a
    anchor = (a.position[0] + c * x - s * y, a.position[1] + s * x + c * y)
    if joint.fixed:
        return Fixed(a=a.name, b=b.name, anchor=anchor)
    return Pivot(a=a.name, b=b.name, anchor=anchor)


def _motor(level: Level, joint: LevelJoint) -> Motor:
    return Motor(
        a=level.shape(joint.a).name,
        b=level.shape(joint.b).name,
        action=f"motor{joint.motor.binding}",
        max_rate=level.laws.motor_speed * joint.motor.speed,
        max_torque=level.laws.motor_power * joint.motor.power,
    )


def _thruster(level: Level, thruster: LevelThruster) -> Thruster:
    return Thruster(
        body=level.shape(thruster.body).name,
        action=f"thruster{thruster.binding}",
        max_force=level.laws.thruster_power * thruster.power,
        point=thruster.point,
        direction=(math.cos(thruster.angle), math.sin(thruster.angle)),
    )


def _actions(level: Level) -> tuple[Action, ...]:
    motors, thrusters = level.motor_bindings, level.thruster_bindings
    if not motors and not thrusters:
        _refuse(level, "no active motor or thruster drives anything")
    unit = "fraction of full speed"
    return (
        *(Action(name=f"motor{i}", unit=unit) for i in motors),
        *(Action(name=f"thruster{i}", low=0.0, unit="fraction of full force") for i in thrusters),
    )


def _observed(level: Level) -> tuple[Observe, ...]:
    """The state of everything that moves, and the way from what moves to a target that moves."""
    middle = ((ARENA[0] + ARENA[2]) / 2, (ARENA[1] + ARENA[3]) / 2)
    moving = [shape for shape in level.shapes if level.moves(shape)]
    entries: list[Observe] = []
    for shape in moving:
        entries += [
            Observe(kind="position", body=shape.name, scale=middle[0], offset=middle),
            Observe(kind="velocity", body=shape.name, scale=SPEED_SCALE),
            Observe(kind="angle", body=shape.name),
            Observe(kind="angular_velocity", body=shape.name, scale=SPIN_SCALE),
        ]
    goals, targets = ([s for s in moving if s.role == role] for role in (Role.GOAL, Role.TARGET))
    entries += [
        Observe(kind="relative_position", body=goal.name, other=target.name, scale=2.5)
        for goal, target in itertools.product(goals, targets)
    ]
    return tuple(entries)


def _description(level: Level) -> str:
    names = {
        role: ", ".join(shape.name for shape in level.shapes if shape.role == role)
        for role in (Role.GOAL, Role.TARGET)
    }
    return f"""Kinetix level "{level.path.stem}": bring {names[Role.GOAL]} to {names[Role.TARGET]}.

Read from {level.path.name} and played by Kinetix' own physics (jax2d 1.0.1, kinetix-env 3.0.2).
docs/kinetix.md says how closely.
"""
