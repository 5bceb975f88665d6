"""The content of a Kinetix level file as checked records.

What the fields mean was read off the simulator's public sources (Kinetix, and Jax2D, its engine).
Lists have a fixed length and `active` flags; only active entries are read. A shape's number counts
the polygons first, then the circles. Units: metres, seconds, radians; y points up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rtc_cli.tasks.kinetix.nodes import Node, read_document
from rtc_cli.tasks.scene import SUBSTEP_S, SUBSTEPS, Role, Vec

MAX_SHAPES = 128  # of a kind
MAX_JOINTS = 64
MAX_THRUSTERS = 64
MAX_VERTICES = 4
MOTOR_BINDINGS = 4
THRUSTER_BINDINGS = 2
GRAVITY = (0.0, -9.81)  # of every level: the simulator's own loaders do not read the file's


@dataclass(frozen=True, kw_only=True)
class Laws:
    """The simulator's constants of a level, by the file's `env_params` and `static_env_params`."""

    step_s: float
    iterations: int
    batch_size: int
    warm_start: bool
    slop: float
    contact_rate: float
    joint_velocity_rate: float
    joint_position_rate: float
    joint_stiffness: float
    weld_rate: float
    limit_rate: float
    motor_speed: float
    motor_power: float
    motor_softness: float
    motor_fade: float
    thruster_power: float
    friction: float
    max_position: float
    max_speed: float
    max_spin: float


@dataclass(frozen=True)
class Capacity:
    """How many entries the lists of a level hold, active or not; the first polygons are `fixated`.

    The solver's order, and so every motion with contacts, follows from them.
    """

    polygons: int
    circles: int
    joints: int
    thrusters: int
    fixated: int


@dataclass(frozen=True)
class LevelShape:
    """An active polygon (`vertices` clockwise, about the centre of gravity) or circle (`radius`).

    `inverse_mass` 0 is immovable, `inverse_inertia` 0 does not turn. `mode` 0 touches only shapes
    of mode 2, mode 1 those of 1 and 2, mode 2 all. `number` counts the polygons, then the circles.
    """

    number: int
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

    def touches(self, other: LevelShape) -> bool:
        """Whether two shapes touch at all, by their collision modes."""
        return 2 in (self.mode, other.mode) or self.mode * other.mode > 0


@dataclass(frozen=True)
class LevelMotor:
    """The motor of a joint: whether it is on, its binding, speed and power in the level's units."""

    on: bool
    binding: int
    speed: float
    power: float


@dataclass(frozen=True)
class LevelJoint:
    """An active joint of shapes `a` and `b` at a point given in the frame of each.

    `rotation` is rotation(b) − rotation(a) where the joint is at 0; limits count from there.
    """

    index: int
    a: int
    b: int
    on_a: Vec
    on_b: Vec
    fixed: bool
    rotation: float
    limits: Vec | None
    motor: LevelMotor

    @property
    def driven(self) -> bool:
        """Whether an action turns it."""
        return self.motor.on and not self.fixed


@dataclass(frozen=True)
class LevelThruster:
    """An active thruster at `point` of shape `body`, pushing along `angle` in the body's frame."""

    index: int
    body: int
    point: Vec
    angle: float
    power: float
    binding: int


@dataclass(frozen=True)
class Level:
    """A level file: what is active in it. `path` only says where it was read."""

    path: Path = field(metadata={"looks": True})
    laws: Laws
    capacity: Capacity
    shapes: tuple[LevelShape, ...]
    joints: tuple[LevelJoint, ...]
    thrusters: tuple[LevelThruster, ...]
    gravity: Vec = GRAVITY

    def shape(self, number: int) -> LevelShape:
        """The active shape with this number."""
        return next(shape for shape in self.shapes if shape.number == number)

    def moves(self, shape: LevelShape) -> bool:
        """Whether a shape can ever be elsewhere than at the start."""
        return bool(
            shape.inverse_mass
            or shape.inverse_inertia
            or any(shape.velocity)
            or shape.spin
            or max(map(abs, shape.position)) > self.laws.max_position
        )

    @property
    def acting(self) -> tuple[LevelJoint, ...]:
        """Joints that hold something with a mass."""
        light = {shape.number for shape in self.shapes if shape.inverse_mass > 0}
        return tuple(joint for joint in self.joints if light & {joint.a, joint.b})

    @property
    def pushing(self) -> tuple[LevelThruster, ...]:
        """Thrusters on something that they can move or turn."""
        light = {s.number for s in self.shapes if s.inverse_mass > 0 or s.inverse_inertia > 0}
        return tuple(thruster for thruster in self.thrusters if thruster.body in light)

    @property
    def motor_bindings(self) -> tuple[int, ...]:
        """Numbers of the motor bindings that turn something."""
        return tuple(sorted({joint.motor.binding for joint in self.acting if joint.driven}))

    @property
    def thruster_bindings(self) -> tuple[int, ...]:
        """Numbers of the thruster bindings that push something."""
        return tuple(sorted({thruster.binding for thruster in self.pushing}))


