"""A level as the arrays that its compiled physics reads.

Only active shapes are kept, in the order of their numbers (polygons, then circles); "body" below is
the place in that order. What the whole capacity of a level decides is kept with the pairs: how
many there are of a kind, and so into how many batches the solver splits them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.kinetix.reading import Level, LevelShape
from rtc_cli.tasks.scene import Role

Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

POLYGONS, CIRCLE_POLYGON, CIRCLES = 0, 1, 2  # kinds of pairs, in the order in which they are solved
NOTHING, SUCCESS, FAILURE = 0, 1, 2  # what a contact means
CORNERS = 4  # vertices that a polygon has room for


class Laws(NamedTuple):
    """Constants of the physics; float32 but for the counts."""

    step_s: np.float32
    gravity_x: np.float32
    gravity_y: np.float32
    slop: np.float32
    contact_rate: np.float32
    joint_velocity: np.float32
    joint_position: np.float32
    joint_stiffness: np.float32
    weld_rate: np.float32
    limit_rate: np.float32
    max_position: np.float32
    max_speed: np.float32
    max_spin: np.float32
    motor_softness: np.float32
    motor_fade: np.float32
    iterations: int
    warm_start: bool


class Bodies(NamedTuple):
    """Bodies (n,); of polygons (p,), which come first, the outline, clockwise.

    `edges` (p, 4, 6) holds per edge: outward normal x, y; the furthest that the polygon reaches
    along it; unit direction x, y; length.
    """

    inverse_mass: Floats
    inverse_inertia: Floats
    radius: Floats
    corners: Indices
    vertices: Floats
    edges: Floats
    moving: Indices


class Pairs(NamedTuple):
    """Pairs (m,) that can touch, by kind, then in the order of the level's list.

    `resolved`: whether a contact pushes. `outcome`: what a contact means. `forgets`: its impulses
    are never kept (see `pack`). `slot` (m + 1,): place of a pair's first point in a world's memory
    of impulses, at last their count. `start` (4,) bounds the kinds, `capacity` (3,) counts all
    pairs of a kind, `batches` (3,) the batches they are solved in.
    """

    a: Indices
    b: Indices
    resolved: Indices
    outcome: Indices
    forgets: Indices
    slot: Indices
    friction: Floats
    restitution: Floats
    start: npt.NDArray[np.int64]
    capacity: npt.NDArray[np.int64]
    batches: npt.NDArray[np.int64]


class Joints(NamedTuple):
    """Joints (j,) that act; `anchors` (j, 4): on a x, y, on b x, y.

    `angles` (j, 3): rotation at 0, lower and upper limit. `motor` (j, 2): speed, power times step.
    """

    a: Indices
    b: Indices
    fixed: Indices
    limited: Indices
    driven: Indices
    binding: Indices
    anchors: Floats
    angles: Floats
    motor: Floats


class Thrusters(NamedTuple):
    """Thrusters (k,); `values` (k, 4): point x, y, angle, power."""

    body: Indices
    binding: Indices
    values: Floats


class Packed(NamedTuple):
    """All that the physics needs of a level; `start` (n, 6): x, y, vx, vy, angle, spin."""

    laws: Laws
    bodies: Bodies
    pairs: Pairs
    joints: Joints
    thrusters: Thrusters
    start: Floats


def pack(level: Level) -> Packed:
    """The arrays of a level.

    The original works through a list of pairs that is filled up with "-1" to whole batches. There
    "-1" means the last pair, whose impulses it sets to 0 after every batch: in a list that had to
    be filled up, the last pair never accumulates.
    """
    shapes = level.shapes
    place = {shape.number: i for i, shape in enumerate(shapes)}
    return Packed(
        laws=_laws(level),
        bodies=_bodies(level),
        pairs=_pairs(level, place),
        joints=_joints(level, place),
        thrusters=_thrusters(level, place),
        start=np.array(
            [(*s.position, *s.velocity, s.rotation, s.spin) for s in shapes], np.float32
        ).reshape(len(shapes), 6),
    )


def _laws(level: Level) -> Laws:
    laws, f = level.laws, np.float32
    return Laws(
        step_s=f(laws.step_s),
        gravity_x=f(level.gravity[0]),
        gravity_y=f(level.gravity[1]),
        slop=f(laws.slop),
        contact_rate=f(laws.contact_rate) / f(laws.step_s),
        joint_velocity=f(laws.joint_velocity_rate),
        joint_position=f(laws.joint_position_rate),
        joint_stiffness=f(laws.joint_stiffness),
        weld_rate=f(laws.weld_rate),
        limit_rate=f(laws.limit_rate),
        max_position=f(laws.max_position),
        max_speed=f(laws.max_speed),
        max_spin=f(laws.max_spin),
        motor_softness=f(laws.motor_softness),
        motor_fade=f(laws.motor_fade),
        iterations=laws.iterations,
        warm_start=laws.warm_start,
    )


def _bodies(level: Level) -> Bodies:
    shapes = level.shapes
    polygons = [shape for shape in shapes if shape.vertices]
    vertices = np.zeros((len(polygons), CORNERS, 2), np.float32)
    edges = np.zeros((len(polygons), CORNERS, 6), np.float32)
    for i, shape in enumerate(polygons):
        own = np.array(shape.vertices, np.float32)
        vertices[i, : len(own)] = own
        edges[i, : len(own)] = _edges(own)
    return Bodies(
        inverse_mass=_floats(shape.inverse_mass for shape in shapes),
        inverse_inertia=_floats(shape.inverse_inertia for shape in shapes),
        radius=_floats(shape.radius for shape in shapes),
        corners=_indices(len(shape.vertices) for shape in polygons),
        vertices=vertices,
        edges=edges,
        moving=_indices(i for i, shape in enumerate(shapes) if level.moves(shape)),
    )


def _edges(vertices: Floats) -> Floats:
    """Normal, reach, direction and length of every edge (c, 6) of an outline (c, 2)."""
    along = np.roll(vertices, -1, axis=0) - vertices
    length = np.sqrt(along[:, :1] ** 2 + along[:, 1:] ** 2)
    along_unit = along / length
    # A quarter turn, with the cosine that π/2 has in float32, as in the original.
    c, s = np.cos(np.float32(np.pi / 2)), np.sin(np.float32(np.pi / 2))
    left = np.stack([c * along[:, 0] - s * along[:, 1], s * along[:, 0] + c * along[:, 1]], 1)
    normal = left / length
    reach = (normal[:, None, 0] * vertices[:, 0] + normal[:, None, 1] * vertices[:, 1]).max(axis=1)
    return np.concatenate([normal, reach[:, None], along_unit, length], axis=1)


class _Pair(NamedTuple):
    kind: int
    a: LevelShape
    b: LevelShape
    last: bool


def _pairs(level: Level, place: dict[int, int]) -> Pairs:
    group = _groups(level)
    laws, f = level.laws, np.float32
    listed = _listed(level)
    capacity = np.array([len(pairs) for pairs in listed])
    batches = -(-capacity // laws.batch_size)
    padded = batches * laws.batch_size > capacity
    shapes = {shape.number: shape for shape in level.shapes}
    kept = [
        _Pair(kind, shapes[i], shapes[j], (i, j) == pairs[-1])
        for kind, pairs in enumerate(listed)
        for i, j in pairs
        if i in shapes and j in shapes and shapes[i].touches(shapes[j])
    ]
    points = [2 if pair.kind == POLYGONS else 1 for pair in kept]
    kinds = np.array([pair.kind for pair in kept], np.int64)
    own = f(laws.friction)

    def friction(pair: _Pair) -> np.float32:
        rough_a, rough_b = f(pair.a.friction) * own, f(pair.b.friction) * own
        return np.sqrt(rough_a * rough_a + rough_b * rough_b)

    def resolved(pair: _Pair) -> bool:
        pushes = pair.a.inverse_mass != 0 or pair.b.inverse_mass != 0
        return pushes and group[pair.a.number] != group[pair.b.number]

    return Pairs(
        a=_indices(place[pair.a.number] for pair in kept),
        b=_indices(place[pair.b.number] for pair in kept),
        resolved=_indices(resolved(pair) for pair in kept),
        outcome=_indices(_outcome(pair.a.role, pair.b.role) for pair in kept),
        forgets=_indices(pair.last and padded[pair.kind] for pair in kept),
        slot=_indices(itertools.accumulate(points, initial=0)),
        friction=_floats(friction(pair) for pair in kept),
        restitution=_floats(min(pair.a.restitution, pair.b.restitution) for pair in kept),
        start=np.searchsorted(kinds, np.arange(4)),
        capacity=capacity,
        batches=batches,
    )


def _listed(level: Level) -> list[list[tuple[int, int]]]:
    """The level's lists of pairs by kind; numbers of shapes, active or not."""
    polygons, circles = level.capacity.polygons, level.capacity.circles
    round_ones = range(polygons, polygons + circles)
    first_free = level.capacity.fixated
    return [
        [(i, j) for i, j in itertools.combinations(range(polygons), 2) if j >= first_free],
        [(i, j) for i in round_ones for j in range(polygons)],
        list(itertools.combinations(round_ones, 2)),
    ]


