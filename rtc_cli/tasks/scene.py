"""Scenes: what a world consists of, as plain frozen data.

A scene says which bodies, joints, motors and thrusters exist, which action component drives which
of them, what is observed, when an episode is solved or failed, and how the start varies with the
episode's seed. It contains no physics engine: `rtc_cli.tasks.batch.WorldBatch` runs it.

Units: metres, seconds, kilograms, radians, newtons; y points up. Joint anchors and groove ends are
given in world coordinates of the declared (unjittered) pose. Names are unique within a scene;
`WORLD` names the immovable surroundings.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, fields, is_dataclass
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.tasks.measuring import COMPONENTS, apply_jitter, values
from rtc_cli.tasks.scene_checks import check_scene

if TYPE_CHECKING:
    from rtc_cli.tasks.engine import Engine

WORLD = "world"
NOTHING = 0  # collision mask of what touches nothing
SUBSTEPS = 2
SUBSTEP_S = 1.0 / 60.0
SOLVER_ITERATIONS = 10
STATE_SIZE = 6  # x, y, vx, vy, angle, angular velocity

Vec = tuple[float, float]
FloatArray = npt.NDArray[np.float32]
StateArray = npt.NDArray[np.float64]


class Status(IntEnum):
    """State of an episode, as stored in records."""

    RUNNING = 0
    SOLVED = 1
    FAILED = 2
    TIMEOUT = 3
    INVALID = 4


class Role(IntEnum):
    """Solved: a goal object touches a target. Failed: a goal object touches a hazard."""

    NONE = 0
    GOAL = 1
    TARGET = 2
    HAZARD = 3


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Common part of all shapes; coordinates are local to the body.

    Shapes of the same non-zero `group` never collide; two shapes collide only if each one's
    `category` bits meet the other's `mask` bits. A `sensor` reports contacts without a force.
    The restitution (and friction) of a contact is the product of both shapes' values.
    """

    density: float = 1.0
    friction: float = 0.6
    restitution: float = 0.0
    role: Role = Role.NONE
    group: int = 0
    category: int = 0xFFFFFFFF
    mask: int = 0xFFFFFFFF
    sensor: bool = False

    @property
    def area(self) -> float:
        """Area in m²."""
        raise NotImplementedError

    @property
    def centroid(self) -> Vec:
        """Centre of area, local to the body."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A rectangle with its centre at `offset`, turned by `angle`."""

    width: float
    height: float
    offset: Vec = (0.0, 0.0)
    angle: float = 0.0

    @property
    def vertices(self) -> tuple[Vec, ...]:
        """Corners (4), local to the body, counter-clockwise."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        w, h = self.width / 2, self.height / 2
        corners = ((-w, -h), (w, -h), (w, h), (-w, h))
        ox, oy = self.offset
        return tuple((ox + c * x - s * y, oy + s * x + c * y) for x, y in corners)

    @property
    def area(self) -> float:
        """Area in m²."""
        return self.width * self.height

    @property
    def centroid(self) -> Vec:
        """Centre of area, local to the body."""
        return self.offset


@dataclass(frozen=True, kw_only=True)
class Polygon(Shape):
    """A convex polygon; `vertices` counter-clockwise."""

    vertices: tuple[Vec, ...]

    @property
    def area(self) -> float:
        """Area in m²."""
        return sum(cross for cross, _ in self._triangles()) / 2

    @property
    def centroid(self) -> Vec:
        """Centre of area, local to the body."""
        parts = self._triangles()
        total = 3 * sum(cross for cross, _ in parts)
        return (sum(c * p[0] for c, p in parts) / total, sum(c * p[1] for c, p in parts) / total)

    def _triangles(self) -> list[tuple[float, Vec]]:
        """Per edge: twice the signed area to the origin, and the sum of the edge's ends."""
        ends = zip(self.vertices, self.vertices[1:] + self.vertices[:1], strict=True)
        return [(a[0] * b[1] - a[1] * b[0], (a[0] + b[0], a[1] + b[1])) for a, b in ends]


@dataclass(frozen=True, kw_only=True)
class Circle(Shape):
    """A disc."""

    radius: float
    offset: Vec = (0.0, 0.0)

    @property
    def area(self) -> float:
        """Area in m²."""
        return math.pi * self.radius**2

    @property
    def centroid(self) -> Vec:
        """Centre of area, local to the body."""
        return self.offset


