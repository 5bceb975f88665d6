"""Jax2D, the engine of Kinetix, one world at a time; float32, compiled by numba.

What is computed, in which order and with which constants is the original's, so that worlds follow
it to rounding: jax2d 1.0.1 (`engine.py`) and kinetix-env 3.0.2 (`env.py`). docs/kinetix.md says how
the agreement was measured.

A substep: gravity; contacts of the present places and velocities (`contacts.py`); motors;
thrusters; warm start; some iterations over joints, one by one, and contacts, in batches whose
impulses follow from the same velocities (`solving.py`); then places.
"""

import math

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.kinetix.contacts import find_contacts, place
from rtc_cli.tasks.kinetix.numerics import (
    ANGLE,
    CONTACT_INDICES,
    CONTACT_NUMBERS,
    DRAG,
    NUMBERS,
    ONE,
    PUSH,
    SLOT,
    SPIN,
    VX,
    VY,
    ZERO,
    Memory,
    Scratch,
    X,
    Y,
    clamp,
    compiled,
    or_one,
)
from rtc_cli.tasks.kinetix.packing import (
    CORNERS,
    NOTHING,
    POLYGONS,
    Bodies,
    Floats,
    Indices,
    Joints,
    Laws,
    Packed,
    Pairs,
    Thrusters,
)
from rtc_cli.tasks.kinetix.reading import MOTOR_BINDINGS
from rtc_cli.tasks.kinetix.solving import reach, solve_contacts, solve_joints, start_warm


def make_memory(packed: Packed, worlds: int) -> Memory:
    """Memory of `worlds` worlds at the level's start."""
    points = int(packed.pairs.slot[-1])
    return Memory(
        np.repeat(packed.start[None], worlds, axis=0),
        np.zeros((worlds, len(packed.joints.a), 3), np.float32),
        np.zeros((worlds, points, 2), np.float32),
        np.zeros((worlds, points), np.bool_),
    )


def make_scratch(packed: Packed) -> Scratch:
    """Room for a substep of a level."""
    bodies, points = len(packed.start), int(packed.pairs.slot[-1])
    batches = 2 * packed.pairs.batches[POLYGONS] + packed.pairs.batches[1:].sum()
    scratch = Scratch(
        np.zeros((bodies, 2), np.float32),
        np.zeros((len(packed.bodies.corners), CORNERS, 2), np.float32),
        np.zeros((bodies, 4), np.float32),
        np.zeros((len(packed.joints.a), 4), np.float32),
        np.zeros(len(packed.joints.a), np.float32),
        np.zeros((points, CONTACT_NUMBERS), np.float32),
        np.zeros((points, CONTACT_INDICES), np.int64),
        np.zeros((points, NUMBERS), np.float32),
        np.zeros(points, np.int64),
        np.zeros(batches + 1, np.int64),
    )
    place(packed.bodies, np.arange(bodies, dtype=np.int64), packed.start, scratch)
    return scratch


@compiled
def run(
    laws: Laws,
    shapes: Bodies,
    pairs: Pairs,
    joints: Joints,
    thrusters: Thrusters,
    memory: Memory,
    scratch: Scratch,
    worlds: npt.NDArray[np.int64],
    actions: Floats,
    substeps: int,
    log: Floats,
    outcome: npt.NDArray[np.int8],
    last: npt.NDArray[np.int8],
) -> None:
    """Step worlds (m) under actions (m, T, 6), each to its end at most.

    Writes bodies after every control step to log (m, T, moving, 6), what the first substep that
    ends the episode means to outcome (m, T), what the last substep means to last (m, T). After its
    end a world stands still.
    """
    for row in range(worlds.shape[0]):
        world = worlds[row]
        bodies, pull = memory.bodies[world], memory.joints[world]
        impulses, touching = memory.impulses[world], memory.touching[world]
        ended = False
        for tick in range(actions.shape[1]):
            outcome[row, tick] = NOTHING
            last[row, tick] = NOTHING
            if not ended:
                for _ in range(substeps):
                    meaning = _substep(
                        laws,
                        shapes,
                        pairs,
                        joints,
                        thrusters,
                        bodies,
                        pull,
                        impulses,
                        touching,
                        scratch,
                        actions[row, tick],
                    )
                    if outcome[row, tick] == NOTHING:
                        outcome[row, tick] = meaning
                    last[row, tick] = meaning
                ended = outcome[row, tick] != NOTHING
            for i in range(shapes.moving.shape[0]):
                for k in range(NUMBERS):
                    log[row, tick, i, k] = bodies[shapes.moving[i], k]