def read_level(path: Path) -> Level:
    """Read and check a level file; UsageError names the file, the field and what is allowed."""
    root = read_document(path)
    root.only("env_state", "env_params", "static_env_params", "version")
    state, static = root.get("env_state"), root.get("static_env_params")
    state.only(*_STATE)
    static.only(*_STATIC)
    polygons = _listed(state, static, "polygon", "num_polygons", MAX_SHAPES)
    circles = _listed(state, static, "circle", "num_circles", MAX_SHAPES)
    joints = _listed(state, static, "joint", "num_joints", MAX_JOINTS)
    thrusters = _listed(state, static, "thruster", "num_thrusters", MAX_THRUSTERS)
    named = [("polygon", i, node) for i, node in enumerate(polygons)]
    named += [("circle", i, node) for i, node in enumerate(circles)]
    shapes = tuple(
        _shape(node, kind, index, number)
        for number, (kind, index, node) in enumerate(named)
        if _is_active(node, _SHAPE)
    )
    known = {shape.number for shape in shapes}
    return Level(
        path=path,
        laws=_laws(root.get("env_params"), static),
        capacity=Capacity(
            len(polygons),
            len(circles),
            len(joints),
            len(thrusters),
            static.get("num_static_fixated_polys").whole(0, len(polygons)),
        ),
        shapes=shapes,
        joints=tuple(
            _joint(node, i, known) for i, node in enumerate(joints) if _is_active(node, _JOINT)
        ),
        thrusters=tuple(
            _thruster(node, i, known)
            for i, node in enumerate(thrusters)
            if _is_active(node, _THRUSTER)
        ),
    )


# Keys of the format, as the original's own loader and editor know them.
_STATE = (
    *("polygon", "circle", "joint", "thruster", "gravity", "collision_matrix"),
    *("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds"),
)
_STATIC = (
    *("num_polygons", "num_circles", "num_joints", "num_thrusters", "max_polygon_vertices"),
    *("num_solver_iterations", "solver_batch_size", "do_warm_starting", "frame_skip"),
    *("num_static_fixated_polys", "num_motor_bindings", "num_thruster_bindings"),
    *("screen_dim", "downscale", "max_shape_size"),
)
_PARAMS = (
    *("dt", "slop", "joint_stiffness", "baumgarte_coefficient_collision"),
    *("baumgarte_coefficient_joints_v", "baumgarte_coefficient_joints_p"),
    *("baumgarte_coefficient_fjoint_av", "baumgarte_coefficient_rjoint_limit_av"),
    *("clip_position", "clip_velocity", "clip_angular_velocity", "base_friction"),
    *("base_motor_speed", "base_motor_power", "base_thruster_power"),
    *("motor_decay_coefficient", "motor_joint_limit"),
    *("max_timesteps", "pixels_per_unit", "dense_reward_scale", "num_shape_roles"),
)
_SHAPE = (
    *("active", "position", "rotation", "velocity", "angular_velocity", "inverse_mass"),
    *("inverse_inertia", "density", "friction", "restitution", "collision_mode", "role"),
    *("n_vertices", "vertices", "radius", "highlighted"),
)
_JOINT = (
    *("active", "a_index", "b_index", "a_relative_pos", "b_relative_pos", "global_position"),
    *("acc_impulse", "acc_r_impulse", "is_fixed_joint", "rotation", "motor_on", "motor_speed"),
    *("motor_power", "motor_binding", "motor_has_joint_limits", "min_rotation", "max_rotation"),
)
_THRUSTER = (
    *("active", "object_index", "relative_position", "rotation", "power", "thruster_binding"),
    "global_position",
)


def _is_active(node: Node, keys: tuple[str, ...]) -> bool:
    node.only(*keys)
    return node.get("active").flag()


def _listed(state: Node, static: Node, key: str, count: str, most: int) -> list[Node]:
    entries = state.get(key).entries(0, most)
    said = static.get(count)
    if said.whole(0, 1_000_000) != len(entries):
        said.refuse(f"env_state.{key} has {len(entries)} entries, and the two must agree")
    return entries


