"""Many worlds of one scene in this process: episodes, their random numbers, their ends.

The physics (an `Engine`) only steps and logs. What a logged chunk means is decided here, for all
worlds of a shard at once: the first tick that solves, fails, leaves the bounds or is not finite
ends the episode. A chunk is executed world by world, so the rare world that exceeded a speed limit
inside a chunk has gone too far; it is put back to its start and replayed tick by tick with the
clamp in place. Results therefore do not depend on how ticks are cut into chunks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.tasks import chipmunk
from rtc_cli.tasks.engine import MAX_CHUNK, SHARD_TICKS, Contact, Engine
from rtc_cli.tasks.public import PublicEngine
from rtc_cli.tasks.randomness import action_noise, jitter_numbers
from rtc_cli.tasks.scene import FloatArray, Role, Scene, StateArray, Status

Index = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]


EngineName = Literal["auto", "fast", "public"]


def make_engine(name: EngineName, scene: Scene, n: int) -> Engine:
    """The scene's own engine, or `name`; "auto" is "fast" where this pymunk has what that needs."""
    if name not in get_args(EngineName):
        raise UsageError(f'unknown engine "{name}".' + did_you_mean(name, get_args(EngineName)))
    own = scene.own_engine(n)
    if own is not None:
        return own
    if name == "fast" and chipmunk.MISSING:
        lacking = ", ".join(chipmunk.MISSING)
        raise UsageError(f'engine "fast" needs {lacking}, which this pymunk lacks; use "public".')
    if name == "public" or chipmunk.MISSING:
        return PublicEngine(scene, n)
    return chipmunk.FastEngine(scene, n)


@dataclass(frozen=True)
class Record:
    """What a call of `step` returns, one row per world that was asked.

    obs (m, O) float32 after the last executed tick; status (m,) int8, see `Status`;
    ticks (m,) int32 executed by this call (0 for worlds that had finished before);
    solved_last (m,) whether the last substep solves the episode (`Scene.last_substep_rule`).
    """

    obs: FloatArray
    status: npt.NDArray[np.int8]
    ticks: npt.NDArray[np.int32]
    solved_last: Flags


class _Outcome(NamedTuple):
    """How a chunk of T ticks went in m worlds; a tick that does not come is T.

    `end` is the tick that ends the episode and `fast` the first one with a body above a limit of
    speed; `broken` says whether anything is NaN or infinite at any tick.
    """

    end: Index
    status: npt.NDArray[np.int8]
    fast: Index
    broken: Flags


