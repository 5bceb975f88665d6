"""From the records of a level file to a scene.

Every shape becomes a body of its own. Decisions, and where they are not the original's:

- Mass and moment of inertia are the file's `inverse_mass` and `inverse_inertia` (as in the
  original, which does not compute them anew), about the shape's origin.
- Friction of a contact is √(f_a² + f_b²) · base_friction in the original; Chipmunk multiplies. The
  values given here have that product where f_a = f_b, else √2 · √(f_a f_b) · base_friction.
- Restitution of a contact is the smaller of the two in the original; Chipmunk multiplies. The two
  differ only if both lie strictly between 0 and 1.
- Shapes that joints connect, also over others, never touch; as in the original.
- Joints whose two points lie apart in the file are closed by shifting their bodies before the
  start. The original pulls them together within the first steps.
- Actions are the bindings that something uses, motors first, in the order of their numbers. The
  others would do nothing, and a policy would have to learn that.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from rtc_cli.errors import UsageError
from rtc_cli.tasks.kinetix.reading import Level, LevelJoint, LevelShape, LevelThruster
from rtc_cli.tasks.scene import (
    Action,
    Body,
    Circle,
    Distance,
    Fixed,
    Joint,
    Observe,
    Pivot,
    Polygon,
    Role,
    Scene,
    Shape,
    StateArray,
    TanhMotor,
    Thruster,
    Vec,
    Weighed,
)

ARENA = (0.0, 0.0, 5.0, 5.0)  # m, x and y from, x and y to
MARGIN_M = 0.15
SPEED_SCALE = 3.0  # m/s
SPIN_SCALE = 10.0  # rad/s
MAX_GAP_M = 0.5  # joints whose ends lie further apart are refused
CLOSED_M = 1e-3  # m that may be left of a gap once it is closed
MAX_TWIST = 0.05  # rad, of a fixed joint at the start
SWEEPS = 200


def build_scene(level: Level, name: str) -> Scene:
    """The scene of a level; UsageError for what cannot be played."""
    _check_roles(level)
    places = _closed(level)
    actions = _actions(level)
    observed, progress = _observed(level, places)
    return Scene(
        name=name,
        description=_description(level),
        bodies=tuple(
            _body(level, number, places[number], mask)
            for number, mask in zip(level.shapes, _masks(level), strict=True)
        ),
        joints=tuple(_joint(level, joint, places) for joint in _acting(level)),
        motors=tuple(_motor(level, joint) for joint in _acting(level) if joint.motor is not None),
        thrusters=tuple(_thruster(level, each) for each in _pushing(level)),
        actions=actions,
        observations=observed,
        progress_terms=progress,
        gravity=level.laws.gravity,
        max_ticks=level.laws.max_ticks,
        max_speed=level.laws.max_speed,
        max_spin=level.laws.max_spin,
        view=(ARENA[0] - MARGIN_M, ARENA[1] - MARGIN_M, ARENA[2] + MARGIN_M, ARENA[3] + MARGIN_M),
    )


def _refuse(level: Level, what: str) -> UsageError:
    return UsageError(f"{level.path}: {what}", "mend the level, or leave it out")


def _check_roles(level: Level) -> None:
    """A level can be solved only if something to move there can meet something to touch."""
    by_role = {role: _with_role(level, role) for role in Role}
    for role in (Role.GOAL, Role.TARGET):
        if not by_role[role]:
            raise _refuse(level, f"no active shape has role {int(role)} ({role.name.lower()})")
    if not any(_moves(level.shapes[n]) for n in by_role[Role.GOAL] + by_role[Role.TARGET]):
        raise _refuse(level, "no shape of role 1 or 2 can move (inverse_mass is 0 for all)")
    group = _groups(level)
    watched = by_role[Role.TARGET] + by_role[Role.HAZARD]
    for goal, other in itertools.product(by_role[Role.GOAL], watched):
        if group[goal] == group[other]:
            names = f"{level.shapes[goal].place} and {level.shapes[other].place}"
            raise _refuse(
                level,
                f"joints connect {names} (roles 1 and 2 or 3): their contact is not supported",
            )
    pairs = itertools.product(by_role[Role.GOAL], by_role[Role.TARGET])
    if not any(
        _touch(level.shapes[goal], level.shapes[target])
        and (_moves(level.shapes[goal]) or _moves(level.shapes[target]))
        for goal, target in pairs
    ):
        raise _refuse(
            level,
            "collision_mode: no shape of role 1 touches one of role 2 of which one can move, so it "
            "cannot be solved",
        )


def _with_role(level: Level, role: Role) -> list[int]:
    return [n for n, shape in level.shapes.items() if shape.role == role]


def _moves(shape: LevelShape) -> bool:
    return shape.inverse_mass > 0.0


def _acting(level: Level) -> list[LevelJoint]:
    """Joints that hold something that moves."""
    shapes = level.shapes
    return [j for j in level.joints if _moves(shapes[j.a]) or _moves(shapes[j.b])]


def _pushing(level: Level) -> list[LevelThruster]:
    """Thrusters on something that moves."""
    return [t for t in level.thrusters if _moves(level.shapes[t.body])]


def _groups(level: Level) -> dict[int, int]:
    """Number of a shape -> the smallest number among the shapes that joints connect it to."""
    group = {number: number for number in level.shapes}
    for joint in level.joints:
        one, other = sorted((group[joint.a], group[joint.b]))
        group = {n: one if g == other else g for n, g in group.items()}
    return group


def _masks(level: Level) -> list[int]:
    """Per shape the bits of the shapes that it may touch; a shape's bit is its place."""
    group = _groups(level)
    numbers = list(level.shapes)

    def touch(one: int, other: int) -> bool:
        return group[one] != group[other] and _touch(level.shapes[one], level.shapes[other])

    return [
        sum(1 << bit for bit, other in enumerate(numbers) if touch(number, other))
        for number in numbers
    ]


