"""All direct access to Chipmunk: worlds stepped by C-level iteration over ready-made calls.

Pymunk's own methods spend most of a step in attribute access and conversions. Here every world
carries its *program*, a tuple of (function, arguments...) for `MAX_CHUNK` ticks, and
`deque(starmap(operator.call, programs))` runs the programs of a whole shard without returning to
Python. Arguments are views of NumPy memory: a 0-d array where Chipmunk wants a number, a `cpVect`
reference where it wants a vector; filling the arrays is all that a new chunk needs. After each
tick Chipmunk itself appends the states of all bodies to one shared buffer. A contact notes how
full that buffer was, which tells world and tick.

The functions used are private to pymunk. `MISSING` names those that this installation lacks;
unless it is empty, batches use the public interface, which a test holds bit-equal.
"""

from __future__ import annotations

import operator
from collections import deque
from collections.abc import Sequence
from itertools import chain, starmap
from typing import Any

import numpy as np

from rtc_cli.tasks.engine import MAX_CHUNK, SHARD_TICKS, Contact, Engine, Stepped
from rtc_cli.tasks.scene import STATE_SIZE, SUBSTEP_S, SUBSTEPS, Role, Scene, StateArray
from rtc_cli.tasks.world import Drives, World

try:
    from pymunk._chipmunk_cffi import ffi, lib
except ImportError:
    ffi = lib = None

_SYMBOLS = (
    "cpBodyApplyForceAtLocalPoint",
    "cpBodySetAngle",
    "cpBodySetAngularVelocity",
    "cpBodySetPosition",
    "cpBodySetMoment",
    "cpBodySetVelocity",
    "cpConstraintSetMaxForce",
    "cpSimpleMotorSetRate",
    "cpSpaceAddShape",
    "cpSpaceEachBody",
    "cpSpaceRemoveShape",
    "cpSpaceSetCurrentTimeStep",
    "cpSpaceSetShapeIDCounter",
    "cpSpaceStep",
    "pmFloatArrayNew",
    "pmIntArrayNew",
    "pmSpaceBodyGetIteratorFuncBatched",
    "ANGLE",
    "ANGULAR_VELOCITY",
    "POSITION",
    "VELOCITY",
)
MISSING: tuple[str, ...] = tuple(name for name in _SYMBOLS if not hasattr(lib, name))

# Chipmunk appends a body's fields in the order x, y, angle, vx, vy, spin.
_ORDER = [0, 1, 3, 4, 2, 5]
_PARKING_M = 1e5
_PARKING_STEP_S = 1e-9
# C reallocates (and so frees NumPy's memory) when a buffer is full; this much stays unused.
_SLACK = 4096

Call = tuple[Any, ...]


