"""One scene in one pymunk Space, through pymunk's public interface.

Static bodies of a scene all become shapes of the Space's own static body. The order in which
bodies, shapes and constraints are added is part of the result: the solver works in that order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pymunk

from rtc_cli.tasks.scene import (
    SOLVER_ITERATIONS,
    SUBSTEP_S,
    SUBSTEPS,
    WORLD,
    Body,
    Box,
    Circle,
    Fixed,
    Groove,
    Joint,
    Pivot,
    Polygon,
    Role,
    Rope,
    Scene,
    Segment,
    Shape,
    Spring,
    StateArray,
    Vec,
)

# Chipmunk lets shapes overlap this far (its default of 0.1 is meant for pixels, not metres).
COLLISION_SLOP_M = 0.005

Placed = Callable[[Vec], Vec]


@dataclass(frozen=True)
class Drives:
    """How actions become motor rates and thruster forces; index arrays into the action vector."""

    motor_action: np.ndarray
    motor_scale: np.ndarray
    thruster_action: np.ndarray
    thruster_scale: np.ndarray

    @staticmethod
    def of(scene: Scene) -> Drives:
        """Precompute the tables for a scene."""
        index = {action.name: i for i, action in enumerate(scene.actions)}
        units = [np.array(t.direction) / math.hypot(*t.direction) for t in scene.thrusters]
        forces = [t.max_force * u for t, u in zip(scene.thrusters, units, strict=True)]
        return Drives(
            np.array([index[m.action] for m in scene.motors], np.intp),
            # Chipmunk's motor drives ω_b − ω_a to −rate.
            np.array([-m.max_rate for m in scene.motors], np.float64),
            np.array([index[t.action] for t in scene.thrusters], np.intp),
            np.array(forces, np.float64).reshape(len(scene.thrusters), 2),
        )

    def rates(self, actions: StateArray) -> StateArray:
        """Chipmunk motor rates (..., motors) of applied actions (..., A)."""
        return actions[..., self.motor_action] * self.motor_scale

    def forces(self, actions: StateArray) -> StateArray:
        """Local thruster forces (..., thrusters, 2) of applied actions (..., A)."""
        return actions[..., self.thruster_action][..., None] * self.thruster_scale


class World:
    """A Space with the scene's bodies at their declared pose; nothing has moved yet."""

    def __init__(self, scene: Scene, on_contact: Callable[[Role], None]) -> None:
        """`on_contact(role)` is called when a goal object begins to touch a shape of that role."""
        self.space = pymunk.Space()
        self.space.iterations = SOLVER_ITERATIONS
        self.space.gravity = scene.gravity
        self.space.damping = scene.damping
        self.space.collision_slop = COLLISION_SLOP_M
        placed = {WORLD: self.space.static_body}
        # Immovable shapes first: a reset takes the others out and puts them back (chipmunk.py).
        for body in sorted(scene.bodies, key=lambda body: not body.static):
            placed[body.name] = _add_body(self.space, body)
        self.bodies = [placed[body.name] for body in scene.bodies if not body.static]
        for joint in scene.joints:
            self.space.add(*_constraints(placed, joint))
        self.motors = [pymunk.SimpleMotor(placed[m.a], placed[m.b], 0.0) for m in scene.motors]
        for motor, declared in zip(self.motors, scene.motors, strict=True):
            motor.max_force = declared.max_torque
            self.space.add(motor)
        self.thrusters = [(placed[t.body], t.point) for t in scene.thrusters]
        for role in (Role.TARGET, Role.HAZARD):
            self._watch(role, on_contact)

    def _watch(self, role: Role, on_contact: Callable[[Role], None]) -> None:
        def begin(arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
            on_contact(role)

        self.space.on_collision(int(Role.GOAL), int(role), begin=begin)

    def place(self, states: StateArray) -> None:
        """Write body states (moving bodies, 6)."""
        for body, row in zip(self.bodies, states.tolist(), strict=True):
            # The angle first: Chipmunk places the centre of gravity with the current rotation.
            body.angle = row[4]
            body.position = (row[0], row[1])
            body.velocity = (row[2], row[3])
            body.angular_velocity = row[5]

    def set_velocities(self, states: StateArray) -> None:
        """Write only the velocities of body states (moving bodies, 6)."""
        for body, row in zip(self.bodies, states.tolist(), strict=True):
            body.velocity = (row[2], row[3])
            body.angular_velocity = row[5]

    def tick(self, rates: list[float], forces: list[Vec]) -> None:
        """One control step under motor rates and local thruster forces."""
        for motor, rate in zip(self.motors, rates, strict=True):
            motor.rate = rate
        for _ in range(SUBSTEPS):
            for (body, point), force in zip(self.thrusters, forces, strict=True):
                body.apply_force_at_local_point(force, point)
            self.space.step(SUBSTEP_S)

    def read(self, out: StateArray) -> None:
        """Write the states of the moving bodies to `out` (moving bodies, 6)."""
        for row, body in zip(out, self.bodies, strict=True):
            row[0:2] = body.position
            row[2:4] = body.velocity
            row[4] = body.angle
            row[5] = body.angular_velocity


def _add_body(space: pymunk.Space, declared: Body) -> pymunk.Body:
    if declared.static:
        turn = _transform(declared)
        space.add(*(_shape(space.static_body, shape, turn) for shape in declared.shapes))
        return space.static_body
    body = pymunk.Body()
    body.angle = declared.angle
    body.position = declared.position
    shapes = [_shape(body, shape, lambda point: point) for shape in declared.shapes]
    for made, shape in zip(shapes, declared.shapes, strict=True):
        made.density = shape.density
    space.add(body, *shapes)
    if not declared.rotates:
        body.moment = math.inf
    return body


def _transform(body: Body) -> Placed:
    """Local to world coordinates of a body that never moves."""
    c, s = math.cos(body.angle), math.sin(body.angle)
    x0, y0 = body.position
    return lambda p: (x0 + c * p[0] - s * p[1], y0 + s * p[0] + c * p[1])


def _shape(body: pymunk.Body, shape: Shape, place: Placed) -> pymunk.Shape:
    made: pymunk.Shape
    match shape:
        case Box() | Polygon():
            made = pymunk.Poly(body, [place(point) for point in shape.vertices])
        case Circle():
            made = pymunk.Circle(body, shape.radius, place(shape.offset))
        case Segment():
            made = pymunk.Segment(body, place(shape.start), place(shape.end), shape.radius)
        case _:
            raise TypeError(f"not a shape: {shape!r}")
    made.friction = shape.friction
    made.elasticity = shape.restitution
    made.sensor = shape.sensor
    made.collision_type = int(shape.role)
    made.filter = pymunk.ShapeFilter(shape.group, shape.category, shape.mask)
    return made


def _constraints(placed: dict[str, pymunk.Body], joint: Joint) -> list[pymunk.Constraint]:
    a, b = placed[joint.a], placed[joint.b]
    made: list[pymunk.Constraint]
    match joint:
        case Pivot():
            made = [pymunk.PivotJoint(a, b, joint.anchor)]
            if joint.limits is not None:
                made.append(pymunk.RotaryLimitJoint(a, b, *joint.limits))
        case Fixed():
            made = [pymunk.PivotJoint(a, b, joint.anchor)]
            made.append(pymunk.GearJoint(a, b, b.angle - a.angle, 1.0))
        case Groove():
            ends = a.world_to_local(joint.start), a.world_to_local(joint.end)
            made = [pymunk.GrooveJoint(a, b, *ends, b.world_to_local(joint.anchor))]
        case Spring():
            points = a.world_to_local(joint.anchor_a), b.world_to_local(joint.anchor_b)
            law = (joint.rest_length, joint.stiffness, joint.damping)
            made = [pymunk.DampedSpring(a, b, *points, *law)]
        case Rope():
            points = a.world_to_local(joint.anchor_a), b.world_to_local(joint.anchor_b)
            made = [pymunk.SlideJoint(a, b, *points, 0.0, joint.length)]
        case _:
            raise TypeError(f"not a joint: {joint!r}")
    for constraint in made:
        constraint.collide_bodies = joint.collide
    return made
