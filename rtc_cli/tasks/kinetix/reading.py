"""The content of a Kinetix level file as checked records.

What the fields mean was read off the simulator's public sources (Kinetix, and Jax2D, its engine).
Lists have a fixed length and `active` flags; only active entries are read. A shape's number counts
the polygons first, then the circles. Units: metres, seconds, radians; y points up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from rtc_cli.tasks.kinetix.nodes import Node, read_document
from rtc_cli.tasks.scene import SUBSTEP_S, SUBSTEPS, Role, Vec

MAX_SHAPES = 32  # one bit each in Chipmunk's collision filter
MAX_JOINTS = 64
MAX_THRUSTERS = 64
MAX_VERTICES = 16
MAX_TICKS = 256
MOTOR_BINDINGS = 4
THRUSTER_BINDINGS = 2


@dataclass(frozen=True)
class Laws:
    """The simulator's constants of a level."""

    max_ticks: int
    motor_speed: float
    motor_power: float
    motor_softness: float
    motor_fade: float
    thruster_power: float
    friction: float
    max_speed: float
    max_spin: float
    gravity: Vec


@dataclass(frozen=True)
class LevelShape:
    """An active polygon (`vertices` clockwise, about the centre of gravity) or circle (`radius`).

    `inverse_mass` 0 is immovable, `inverse_inertia` 0 does not turn. `mode` 0 touches only shapes
    of mode 2, mode 1 those of 1 and 2, mode 2 all.
    """

    name: str
    place: str
    position: Vec
    rotation: float
    velocity: Vec
    spin: float
    inverse_mass: float
    inverse_inertia: float
    density: float
    friction: float
    restitution: float
    mode: int
    role: Role
    vertices: tuple[Vec, ...] = ()
    radius: float = 0.0


@dataclass(frozen=True)
class LevelJoint:
    """An active joint of shapes `a` and `b` at a point given in the frame of each.

    `rotation` is rotation(b) − rotation(a) where the joint is at 0; limits count from there.
    """

    place: str
    a: int
    b: int
    on_a: Vec
    on_b: Vec
    fixed: bool
    rotation: float
    limits: tuple[float, float] | None
    motor: tuple[int, float, float] | None  # binding, speed, power


@dataclass(frozen=True)
class LevelThruster:
    """An active thruster at `point` of shape `body`, pushing along `angle` in the body's frame."""

    body: int
    point: Vec
    angle: float
    power: float
    binding: int


@dataclass(frozen=True)
class Level:
    """A level file. `shapes` by number; `static` bodies are those without inverse mass."""

    path: Path
    laws: Laws
    shapes: dict[int, LevelShape]
    joints: tuple[LevelJoint, ...]
    thrusters: tuple[LevelThruster, ...]


def read_level(path: Path) -> Level:
    """Read and check a level file; UsageError names the file, the field and what is allowed."""
    root = read_document(path)
    state, static = root.get("env_state"), root.get("static_env_params")
    polygons = _listed(state, static, "polygon", "num_polygons", MAX_SHAPES)
    circles = _listed(state, static, "circle", "num_circles", MAX_SHAPES)
    joints = _listed(state, static, "joint", "num_joints", MAX_JOINTS)
    thrusters = _listed(state, static, "thruster", "num_thrusters", MAX_THRUSTERS)
    named = [("polygon", i, node) for i, node in enumerate(polygons)]
    named += [("circle", i, node) for i, node in enumerate(circles)]
    shapes = {
        number: _shape(node, kind, index)
        for number, (kind, index, node) in enumerate(named)
        if node.get("active").flag()
    }
    if len(shapes) > MAX_SHAPES:
        state.get("polygon").refuse(f"{len(shapes)} shapes are active; {MAX_SHAPES} can be used")
    return Level(
        path=path,
        laws=_laws(root.get("env_params"), static, state),
        shapes=shapes,
        joints=tuple(_joint(node, shapes) for node in joints if node.get("active").flag()),
        thrusters=tuple(_thruster(node, shapes) for node in thrusters if node.get("active").flag()),
    )


def _listed(state: Node, static: Node, key: str, count: str, most: int) -> list[Node]:
    entries = state.get(key).entries(0, most)
    said = static.get(count)
    if said.whole(0, 1_000_000) != len(entries):
        said.refuse(f"env_state.{key} has {len(entries)} entries, and the two must agree")
    return entries


def _laws(params: Node, static: Node, state: Node) -> Laws:
    step = params.get("dt")
    step.check(lambda dt: abs(dt - SUBSTEP_S) < 1e-6, "only 1/60 s is supported")
    skip = static.get("frame_skip")
    skip.check(lambda n: n == SUBSTEPS, f"only {SUBSTEPS} substeps per control step are supported")
    return Laws(
        max_ticks=params.get("max_timesteps").whole(1, MAX_TICKS),
        motor_speed=params.get("base_motor_speed").number(0.0, 1e3),
        motor_power=params.get("base_motor_power").number(0.0, 1e5),
        motor_softness=params.get("motor_decay_coefficient").number(1e-6, 1e3),
        motor_fade=params.get("motor_joint_limit").number(1e-6, 10.0),
        thruster_power=params.get("base_thruster_power").number(0.0, 1e4),
        friction=params.get("base_friction").number(0.0, 10.0),
        max_speed=params.get("clip_velocity").number(1e-3, 1e3),
        max_spin=params.get("clip_angular_velocity").number(1e-3, 1e3),
        gravity=state.get("gravity").pair(),
    )


