"""The simulator's own flat observation of a level (`SYMBOLIC_FLAT` of kinetix-env 3.0.2).

One row per polygon, circle, joint and thruster of the level's capacity, zero where nothing is
active; of the surroundings (the first polygons) only the floor. What a world changes are place,
velocity, spin and angle of bodies; everything else is written once.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rtc_cli.errors import UsageError
from rtc_cli.tasks.kinetix.reading import (
    GRAVITY,
    MAX_VERTICES,
    MOTOR_BINDINGS,
    THRUSTER_BINDINGS,
    Level,
    LevelJoint,
    LevelShape,
    LevelThruster,
)
from rtc_cli.tasks.scene import Component, FloatArray, Role, StateArray

LIMIT = 10.0
SPIN_SCALE = 10.0

_BODY = (
    *(("x", "m"), ("y", "m"), ("vx", "m/s"), ("vy", "m/s")),
    *(("inverse mass", "1/kg"), ("inverse inertia", "1/(kg·m²)"), ("density", "kg/m²")),
    ("tanh(spin / 10)", "1"),
    *((f"role {int(role)}", "1") for role in Role),
    *(("sin", "1"), ("cos", "1"), ("friction", "1"), ("restitution", "1")),
)
_POLYGON = (
    *(*_BODY, ("circle", "1")),
    *((f"vertex {v} {axis}", "m") for v in range(MAX_VERTICES) for axis in "xy"),
    ("triangle", "1"),
)
_CIRCLE = (*_BODY, ("radius", "m"), ("circle", "1"))
_JOINT = (
    *(("active", "1"), ("fixed", "1"), ("on b x", "m"), ("on b y", "m")),
    *(("on a x", "m"), ("on a y", "m"), ("sin", "1"), ("cos", "1")),
    *(("motor speed", "1"), ("motor power", "1"), ("motor on", "1"), ("limited", "1")),
    *((f"motor binding {i}", "1") for i in range(MOTOR_BINDINGS)),
    *(("sin of lower", "1"), ("cos of lower", "1"), ("sin of upper", "1"), ("cos of upper", "1")),
    *(("lower", "rad"), ("upper", "rad")),
)
_THRUSTER = (
    *(("active", "1"), ("x", "m"), ("y", "m")),
    *((f"thruster binding {i}", "1") for i in range(THRUSTER_BINDINGS)),
    *(("sin", "1"), ("cos", "1"), ("power", "1")),
)
_SPIN = [name for name, _ in _BODY].index("tanh(spin / 10)")
_SIN = [name for name, _ in _BODY].index("sin")


class SymbolicView:
    """Flat observations of one level; `size` numbers, named by `components`."""

    def __init__(self, level: Level) -> None:
        size = level.capacity
        count = size.polygons + size.circles
        hidden = range(1, size.fixated)
        joint_fields = _joint_fields(count)
        thruster_fields = (*_THRUSTER, *((f"on shape {i}", "1") for i in range(count)))
        self.components: tuple[Component, ...] = ()
        self._template = np.zeros(0)
        self._first: dict[int, int] = {}  # place in level.shapes -> first column of its row
        shapes = {shape.number: (i, shape) for i, shape in enumerate(level.shapes)}
        for number in (n for n in range(count) if n not in hidden):
            polygon = number < size.polygons
            fields = _POLYGON if polygon else _CIRCLE
            name = f"polygon{number}" if polygon else f"circle{number - size.polygons}"
            if number in shapes:
                self._first[shapes[number][0]] = len(self._template)
            self._add(name, fields, _shape_row(shapes[number][1]) if number in shapes else None)
        joints = {joint.index: joint for joint in level.joints}
        for i in range(size.joints):
            row = _joint_row(joints[i], count) if i in joints else None
            self._add(f"joint{i}", joint_fields, row)
        thrusters = {thruster.index: thruster for thruster in level.thrusters}
        for i in range(size.thrusters):
            row = _thruster_row(thrusters[i], count) if i in thrusters else None
            self._add(f"thruster{i}", thruster_fields, row)
        self._add("gravity", (("y / 10", "m/s²"),), [GRAVITY[1] / 10])
        self._names = [shape.name for shape in level.shapes]

    def _add(
        self, name: str, fields: Sequence[tuple[str, str]], row: Sequence[float] | None
    ) -> None:
        values = np.zeros(len(fields)) if row is None else np.array(row, np.float64)
        self._template = np.concatenate([self._template, values])
        self.components += tuple(
            Component(f"{name}.{field}", unit, -LIMIT, LIMIT) for field, unit in fields
        )

    @property
    def size(self) -> int:
        """Length of the observation vector."""
        return len(self._template)

    def place_columns(self, body: int) -> slice:
        """Where a body's place stands; UsageError for a body that the vector leaves out."""
        if body not in self._first:
            raise UsageError(
                f"{self._names[body]} is not in the symbolic observation",
                'observe the level with "compact"',
            )
        return slice(self._first[body], self._first[body] + 2)

    def observe(self, states: StateArray) -> FloatArray:
        """Observations (n, size), float32, of body states (n, bodies, 6); always finite."""
        flat: npt.NDArray[np.float64] = np.repeat(self._template[None], len(states), axis=0)
        for body, first in self._first.items():
            state = states[:, body]
            flat[:, first : first + 4] = state[:, :4]
            flat[:, first + _SPIN] = np.tanh(state[:, 5] / SPIN_SCALE)
            flat[:, first + _SIN] = np.sin(state[:, 4])
            flat[:, first + _SIN + 1] = np.cos(state[:, 4])
        flat = np.nan_to_num(np.clip(flat, -LIMIT, LIMIT), nan=0.0)
        return flat.astype(np.float32)