def _touch(one: LevelShape, other: LevelShape) -> bool:
    """Whether two shapes that no joints connect touch, by their collision modes."""
    modes = one.mode, other.mode
    return 2 in modes or 0 not in modes


def _turned(point: Vec, angle: float) -> StateArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def _ends(level: Level, joint: LevelJoint, places: dict[int, StateArray]) -> tuple[StateArray, ...]:
    """World positions (2,) of a joint's two ends."""
    a, b = level.shapes[joint.a], level.shapes[joint.b]
    on_a, on_b = _turned(joint.on_a, a.rotation), _turned(joint.on_b, b.rotation)
    return places[joint.a] + on_a, places[joint.b] + on_b


def _gap(level: Level, joint: LevelJoint, places: dict[int, StateArray]) -> StateArray:
    """From a joint's end on A to its end on B, (2,)."""
    end_a, end_b = _ends(level, joint, places)
    return end_b - end_a


def _closed(level: Level) -> dict[int, StateArray]:
    """Positions (2,) of all shapes at which the ends of every joint meet."""
    places = {n: np.array(shape.position) for n, shape in level.shapes.items()}
    for joint in _acting(level):
        gap = float(np.hypot(*_gap(level, joint, places)))
        if gap > MAX_GAP_M:
            raise _refuse(
                level, f"{joint.place}: its ends are {gap:.2f} m apart; {MAX_GAP_M} m are allowed"
            )
        twist = level.shapes[joint.b].rotation - level.shapes[joint.a].rotation - joint.rotation
        if joint.fixed and abs(twist) > MAX_TWIST:
            raise _refuse(
                level,
                f"{joint.place}.rotation is {joint.rotation:g}, {abs(twist):.2f} rad from how the "
                f"shapes of this fixed joint stand; {MAX_TWIST} rad are allowed",
            )
    for _, joint in itertools.product(range(SWEEPS), _acting(level)):
        inverse = level.shapes[joint.a].inverse_mass, level.shapes[joint.b].inverse_mass
        step = _gap(level, joint, places) / sum(inverse)
        places[joint.a] = places[joint.a] + inverse[0] * step
        places[joint.b] = places[joint.b] - inverse[1] * step
    for joint in _acting(level):
        gap = float(np.hypot(*_gap(level, joint, places)))
        if gap > CLOSED_M:
            raise _refuse(
                level,
                f"{joint.place}: its ends stay {gap:.3f} m apart, whatever is moved; the joints of "
                "the level contradict each other",
            )
    return places


def _body(level: Level, number: int, place: StateArray, mask: int) -> Body:
    shape = level.shapes[number]
    bit = 1 << list(level.shapes).index(number)
    made = _made(shape, math.sqrt(math.sqrt(2.0) * level.laws.friction * shape.friction), bit, mask)
    position = (float(place[0]), float(place[1]))
    if not _moves(shape):
        return Body(
            name=shape.name,
            shapes=(made,),
            position=position,
            angle=shape.rotation,
            static=True,
        )
    return Weighed(
        name=shape.name,
        shapes=(made,),
        position=position,
        angle=shape.rotation,
        velocity=shape.velocity,
        angular_velocity=shape.spin,
        mass=1.0 / shape.inverse_mass,
        moment=1.0 / shape.inverse_inertia if shape.inverse_inertia else math.inf,
    )


def _made(shape: LevelShape, friction: float, bit: int, mask: int) -> Shape:
    if not shape.vertices:
        return Circle(
            radius=shape.radius,
            density=shape.density,
            friction=friction,
            restitution=shape.restitution,
            role=shape.role,
            category=bit,
            mask=mask,
        )
    return Polygon(
        vertices=shape.vertices[::-1],
        density=shape.density,
        friction=friction,
        restitution=shape.restitution,
        role=shape.role,
        category=bit,
        mask=mask,
    )