def _shape(node: Node, kind: str, index: int) -> LevelShape:
    inverse_mass = node.get("inverse_mass").number(0.0, 1e6)
    inverse_inertia = node.get("inverse_inertia").number(0.0, 1e9)
    if inverse_mass == 0.0:
        _immovable(node, inverse_inertia)
    density = node.get("density").number(0.0, 1e4)
    if density == 0.0 and inverse_mass > 0.0:
        node.get("density").refuse("a shape that moves needs more than 0")
    role = node.get("role")
    return LevelShape(
        name=f"{kind}{index}",
        place=node.place,
        position=node.get("position").pair(),
        rotation=node.get("rotation").number(-1e3, 1e3),
        velocity=node.get("velocity").pair(),
        spin=node.get("angular_velocity").number(),
        inverse_mass=inverse_mass,
        inverse_inertia=inverse_inertia,
        density=density,
        friction=node.get("friction").number(0.0, 10.0),
        restitution=node.get("restitution").number(0.0, 1.0),
        mode=node.get("collision_mode").whole(0, 2),
        role=Role(role.whole(0, 3)),
        vertices=_vertices(node) if kind == "polygon" else (),
        radius=node.get("radius").number(1e-4, 100.0) if kind == "circle" else 0.0,
    )


def _immovable(node: Node, inverse_inertia: float) -> None:
    """A shape without inverse mass stays where it is; what would still turn or drift is refused."""
    if inverse_inertia != 0.0:
        node.get("inverse_inertia").refuse(
            "a shape with inverse_mass 0 that can turn is not supported"
        )
    for key in ("velocity", "angular_velocity"):
        value = node.get(key)
        still = value.pair() == (0.0, 0.0) if key == "velocity" else value.number() == 0.0
        if not still:
            value.refuse("a shape with inverse_mass 0 that moves by itself is not supported")


def _vertices(node: Node) -> tuple[Vec, ...]:
    count = node.get("n_vertices").whole(3, MAX_VERTICES)
    listed = node.get("vertices")
    points = tuple(entry.pair() for entry in listed.entries(count, MAX_VERTICES)[:count])
    turns = [
        _cross(points[i - 2], points[i - 1], points[i])
        for i in range(count)  # negative indices close the outline
    ]
    if all(turn > 0 for turn in turns):
        listed.refuse("vertices go clockwise; these go anticlockwise")
    # Once round: an outline that turns the same way throughout may still wind twice (a star).
    if not all(turn < -1e-9 for turn in turns) or abs(_winding(points) + 1.0) > 0.5:
        listed.refuse("the corners of a convex polygon with some area are needed")
    return points


def _cross(a: Vec, b: Vec, c: Vec) -> float:
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


def _winding(points: tuple[Vec, ...]) -> float:
    """How often the outline turns round, anticlockwise."""
    edges = [
        (b[0] - a[0], b[1] - a[1]) for a, b in zip(points, points[1:] + points[:1], strict=True)
    ]
    angles = [math.atan2(y, x) for x, y in edges]
    turns = [b - a for a, b in zip(angles, angles[1:] + angles[:1], strict=True)]
    return sum(math.remainder(turn, 2 * math.pi) for turn in turns) / (2 * math.pi)


def _joint(node: Node, shapes: dict[int, LevelShape]) -> LevelJoint:
    a, b = (_number(node.get(key), shapes) for key in ("a_index", "b_index"))
    if a == b:
        node.get("b_index").refuse("a joint needs two different shapes")
    limits = None
    if node.get("motor_has_joint_limits").flag():
        low, high = node.get("min_rotation"), node.get("max_rotation")
        limits = (low.number(), high.number())
        if limits[0] > limits[1]:
            high.refuse(f"at least min_rotation, {limits[0]:g}, is needed")
    fixed = node.get("is_fixed_joint").flag()
    motor = None
    if node.get("motor_on").flag() and not fixed:
        motor = (
            node.get("motor_binding").whole(0, MOTOR_BINDINGS - 1),
            node.get("motor_speed").number(),
            node.get("motor_power").number(0.0, 100.0),
        )
    return LevelJoint(
        place=node.place,
        a=a,
        b=b,
        on_a=node.get("a_relative_pos").pair(),
        on_b=node.get("b_relative_pos").pair(),
        fixed=fixed,
        rotation=node.get("rotation").number(-1e3, 1e3),
        limits=None if fixed else limits,
        motor=motor,
    )


def _thruster(node: Node, shapes: dict[int, LevelShape]) -> LevelThruster:
    return LevelThruster(
        body=_number(node.get("object_index"), shapes),
        point=node.get("relative_position").pair(),
        angle=node.get("rotation").number(-1e3, 1e3),
        power=node.get("power").number(0.0, 100.0),
        binding=node.get("thruster_binding").whole(0, THRUSTER_BINDINGS - 1),
    )


def _number(node: Node, shapes: dict[int, LevelShape]) -> int:
    number = node.whole(0, 2 * MAX_SHAPES)
    if number not in shapes:
        node.refuse("the number of an active shape is needed")
    return number