def _joint_fields(count: int) -> tuple[tuple[str, str], ...]:
    ends = ((f"{end} is shape {i}", "1") for end in "ba" for i in range(count))
    return (*_JOINT, *ends)


def _one_hot(index: int, count: int) -> list[float]:
    return [float(i == index) for i in range(count)]


def _shape_row(shape: LevelShape) -> list[float]:
    body = [
        *(*shape.position, *shape.velocity),
        *(shape.inverse_mass, shape.inverse_inertia, shape.density),
        np.tanh(shape.spin / SPIN_SCALE),
        *_one_hot(int(shape.role), len(Role)),
        *(np.sin(shape.rotation), np.cos(shape.rotation)),
        *(shape.friction, shape.restitution),
    ]
    if not shape.vertices:
        return [*body, shape.radius, 1.0]
    missing = MAX_VERTICES - len(shape.vertices)
    corners = [*itertools.chain.from_iterable(shape.vertices), *[-1.0] * (2 * missing)]
    return [*body, 0.0, *corners, float(missing > 0)]


def _joint_row(joint: LevelJoint, count: int) -> list[float]:
    turn = joint.rotation
    body = [1.0, float(joint.fixed), *joint.on_b, *joint.on_a, np.sin(turn), np.cos(turn)]
    motor = [0.0] * (len(_JOINT) - len(body))
    if not joint.fixed:
        limits = [0.0] * 6
        if joint.limits is not None:
            low, high = joint.limits
            limits = [np.sin(low), np.cos(low), np.sin(high), np.cos(high), low - turn, high - turn]
        motor = [
            *(joint.motor.speed, joint.motor.power),
            *(float(joint.motor.on), float(joint.limits is not None)),
            *_one_hot(joint.motor.binding, MOTOR_BINDINGS),
            *limits,
        ]
    return [*body, *motor, *_one_hot(joint.b, count), *_one_hot(joint.a, count)]


def _thruster_row(thruster: LevelThruster, count: int) -> list[float]:
    return [
        *(1.0, *thruster.point, *_one_hot(thruster.binding, THRUSTER_BINDINGS)),
        *(np.sin(thruster.angle), np.cos(thruster.angle), thruster.power),
        *_one_hot(thruster.body, count),
    ]