@dataclass(frozen=True, kw_only=True)
class Segment(Shape):
    """A line with rounded ends, `radius` thick on both sides (use it with radius > 0)."""

    start: Vec
    end: Vec
    radius: float = 0.02

    @property
    def area(self) -> float:
        """Area in m²."""
        return self.radius * (math.pi * self.radius + 2 * math.dist(self.start, self.end))

    @property
    def centroid(self) -> Vec:
        """Centre of area, local to the body."""
        return ((self.start[0] + self.end[0]) / 2, (self.start[1] + self.end[1]) / 2)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body. Mass and moment follow from the shapes' densities, about the centre of gravity.

    `static` bodies never move. `rotates=False` gives an infinite moment of inertia (a cart on a
    rail). The position is the body's origin; the velocity is that of its centre of gravity.
    """

    name: str
    shapes: tuple[Shape, ...]
    position: Vec = (0.0, 0.0)
    angle: float = 0.0
    velocity: Vec = (0.0, 0.0)
    angular_velocity: float = 0.0
    static: bool = False
    rotates: bool = True

    @property
    def centre(self) -> Vec:
        """Centre of gravity, local to the body."""
        if self.static:
            return (0.0, 0.0)
        parts = [(shape.density * shape.area, shape.centroid) for shape in self.shapes]
        mass = sum(m for m, _ in parts)
        return (
            sum(m * c[0] for m, c in parts) / mass,
            sum(m * c[1] for m, c in parts) / mass,
        )


@dataclass(frozen=True, kw_only=True)
class Joint:
    """Common part of all joints between bodies `a` and `b`; `collide` lets the two touch."""

    a: str
    b: str
    collide: bool = False


@dataclass(frozen=True, kw_only=True)
class Pivot(Joint):
    """A hinge at `anchor`; `limits` bound angle(b) − angle(a), radians, absolute."""

    anchor: Vec
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Fixed(Joint):
    """A weld at `anchor`: keeps position and relative angle of the declared pose."""

    anchor: Vec


@dataclass(frozen=True, kw_only=True)
class Groove(Joint):
    """A rail fixed to `a` from `start` to `end`, on which the point `anchor` of `b` slides.

    It holds no angle: use a body with `rotates=False` for a cart that stays level.
    """

    start: Vec
    end: Vec
    anchor: Vec


@dataclass(frozen=True, kw_only=True)
class Spring(Joint):
    """A damped spring between two points: stiffness N/m, damping N·s/m."""

    anchor_a: Vec
    anchor_b: Vec
    rest_length: float
    stiffness: float
    damping: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Rope(Joint):
    """Two points at most `length` apart."""

    anchor_a: Vec
    anchor_b: Vec
    length: float


@dataclass(frozen=True, kw_only=True)
class Action:
    """One action component, in `unit`, clipped to [low, high] after noise."""

    name: str
    low: float = -1.0
    high: float = 1.0
    unit: str = "fraction of maximum"


@dataclass(frozen=True, kw_only=True)
class Motor:
    """Drives ω_b − ω_a to action · max_rate (rad/s) with at most max_torque (N·m)."""

    a: str
    b: str
    action: str
    max_rate: float
    max_torque: float


@dataclass(frozen=True, kw_only=True)
class Thruster:
    """Force action · max_force at local `point` along local `direction`, turning with the body."""

    body: str
    action: str
    max_force: float
    point: Vec = (0.0, 0.0)
    direction: Vec = (0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Jitter:
    """A random rigid motion of a group of dynamic bodies at the start of an episode.

    Each number is the half-width of a uniform distribution around 0. The group turns by `angle`
    about `pivot` (default: first body's declared position) and then shifts by `position`; it gets
    the common extra velocity `velocity` and turns with `angular_velocity` about the pivot. A rigid
    motion keeps the joints inside the group satisfied; for a joint that leaves the group, put the
    pivot on its anchor. Jitters are applied in the order of declaration; a pivot moves with the
    earlier shifts of the group's first body.
    """

    bodies: tuple[str, ...]
    position: Vec = (0.0, 0.0)
    angle: float = 0.0
    velocity: Vec = (0.0, 0.0)
    angular_velocity: float = 0.0
    pivot: Vec | None = None


ObservationKind = Literal[
    "position",
    "x",
    "y",
    "velocity",
    "vx",
    "vy",
    "angle",
    "angular_velocity",
    "relative_position",
    "relative_velocity",
    "relative_angle",
    "local_position",
]


@dataclass(frozen=True, kw_only=True)
class Observe:
    """One observed quantity of a body.

    The relative kinds take `other` and mean other − body; `local_position` is the place of `other`
    in the frame of `body`. A component of the observation is (value − offset) / scale, clipped to
    [−Scene.obs_limit, Scene.obs_limit]; offsets default to 0. `name` is
    "<body>.<kind>" or "<body>.<kind>.<other>" if not given.
    """

    kind: ObservationKind
    body: str
    other: str = ""
    scale: float = 1.0
    offset: tuple[float, ...] = ()
    name: str = ""

    @property
    def label(self) -> str:
        """The name by which progress terms refer to this entry."""
        parts = [self.body, self.kind] + ([self.other] if self.other else [])
        return self.name or ".".join(parts)

    @property
    def size(self) -> int:
        """Components this entry adds to the observation."""
        return len(COMPONENTS[self.kind][0])


@dataclass(frozen=True, kw_only=True)
class Distance:
    """Progress term −weight · ‖value − target‖ of the observation entry `observation`.

    The value is in physical units (scale and offset undone); target defaults to 0.
    """

    observation: str
    target: tuple[float, ...] = ()
    weight: float = 1.0

    def way(self, value: StateArray) -> StateArray:
        """Distance (n,) of values (n, components)."""
        target = np.array(self.target or (0.0,) * value.shape[1])
        return np.sqrt(np.sum((value - target) ** 2, axis=1))


@dataclass(frozen=True, kw_only=True)
class Along:
    """Progress term −weight · (way that remains along the polyline `points` to its last point).

    The value (a position of two components) is projected to the nearest point of the polyline; the
    distance to it is added. For ways round corners, where the straight distance misleads.
    """

    observation: str
    points: tuple[Vec, ...]
    weight: float = 1.0

    def way(self, value: StateArray) -> StateArray:
        """Way (n,) that remains from values (n, 2)."""
        points = np.array(self.points, np.float64)
        start, leg = points[:-1], np.diff(points, axis=0)
        lengths = np.sqrt(np.sum(leg**2, axis=1))
        after = np.cumsum(lengths[::-1])[::-1]
        offset = value[:, None] - start
        share = np.clip(np.sum(offset * leg, axis=2) / lengths**2, 0.0, 1.0)
        away = np.sqrt(np.sum((offset - share[..., None] * leg) ** 2, axis=2))
        nearest = np.argmin(away, axis=1)
        row = np.arange(len(value))
        return away[row, nearest] + after[nearest] - share[row, nearest] * lengths[nearest]


@dataclass(frozen=True)
class Component:
    """One number of the observation vector."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A complete task; everything that decides an episode is in here.

    `bounds` (x_min, y_min, x_max, y_max): a body with a goal-object shape whose origin leaves them
    fails the episode. `max_speed`, `max_spin`: velocities are clamped to them after every control
    step. `action_noise`: standard deviation of the noise, in the units of the actions.
    """

    name: str
    bodies: tuple[Body, ...]
    actions: tuple[Action, ...]
    observations: tuple[Observe, ...]
    joints: tuple[Joint, ...] = ()
    motors: tuple[Motor, ...] = ()
    thrusters: tuple[Thruster, ...] = ()
    jitters: tuple[Jitter, ...] = ()
    progress_terms: tuple[Distance | Along, ...] = ()
    progress_scale: float = 0.3
    gravity: Vec = (0.0, -9.81)
    damping: float = 1.0
    bounds: tuple[float, float, float, float] | None = None
    action_noise: float = 0.1
    max_ticks: int = 256
    max_speed: float = 30.0
    max_spin: float = 60.0
    obs_limit: float = 10.0
    description: str = field(default="", metadata={"looks": True})
    view: tuple[float, float, float, float] | None = field(default=None, metadata={"looks": True})

    last_substep_rule: ClassVar[bool] = False
    """Whether `solved` also exists by another rule: only the last substep counts."""

    def __post_init__(self) -> None:
        check_scene(self)

    def prepare(self) -> None:
        """Do, once per machine, what worlds of this scene need: compile their physics, say."""

    def own_engine(self, n: int) -> Engine | None:
        """Physics of n worlds, for a kind of scene that has its own; None is pymunk's."""
        return None

    @property
    def goal(self) -> str:
        """What to do, in a sentence: the first paragraph of the description."""
        return self.description.strip().split("\n\n")[0].replace("\n", " ")

    @property
    def control_hz(self) -> float:
        """Control steps per second."""
        return 1.0 / (SUBSTEPS * SUBSTEP_S)

    @property
    def obs_dim(self) -> int:
        """Length of the observation vector."""
        return sum(entry.size for entry in self.observations)

    @property
    def action_dim(self) -> int:
        """Number of action components."""
        return len(self.actions)

    @cached_property
    def action_low(self) -> FloatArray:
        """Lower bounds (A,), float32."""
        return np.array([a.low for a in self.actions], np.float32)

    @cached_property
    def action_high(self) -> FloatArray:
        """Upper bounds (A,), float32."""
        return np.array([a.high for a in self.actions], np.float32)

    @cached_property
    def body_index(self) -> dict[str, int]:
        """Name of a body -> its place in `bodies` and in state arrays."""
        return {body.name: i for i, body in enumerate(self.bodies)}

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Places in `bodies` of those that can move."""
        return tuple(i for i, body in enumerate(self.bodies) if not body.static)

    @cached_property
    def goal_bodies(self) -> tuple[int, ...]:
        """Places, among the moving bodies, of those with a goal-object shape."""
        moving = [self.bodies[i] for i in self.moving]
        return tuple(i for i, b in enumerate(moving) if any(s.role == Role.GOAL for s in b.shapes))

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """Name, unit and range of every number in the observation vector."""
        out = []
        for entry in self.observations:
            names, unit = COMPONENTS[entry.kind]
            bound = min(self.obs_limit, 1.0 / entry.scale if unit == "1" else self.obs_limit)
            for name in names:
                parts = f"{entry.label}.{name}" if entry.size > 1 else entry.label
                out.append(Component(parts, unit, -bound, bound))
        return tuple(out)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of everything in the declaration that affects an episode."""
        text = json.dumps(_plain(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def observe(self, states: StateArray) -> FloatArray:
        """Observations (n, O), float32, of body states (n, bodies, 6), float64.

        The six numbers are x, y (of the body's origin), vx, vy, angle, angular velocity.
        The result is always finite.
        """
        with np.errstate(invalid="ignore"):  # invalid worlds carry NaN and infinity
            columns = [values(self, entry, states) for entry in self.observations]
        flat = np.concatenate(columns, axis=1)
        flat = (flat - self._offsets) / self._scales
        flat = np.nan_to_num(flat, nan=0.0, posinf=self.obs_limit, neginf=-self.obs_limit)
        return np.clip(flat, -self.obs_limit, self.obs_limit).astype(np.float32)

    def progress(self, observations: npt.ArrayLike) -> FloatArray:
        """Potential (n,), float32, of observations (n, O): metres-like, higher is better."""
        obs = np.asarray(observations, np.float64)
        physical = obs * self._scales + self._offsets
        total = np.zeros(len(obs))
        for term in self.progress_terms:
            value = physical[:, self.columns(term.observation)]
            total -= term.weight * term.way(value)
        return total.astype(np.float32)

    def initial_states(self, uniforms: StateArray) -> StateArray:
        """States (n, bodies, 6) from uniform numbers (n, jitters, 6) in [−1, 1]."""
        states = np.repeat(self.declared_states[None], len(uniforms), axis=0)
        for k, jitter in enumerate(self.jitters):
            apply_jitter(self, jitter, uniforms[:, k], states)
        return states

    @cached_property
    def declared_states(self) -> StateArray:
        """States (bodies, 6) as declared, without jitter. Do not change."""
        rows = [(*b.position, *b.velocity, b.angle, b.angular_velocity) for b in self.bodies]
        return np.array(rows, np.float64).reshape(len(self.bodies), STATE_SIZE)

    @cached_property
    def _scales(self) -> StateArray:
        return np.repeat([e.scale for e in self.observations], [e.size for e in self.observations])

    @cached_property
    def _offsets(self) -> StateArray:
        parts = [np.array(e.offset or (0.0,) * e.size) for e in self.observations]
        return np.concatenate(parts).astype(np.float64)

    def columns(self, label: str) -> slice:
        """Place of an observation entry in the observation vector; UsageError if unknown."""
        at = 0
        for entry in self.observations:
            if entry.label == label:
                return slice(at, at + entry.size)
            at += entry.size
        known = [entry.label for entry in self.observations]
        raise UsageError(
            f'scene "{self.name}": no observation "{label}".' + did_you_mean(label, known)
        )


def _plain(value: Any) -> Any:
    """Nested lists and dicts of a declaration, without what only concerns looks."""
    if is_dataclass(value):
        kept = [f for f in fields(value) if not f.metadata.get("looks")]
        return [type(value).__name__, {f.name: _plain(getattr(value, f.name)) for f in kept}]
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return value