def _limits(level: Level, joint: LevelJoint) -> tuple[float, float] | None:
    """Limits on angle(b) − angle(a), where what never moves has angle 0 in the physics."""
    if joint.limits is None:
        return None
    a, b = level.shapes[joint.a], level.shapes[joint.b]
    zero = joint.rotation
    zero += 0.0 if _moves(a) else a.rotation
    zero -= 0.0 if _moves(b) else b.rotation
    return (joint.limits[0] + zero, joint.limits[1] + zero)


def _joint(level: Level, joint: LevelJoint, places: dict[int, StateArray]) -> Joint:
    a, b = level.shapes[joint.a].name, level.shapes[joint.b].name
    end = _ends(level, joint, places)[0]
    anchor = (float(end[0]), float(end[1]))
    if joint.fixed:
        return Fixed(a=a, b=b, anchor=anchor)
    return Pivot(a=a, b=b, anchor=anchor, limits=_limits(level, joint))


def _motor(level: Level, joint: LevelJoint) -> TanhMotor:
    assert joint.motor is not None  # the caller chose those that have one
    binding, speed, power = joint.motor
    laws = level.laws
    return TanhMotor(
        a=level.shapes[joint.a].name,
        b=level.shapes[joint.b].name,
        action=f"motor{binding}",
        max_rate=laws.motor_speed * speed,
        gain=laws.motor_power * power,
        softness=laws.motor_softness,
        limits=_limits(level, joint),
        fade=laws.motor_fade,
    )


def _thruster(level: Level, thruster: LevelThruster) -> Thruster:
    return Thruster(
        body=level.shapes[thruster.body].name,
        action=f"thruster{thruster.binding}",
        max_force=level.laws.thruster_power * thruster.power,
        point=thruster.point,
        direction=(math.cos(thruster.angle), math.sin(thruster.angle)),
    )


def _actions(level: Level) -> tuple[Action, ...]:
    motors = sorted({joint.motor[0] for joint in _acting(level) if joint.motor is not None})
    thrusters = sorted({thruster.binding for thruster in _pushing(level)})
    if not motors and not thrusters:
        raise _refuse(level, "no active motor or thruster drives anything")
    unit = "fraction of full speed"
    return (
        *(Action(name=f"motor{i}", unit=unit) for i in motors),
        *(Action(name=f"thruster{i}", low=0.0, unit="fraction of full force") for i in thrusters),
    )


def _observed(
    level: Level, places: dict[int, StateArray]
) -> tuple[tuple[Observe, ...], tuple[Distance, ...]]:
    """The state of everything that moves, and how far the goal objects are from a target.

    Every goal object is led to the target that is nearest at the start.
    """
    middle = ((ARENA[0] + ARENA[2]) / 2, (ARENA[1] + ARENA[3]) / 2)
    entries: list[Observe] = []
    for shape in filter(_moves, level.shapes.values()):
        entries += [
            Observe(kind="position", body=shape.name, scale=middle[0], offset=middle),
            Observe(kind="velocity", body=shape.name, scale=SPEED_SCALE),
            Observe(kind="angle", body=shape.name),
            Observe(kind="angular_velocity", body=shape.name, scale=SPIN_SCALE),
        ]
    terms: list[Distance] = []
    targets = _with_role(level, Role.TARGET)
    for goal in _with_role(level, Role.GOAL):
        ways = [float(np.hypot(*(places[n] - places[goal]))) for n in targets]
        target = targets[int(np.argmin(ways))]
        one, other = level.shapes[goal], level.shapes[target]
        if _moves(one) and _moves(other):
            pair = Observe(kind="relative_position", body=one.name, other=other.name, scale=2.5)
            entries.append(pair)
            terms.append(Distance(observation=pair.label))
        else:
            mover, rest = (one, target) if _moves(one) else (other, goal)
            end = (float(places[rest][0]), float(places[rest][1]))
            terms.append(Distance(observation=f"{mover.name}.position", target=end))
    return tuple(entries), tuple(terms)


def _description(level: Level) -> str:
    stem = level.path.stem
    goals = ", ".join(level.shapes[n].name for n in _with_role(level, Role.GOAL))
    targets = ", ".join(level.shapes[n].name for n in _with_role(level, Role.TARGET))
    return f"""Kinetix level "{stem}", pymunk port: bring {goals} to {targets}.

Read from {level.path.name}. This is a port of the level to pymunk, not the simulator that it was
made for: contacts differ, and results are not comparable with published values. docs/kinetix.md
says what is alike and what is not.
"""