class LocalBatch:
    """n worlds of a scene, stepped by one engine."""

    def __init__(self, scene: Scene, n: int, engine: EngineName = "auto") -> None:
        self.scene = scene
        self.n = n
        self.invalid_count = 0
        self._engine = make_engine(engine, scene, n)
        self._make_scratch = partial(make_engine, engine, scene, n)
        self._low = scene.action_low.astype(np.float64)
        self._high = scene.action_high.astype(np.float64)
        self._moving = list(scene.moving)
        self.states = np.repeat(scene.declared_states[None], n, axis=0)
        self.status = np.full(n, Status.TIMEOUT, np.int8)
        self.tick = np.zeros(n, np.int32)
        self.solved_last = np.zeros(n, bool)
        self._start = self.states.copy()
        self._careful = np.zeros(n, bool)
        self._noise = np.zeros((n, scene.max_ticks, scene.action_dim))
        self._applied = np.zeros_like(self._noise)

    def reset(self, seeds: npt.NDArray[np.int64], worlds: Index) -> FloatArray:
        """Start episodes `seeds` (m,) in `worlds` (m,); observations (m, O)."""
        numbers = np.stack([jitter_numbers(self.scene, int(seed)) for seed in seeds])
        states = self.scene.initial_states(numbers)
        for world, seed in zip(worlds, seeds, strict=True):
            self._noise[world] = action_noise(self.scene, int(seed))
        self._start[worlds] = states
        self.states[worlds] = states
        self.status[worlds] = Status.RUNNING
        self.tick[worlds] = 0
        self.solved_last[worlds] = False
        self._careful[worlds] = False
        self._engine.reset(worlds.tolist(), states[:, self._moving])
        return self.scene.observe(states)

    def step(self, actions: FloatArray, worlds: Index) -> Record:
        """Run worlds (m,) open loop through actions (m, T, A), physical, without noise."""
        before = self.tick[worlds].copy()
        for first in range(0, actions.shape[1], MAX_CHUNK):
            piece = actions[:, first : first + MAX_CHUNK].astype(np.float64)
            rows = SHARD_TICKS // piece.shape[1]
            for at in range(0, len(worlds), rows):
                with np.errstate(invalid="ignore", over="ignore"):  # worlds may become NaN
                    self._step_shard(piece[at : at + rows], worlds[at : at + rows])
        ticks = self.tick[worlds] - before
        obs = self.scene.observe(self.states[worlds])
        return Record(obs, self.status[worlds], ticks, self.solved_last[worlds])

    def predict(self, actions: FloatArray, worlds: Index) -> FloatArray:
        """What worlds (m,) would show after actions (m, T, A) without noise: obs (m, O).

        Scratch worlds are copies where the physics can copy. Else they repeat the episodes up to
        now, which also gives them the contacts and the solver's cached impulses: bodies' states
        alone predict badly where motors bear weight on contacts. The worlds themselves stay as
        they are.
        """
        states = self.states[worlds]
        running = np.flatnonzero(self.status[worlds] == Status.RUNNING)
        applied = np.clip(actions.astype(np.float64), self._low, self._high)
        size = SHARD_TICKS // MAX_CHUNK
        with np.errstate(invalid="ignore", over="ignore"):  # worlds may become NaN
            for at in range(0, len(running), size):
                self._predict_shard(applied, worlds, running[at : at + size], states)
        return self.scene.observe(states)

    def _predict_shard(
        self, actions: StateArray, worlds: Index, rows: Index, states: StateArray
    ) -> None:
        """Advance `states[rows]` through their actions, each to the tick that ends it at most."""
        if not self._scratch.copy(self._engine, worlds[rows].tolist()):
            self._retrace(worlds[rows])
        for first in range(0, actions.shape[1], MAX_CHUNK):
            piece = actions[rows, first : first + MAX_CHUNK]
            log, contacts, _ = self._scratch.run(worlds[rows].tolist(), piece)
            end, status, _, broken = self._read(log, contacts)
            _mend(self._scratch, worlds[rows[broken]])
            last = np.minimum(end, log.shape[1] - 1)
            states[rows[:, None], self._moving] = log[np.arange(len(rows)), last]
            rows = rows[status == Status.RUNNING]

    def _retrace(self, worlds: Index) -> None:
        """Bring scratch worlds (m,) to the present of their worlds by the actions applied so far.

        Worlds that were pushed or clamped in between end elsewhere; they start from their states.
        """
        self._scratch.reset(worlds.tolist(), self._start[worlds][:, self._moving])
        done = self.tick[worlds]
        reached = self._start[worlds][:, self._moving]
        for first in range(0, int(done.max(initial=0)), MAX_CHUNK):
            count = np.clip(done - first, 0, MAX_CHUNK)
            for ticks in np.unique(count[count > 0]).tolist():
                rows = np.flatnonzero(count == ticks)
                applied = self._applied[worlds[rows], first : first + ticks]
                reached[rows] = self._scratch.run(worlds[rows].tolist(), applied).states[:, -1]
        present = self.states[worlds][:, self._moving]
        astray = np.flatnonzero(_any(reached != present, (1, 2)))
        if len(astray):
            self._scratch.reset(worlds[astray].tolist(), present[astray])

    @cached_property
    def _scratch(self) -> Engine:
        return self._make_scratch()

    def push(self, change: StateArray, worlds: Index) -> None:
        """Add `change` (m, bodies, 3) to the velocities vx, vy and spin of worlds (m,).

        From then on these worlds run tick by tick: a replay could not repeat the push.
        """
        running = self.status[worlds] == Status.RUNNING
        for world, delta in zip(worlds[running], change[running], strict=True):
            self.states[world][self._moving, 2:4] += delta[self._moving, :2]
            self.states[world][self._moving, 5] += delta[self._moving, 2]
            self._careful[world] = True
            self._engine.set_velocities(int(world), self.states[world][self._moving])

    def close(self) -> None:
        """Nothing to give up in one process."""

    def _step_shard(self, actions: StateArray, worlds: Index) -> None:
        """Split the running worlds of a shard by how many ticks they execute, and step them."""
        left = self.scene.max_ticks - self.tick[worlds]
        count = np.minimum(left, actions.shape[1])
        running = self.status[worlds] == Status.RUNNING
        careful = running & self._careful[worlds]
        quick = running & ~careful
        for ticks in np.unique(count[quick]).tolist():
            rows = np.flatnonzero(quick & (count == ticks))
            self._advance(actions[rows, :ticks], worlds[rows])
        for row in np.flatnonzero(careful).tolist():
            self._advance_carefully(actions[row : row + 1, : count[row]], worlds[row : row + 1])

    def _advance(self, actions: StateArray, worlds: Index) -> None:
        """Execute actions (m, T, A) in running worlds (m,) with T ticks left at least."""
        at = self.tick[worlds][:, None] + np.arange(actions.shape[1])
        noisy = actions + self._noise[worlds[:, None], at]
        applied = np.clip(noisy, self._low, self._high)
        self._applied[worlds[:, None], at] = applied
        log, contacts, solved_last = self._engine.run(worlds.tolist(), applied)
        end, status, fast, broken = self._read(log, contacts)
        _mend(self._engine, worlds[broken])
        again = fast < np.minimum(end, actions.shape[1] - 1)
        self._settle(log, end, status, worlds, ~again)
        if solved_last is not None:
            ended = np.flatnonzero(end < actions.shape[1])
            self.solved_last[worlds[ended]] = solved_last[ended, end[ended]]
        for row in np.flatnonzero(again).tolist():
            world = worlds[row : row + 1]
            self._replay(world)
            self._advance_carefully(actions[row : row + 1], world)

    def _advance_carefully(self, actions: StateArray, world: Index) -> None:
        """Execute actions (1, T, A) in one world, tick by tick."""
        for tick in range(actions.shape[1]):
            if self.status[world[0]] != Status.RUNNING:
                return
            self._advance(actions[:, tick : tick + 1], world)

    def _replay(self, world: Index) -> None:
        """Bring one world back to the tick at which the current chunk began, and mark it."""
        self._careful[world] = True
        done = int(self.tick[world[0]])
        start = self._start[world][:, self._moving]
        self._engine.reset(world.tolist(), start)
        for tick in range(done):
            log = self._engine.run(world.tolist(), self._applied[world, tick : tick + 1]).states
            self._clamp(log[:, 0], world)

    def _read(self, log: StateArray, contacts: Sequence[Contact]) -> _Outcome:
        """Read the outcome from states (m, T, moving, 6) and what touched."""
        rows, ticks = log.shape[:2]
        solved = np.full(rows, ticks)
        failed = self._first(self._outside(log))
        for row, tick, role in contacts:
            first = failed if role == Role.HAZARD else solved
            first[row] = min(first[row], tick)
        invalid = self._first(_any(~np.isfinite(log), (2, 3)))
        end = np.minimum(np.minimum(solved, failed), invalid)
        status = np.full(rows, Status.RUNNING, np.int8)
        for value, first in (
            (Status.SOLVED, solved),
            (Status.FAILED, failed),
            (Status.INVALID, invalid),
        ):
            status[(first == end) & (end < ticks)] = value
        fast = self._first(_any(self._too_fast(log), (2,)))
        return _Outcome(end, status, fast, invalid < ticks)

    @staticmethod
    def _first(flags: Flags) -> Index:
        """First true column (m,) of flags (m, T); T where there is none."""
        return np.where(flags.any(axis=1), flags.argmax(axis=1), flags.shape[1])

    def _too_fast(self, states: StateArray) -> Flags:
        """Which bodies exceed a limit; states (..., moving, 6)."""
        square = states[..., 2] ** 2 + states[..., 3] ** 2
        fast: Flags = square > self.scene.max_speed**2
        fast |= np.abs(states[..., 5]) > self.scene.max_spin
        return fast

    def _outside(self, log: StateArray) -> Flags:
        """Ticks (m, T) at which a goal object is out of bounds."""
        if self.scene.bounds is None:
            return np.zeros(log.shape[:2], bool)
        low, high = np.array(self.scene.bounds).reshape(2, 2)
        place = log[:, :, list(self.scene.goal_bodies), 0:2]
        outside: Flags = place < low
        outside |= place > high
        return _any(outside, (2, 3))

    def _settle(
        self,
        log: StateArray,
        end: Index,
        status: npt.NDArray[np.int8],
        worlds: Index,
        keep: Flags,
    ) -> None:
        """Take over the outcome of rows `keep`: ticks, states, status, clamp."""
        rows = np.flatnonzero(keep)
        worlds, status = worlds[rows], status[rows]
        last = np.minimum(end[rows], log.shape[1] - 1)
        self.tick[worlds] += (last + 1).astype(np.int32)
        late = (status == Status.RUNNING) & (self.tick[worlds] >= self.scene.max_ticks)
        self.status[worlds] = np.where(late, Status.TIMEOUT, status)
        states = log[rows, last]
        self._clamp(states, worlds)
        self.states[worlds[:, None], self._moving] = states
        self.invalid_count += int(np.sum(status == Status.INVALID))

    def _clamp(self, states: StateArray, worlds: Index) -> None:
        """Limit the velocities of states (m, moving, 6), in place and in the physics."""
        flags = self._too_fast(states)
        for row in np.flatnonzero(flags.any(axis=1)).tolist():
            state = states[row]
            speed = np.sqrt(state[:, 2] ** 2 + state[:, 3] ** 2)
            state[:, 2:4] *= np.minimum(1.0, self.scene.max_speed / np.maximum(speed, 1e-9))[
                :, None
            ]
            np.clip(state[:, 5], -self.scene.max_spin, self.scene.max_spin, out=state[:, 5])
            self._engine.set_velocities(int(worlds[row]), state)


def _mend(engine: Engine, worlds: Index) -> None:
    """Give new Spaces to worlds in which anything became NaN or infinite, even after their end."""
    for world in worlds.tolist():
        engine.rebuild(world)


def _any(flags: Flags, axes: tuple[int, ...]) -> Flags:
    return np.asarray(flags.any(axis=axes))


def check_worlds(n: int, worlds: npt.ArrayLike | None) -> Index:
    """Indices (m,) of the worlds that a call is about; refuse repeated or missing ones."""
    if worlds is None:
        return np.arange(n)
    index = np.asarray(worlds)
    if index.dtype == bool and index.shape == (n,):
        return np.flatnonzero(index)
    index = index.astype(np.intp).reshape(-1)
    if len(index) and (index.min() < 0 or index.max() >= n):
        raise UsageError(f"worlds {index.tolist()}: allowed are 0 to {n - 1}.")
    if len(np.unique(index)) != len(index):
        raise UsageError(f"worlds {index.tolist()}: each world may be named once.")
    return index