@compiled
def _substep(
    laws: Laws,
    shapes: Bodies,
    pairs: Pairs,
    joints: Joints,
    thrusters: Thrusters,
    bodies: Floats,
    pull: Floats,
    impulses: Floats,
    touching: npt.NDArray[np.bool_],
    scratch: Scratch,
    action: Floats,
) -> int:
    """One substep of one world; what its contacts mean."""
    moving = shapes.moving
    for i in range(moving.shape[0]):
        if shapes.inverse_mass[moving[i]] != ZERO:
            bodies[moving[i], VX] += laws.gravity_x * laws.step_s
            bodies[moving[i], VY] += laws.gravity_y * laws.step_s
    place(shapes, moving, bodies, scratch)
    found, groups, meaning = find_contacts(laws, shapes, pairs, bodies, impulses, touching, scratch)
    _drive(laws, shapes, joints, thrusters, bodies, scratch, action)
    reach(joints, scratch.turn, scratch.arms)
    if laws.warm_start:
        start_warm(shapes, joints, bodies, pull, scratch, found)
    else:
        pull[:] = ZERO
    for _ in range(laws.iterations):
        solve_joints(laws, shapes, joints, bodies, pull, scratch.arms)
        solve_contacts(shapes, bodies, scratch, groups)
    if laws.warm_start:
        for c in range(found):
            impulses[scratch.links[c, SLOT], 0] = scratch.contacts[c, PUSH]
            impulses[scratch.links[c, SLOT], 1] = scratch.contacts[c, DRAG]
    _advance(laws, moving, bodies)
    return meaning


@compiled
def _drive(
    laws: Laws,
    shapes: Bodies,
    joints: Joints,
    thrusters: Thrusters,
    bodies: Floats,
    scratch: Scratch,
    action: Floats,
) -> None:
    """Motors, which all see the same spins, then thrusters."""
    turn, turned, count = scratch.turn, scratch.turned, joints.a.shape[0]
    for j in range(count):
        turned[j] = ZERO
        command = clamp(action[joints.binding[j]], -ONE, ONE)
        if joints.driven[j] == 0 or command == ZERO:
            continue
        a, b = joints.a[j], joints.b[j]
        share = ONE / or_one(shapes.inverse_inertia[a] + shapes.inverse_inertia[b])
        push = joints.motor[j, 1] * share
        lag = bodies[b, SPIN] - bodies[a, SPIN] - joints.motor[j, 0] * command
        if joints.limited[j] != 0:
            at = bodies[b, ANGLE] - bodies[a, ANGLE] - joints.angles[j, 0]
            low, high = joints.angles[j, 1] + laws.motor_fade, joints.angles[j, 2] - laws.motor_fade
            beyond = at - clamp(at, low, high)
            if (beyond > ZERO and command > ZERO) or (beyond < ZERO and command < ZERO):
                left = ONE - abs(beyond) / laws.motor_fade
                push *= ZERO if left < ZERO else left
        turned[j] = push * math.tanh(lag * laws.motor_softness)
    for j in range(count):
        bodies[joints.a[j], SPIN] += turned[j] * shapes.inverse_inertia[joints.a[j]]
        bodies[joints.b[j], SPIN] -= turned[j] * shapes.inverse_inertia[joints.b[j]]
    for k in range(thrusters.body.shape[0]):
        i = thrusters.body[k]
        command = clamp(action[MOTOR_BINDINGS + thrusters.binding[k]], ZERO, ONE)
        force = thrusters.values[k, 3] * command * laws.step_s
        angle = thrusters.values[k, 2] + bodies[i, ANGLE]
        dx, dy = math.cos(angle), math.sin(angle)
        u, v = thrusters.values[k, 0], thrusters.values[k, 1]
        rx, ry = turn[i, 0] * u - turn[i, 1] * v, turn[i, 1] * u + turn[i, 0] * v
        bodies[i, SPIN] += shapes.inverse_inertia[i] * (rx * dy - ry * dx) * force
        bodies[i, VX] += shapes.inverse_mass[i] * dx * force
        bodies[i, VY] += shapes.inverse_mass[i] * dy * force


@compiled
def _advance(laws: Laws, moving: Indices, bodies: Floats) -> None:
    """Move bodies by their velocities, and keep both in bounds."""
    far, fast, spin = laws.max_position, laws.max_speed, laws.max_spin
    for k in range(moving.shape[0]):
        i = moving[k]
        bodies[i, X] = clamp(bodies[i, X] + bodies[i, VX] * laws.step_s, -far, far)
        bodies[i, Y] = clamp(bodies[i, Y] + bodies[i, VY] * laws.step_s, -far, far)
        bodies[i, ANGLE] += bodies[i, SPIN] * laws.step_s
        bodies[i, VX] = clamp(bodies[i, VX], -fast, fast)
        bodies[i, VY] = clamp(bodies[i, VY], -fast, fast)
        bodies[i, SPIN] = clamp(bodies[i, SPIN], -spin, spin)