def _laws(params: Node, static: Node) -> Laws:
    params.only(*_PARAMS)
    step = params.get("dt")
    step.check(lambda dt: abs(dt - SUBSTEP_S) < 1e-6, "only 1/60 s is supported")
    skip = static.get("frame_skip")
    skip.check(lambda n: n == SUBSTEPS, f"only {SUBSTEPS} substeps per control step are supported")
    for key, needed in (
        ("max_polygon_vertices", MAX_VERTICES),
        ("num_motor_bindings", MOTOR_BINDINGS),
        ("num_thruster_bindings", THRUSTER_BINDINGS),
    ):
        if static.get(key).whole(0, 1000) != needed:
            static.get(key).refuse(f"only {needed} is supported")

    def number(key: str, low: float, high: float) -> float:
        return params.get(key).number(low, high)

    return Laws(
        step_s=step.number(),
        iterations=static.get("num_solver_iterations").whole(1, 1000),
        batch_size=static.get("solver_batch_size").whole(1, 1000),
        warm_start=static.get("do_warm_starting").flag(),
        slop=number("slop", 0.0, 10.0),
        contact_rate=number("baumgarte_coefficient_collision", 0.0, 1e3),
        joint_velocity_rate=number("baumgarte_coefficient_joints_v", 0.0, 1e3),
        joint_position_rate=number("baumgarte_coefficient_joints_p", 0.0, 1e3),
        joint_stiffness=number("joint_stiffness", 0.0, 1e3),
        weld_rate=number("baumgarte_coefficient_fjoint_av", 0.0, 1e3),
        limit_rate=number("baumgarte_coefficient_rjoint_limit_av", 0.0, 1e3),
        motor_speed=number("base_motor_speed", 0.0, 1e3),
        motor_power=number("base_motor_power", 0.0, 1e5),
        motor_softness=number("motor_decay_coefficient", 1e-6, 1e3),
        motor_fade=number("motor_joint_limit", 1e-6, 10.0),
        thruster_power=number("base_thruster_power", 0.0, 1e4),
        friction=number("base_friction", 0.0, 10.0),
        max_position=number("clip_position", 1e-3, 1e3),
        max_speed=number("clip_velocity", 1e-3, 1e3),
        max_spin=number("clip_angular_velocity", 1e-3, 1e3),
    )


def _shape(node: Node, kind: str, index: int, number: int) -> LevelShape:
    return LevelShape(
        number=number,
        name=f"{kind}{index}",
        place=node.place,
        position=node.get("position").pair(),
        rotation=node.get("rotation").number(-1e3, 1e3),
        velocity=node.get("velocity").pair(),
        spin=node.get("angular_velocity").number(),
        inverse_mass=node.get("inverse_mass").number(0.0, 1e6),
        inverse_inertia=node.get("inverse_inertia").number(0.0, 1e9),
        density=node.get("density").number(0.0, 1e4),
        friction=node.get("friction").number(0.0, 10.0),
        restitution=node.get("restitution").number(0.0, 1.0),
        mode=node.get("collision_mode").whole(0, 2),
        role=Role(node.get("role").whole(0, 3)),
        vertices=_vertices(node) if kind == "polygon" else (),
        radius=node.get("radius").number(1e-4, 100.0) if kind == "circle" else 0.0,
    )


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
    if not all(turn < -1e-9 for turn in turns):  # four corners cannot wind round twice
        listed.refuse("the corners of a convex polygon with some area are needed")
    return points


def _cross(a: Vec, b: Vec, c: Vec) -> float:
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


def _joint(node: Node, index: int, known: set[int]) -> LevelJoint:
    a, b = (_number(node.get(key), known) for key in ("a_index", "b_index"))
    if a == b:
        node.get("b_index").refuse("a joint needs two different shapes")
    limits = None
    if node.get("motor_has_joint_limits").flag():
        low, high = node.get("min_rotation"), node.get("max_rotation")
        limits = (low.number(), high.number())
        if limits[0] > limits[1]:
            high.refuse(f"at least min_rotation, {limits[0]:g}, is needed")
    return LevelJoint(
        index=index,
        a=a,
        b=b,
        on_a=node.get("a_relative_pos").pair(),
        on_b=node.get("b_relative_pos").pair(),
        fixed=node.get("is_fixed_joint").flag(),
        rotation=node.get("rotation").number(-1e3, 1e3),
        limits=limits,
        motor=LevelMotor(
            node.get("motor_on").flag(),
            node.get("motor_binding").whole(0, MOTOR_BINDINGS - 1),
            node.get("motor_speed").number(),
            node.get("motor_power").number(0.0, 100.0),
        ),
    )


def _thruster(node: Node, index: int, known: set[int]) -> LevelThruster:
    return LevelThruster(
        index=index,
        body=_number(node.get("object_index"), known),
        point=node.get("relative_position").pair(),
        angle=node.get("rotation").number(-1e3, 1e3),
        power=node.get("power").number(0.0, 100.0),
        binding=node.get("thruster_binding").whole(0, THRUSTER_BINDINGS - 1),
    )


def _number(node: Node, known: set[int]) -> int:
    number = node.whole(0, 2 * MAX_SHAPES)
    if number not in known:
        node.refuse("the number of an active shape is needed")
    return number