class FastEngine:
    """The `Engine` behind `WorldBatch`: see the module's text."""

    def __init__(self, scene: Scene, n: int) -> None:
        self._scene = scene
        self._drives = Drives.of(scene)
        motors, thrusters, moving = len(scene.motors), len(scene.thrusters), len(scene.moving)
        self._rates = np.zeros((n, MAX_CHUNK, motors))
        self._forces = np.zeros((n, MAX_CHUNK, thrusters, 2))
        self._start = np.zeros((n, moving, STATE_SIZE))
        self._declared = scene.declared_states[list(scene.moving)]
        self._declared[:, [2, 3, 5]] = 0.0
        # The Space's static body is logged too, after the moving ones.
        self._rows = moving + 1
        self._log = _SharedLog(SHARD_TICKS * self._rows * STATE_SIZE)
        self._touched: list[tuple[int, Role]] = []
        self._worlds = [World(scene, self._note) for _ in range(n)]
        self._programs: list[tuple[Call, ...]] = [()] * n
        self._resets: list[tuple[Call, ...]] = [()] * n
        for world in range(n):
            self._compile(world)

    def reset(self, worlds: Sequence[int], states: StateArray) -> None:
        """Park, forget contacts and impulses, place: bit-equal to a new Space."""
        self._start[worlds] = states
        _execute(self._resets[world] for world in worlds)

    def run(self, worlds: Sequence[int], actions: StateArray) -> Stepped:
        """Step worlds one after the other, each through its whole chunk (T ≤ MAX_CHUNK)."""
        rows, ticks = actions.shape[:2]
        self._rates[worlds, :ticks] = self._drives.rates(actions)
        self._forces[worlds, :ticks] = self._drives.forces(actions)
        self._touched.clear()
        self._log.clear()
        stop = ticks * (len(self._programs[0]) // MAX_CHUNK)
        _execute(self._programs[world][:stop] for world in worlds)
        log = self._log.values(rows * ticks * self._rows * STATE_SIZE)
        states = log.reshape(rows, ticks, self._rows, STATE_SIZE)[:, :, :-1, _ORDER]
        per_tick = self._rows * STATE_SIZE
        steps = [(at // per_tick, role) for at, role in self._touched]
        contacts = [Contact(step // ticks, step % ticks, role) for step, role in steps]
        return Stepped(states, contacts)

    def set_velocities(self, world: int, state: StateArray) -> None:
        """Overwrite velocities."""
        self._worlds[world].set_velocities(state)

    def rebuild(self, world: int) -> None:
        """Make a new Space and the calls that go with it."""
        self._worlds[world] = World(self._scene, self._note)
        self._compile(world)

    def copy(self, source: Engine, worlds: Sequence[int]) -> bool:
        """Chipmunk cannot: a Space keeps more than can be read from it."""
        return False

    def _note(self, role: Role) -> None:
        self._touched.append((self._log.filled, role))

    def _compile(self, world: int) -> None:
        handles = _Handles(self._worlds[world])
        self._programs[world] = tuple(self._tick_calls(handles, world))
        calls = [
            *_park_calls(handles),
            *_renew_calls(handles, self._declared),
            *_place_calls(handles, self._start[world]),
            *((lib.cpSimpleMotorSetRate, motor, 0.0) for motor in handles.motors),
        ]
        self._resets[world] = tuple(calls)

    def _tick_calls(self, handles: _Handles, world: int) -> list[Call]:
        calls: list[Call] = []
        step = (lib.cpSpaceStep, handles.space, SUBSTEP_S)
        for tick in range(MAX_CHUNK):
            for i, motor in enumerate(handles.motors):
                calls.append((lib.cpSimpleMotorSetRate, motor, self._rates[world, tick, i, ...]))
            vectors = _vectors(self._forces[world, tick])
            pushes = [
                (lib.cpBodyApplyForceAtLocalPoint, body, vectors[i], point)
                for i, (body, point) in enumerate(handles.thrusters)
            ]
            calls += [*pushes, step] * SUBSTEPS
            calls.append((lib.cpSpaceEachBody, handles.space, *self._log.arguments))
        return calls


class _Handles:
    """C pointers of one world."""

    def __init__(self, world: World) -> None:
        self.space = world.space._space
        self.bodies = [body._body for body in world.bodies]
        # In the order in which they were added (a body's own collection of shapes has none).
        self.shapes = [
            [shape._shape for shape in world.space.shapes if shape.body is body]
            for body in world.bodies
        ]
        self.fixed_shapes = sum(s.body is world.space.static_body for s in world.space.shapes)
        self.moments = [body.moment for body in world.bodies]
        self.motors = [motor._constraint for motor in world.motors]
        # Motors are among the constraints.
        self.constraints = [(c._constraint, c.max_force) for c in world.space.constraints]
        self.thrusters = [(b._body, _vector(p)) for b, p in world.thrusters]


class _SharedLog:
    """A NumPy buffer to which Chipmunk appends the states of a Space's bodies."""

    def __init__(self, size: int) -> None:
        self._memory = np.zeros(size + _SLACK)
        self._floats = lib.pmFloatArrayNew(0)
        self._floats.arr = ffi.from_buffer("cpFloat[]", self._memory)
        self._floats.max = len(self._memory)
        self._data = ffi.new("pmBatchedData *")
        self._data.fields = lib.POSITION | lib.ANGLE | lib.VELOCITY | lib.ANGULAR_VELOCITY
        self._data.floatArray = self._floats
        self._data.intArray = lib.pmIntArrayNew(0)
        self.arguments = (ffi.addressof(lib, "pmSpaceBodyGetIteratorFuncBatched"), self._data)

    @property
    def filled(self) -> int:
        """Numbers appended since `clear`."""
        return int(self._floats.num)

    def clear(self) -> None:
        """Start again at the beginning."""
        self._floats.num = 0

    def values(self, size: int) -> StateArray:
        """The first `size` numbers, which must be all there are."""
        if self.filled != size:
            raise RuntimeError(f"Chipmunk logged {self.filled} numbers, {size} were expected.")
        return self._memory[:size]


def _execute(programs: Any) -> None:
    """Run the calls of all programs in order."""
    deque(starmap(operator.call, chain.from_iterable(programs)), maxlen=0)


def _vector(pair: tuple[float, float]) -> Any:
    """A `cpVect` of its own."""
    return ffi.new("cpVect *", pair)[0]


def _vectors(array: StateArray) -> Any:
    """`cpVect` references into a contiguous array (k, 2)."""
    return ffi.from_buffer("cpVect[]", array) if array.size else ()


def _park_calls(handles: _Handles) -> list[Call]:
    """Forget cached impulses: a minute step with bodies far apart and joints without force.

    The time step is set to 0 afterwards, as if the Space had never been stepped.
    """
    calls: list[Call] = [(lib.cpConstraintSetMaxForce, c, 0.0) for c, _ in handles.constraints]
    for i, body in enumerate(handles.bodies):
        calls.append((lib.cpBodySetPosition, body, _vector((_PARKING_M * (i + 1), -_PARKING_M))))
    calls.append((lib.cpSpaceStep, handles.space, _PARKING_STEP_S))
    calls += [(lib.cpConstraintSetMaxForce, c, force) for c, force in handles.constraints]
    calls.append((lib.cpSpaceSetCurrentTimeStep, handles.space, 0.0))
    return calls


def _renew_calls(handles: _Handles, declared: StateArray) -> list[Call]:
    """Take the shapes of moving bodies out and put them back, at the declared pose.

    That drops contacts, and rebuilds the tree in which Chipmunk looks for pairs: its form decides
    the order in which contacts are solved, and so the last bits, and it remembers where the
    bodies were before.
    """
    space = handles.space
    calls: list[Call] = [
        (lib.cpSpaceRemoveShape, space, shape) for shapes in handles.shapes for shape in shapes
    ]
    calls.append((lib.cpSpaceSetShapeIDCounter, space, handles.fixed_shapes))
    calls += _place_calls(handles, declared)
    for body, shapes, moment in zip(handles.bodies, handles.shapes, handles.moments, strict=True):
        calls += [(lib.cpSpaceAddShape, space, shape) for shape in shapes]
        calls.append((lib.cpBodySetMoment, body, moment))
    return calls


def _place_calls(handles: _Handles, states: StateArray) -> list[Call]:
    """Write states (moving bodies, 6) as they are when called; angle before position."""
    calls: list[Call] = []
    pairs = _vectors(states)
    per_body = STATE_SIZE // 2
    for i, body in enumerate(handles.bodies):
        calls += [
            (lib.cpBodySetAngle, body, states[i, 4, ...]),
            (lib.cpBodySetPosition, body, pairs[i * per_body]),
            (lib.cpBodySetVelocity, body, pairs[i * per_body + 1]),
            (lib.cpBodySetAngularVelocity, body, states[i, 5, ...]),
        ]
    return calls