def _outcome(one: Role, other: Role) -> int:
    return {2: SUCCESS, 3: FAILURE}.get(int(one) * int(other), NOTHING)


def _groups(level: Level) -> dict[int, int]:
    """Number of a shape -> the smallest number among the shapes that joints connect it to."""
    group = {shape.number: shape.number for shape in level.shapes}
    for joint in level.joints:
        one, other = sorted((group[joint.a], group[joint.b]))
        group = {n: one if g == other else g for n, g in group.items()}
    return group


def _joints(level: Level, place: dict[int, int]) -> Joints:
    joints, laws, f = level.acting, level.laws, np.float32
    power = f(laws.motor_power)
    motors = [
        (f(j.motor.speed) * f(laws.motor_speed), power * f(j.motor.power) * f(laws.step_s))
        for j in joints
    ]
    return Joints(
        a=_indices(place[joint.a] for joint in joints),
        b=_indices(place[joint.b] for joint in joints),
        fixed=_indices(joint.fixed for joint in joints),
        limited=_indices(joint.limits is not None for joint in joints),
        driven=_indices(joint.driven for joint in joints),
        binding=_indices(joint.motor.binding for joint in joints),
        anchors=np.array([(*j.on_a, *j.on_b) for j in joints], np.float32).reshape(-1, 4),
        angles=np.array(
            [(j.rotation, *(j.limits or (0.0, 0.0))) for j in joints], np.float32
        ).reshape(-1, 3),
        motor=np.array(motors, np.float32).reshape(-1, 2),
    )


def _thrusters(level: Level, place: dict[int, int]) -> Thrusters:
    rows, f = level.pushing, np.float32
    power = f(level.laws.thruster_power)
    return Thrusters(
        body=_indices(place[row.body] for row in rows),
        binding=_indices(row.binding for row in rows),
        values=np.array(
            [(*row.point, row.angle, f(row.power) * power) for row in rows], np.float32
        ).reshape(-1, 4),
    )


def _floats(values: Iterable[float | np.float32]) -> Floats:
    return np.array(list(values), np.float32)


def _indices(values: Iterable[int]) -> Indices:
    return np.array([int(value) for value in values], np.int64)
