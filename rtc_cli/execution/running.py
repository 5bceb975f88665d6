"""Episodes while they run: inference in tiles, physics in open-loop pieces, side by side.

One cycle of an episode is one inference followed by one open-loop call of the physics. Here every
cycle of a cell is alike; ``rtc_cli.execution.varying`` has the other kind.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.execution.inference import ChunkMaker
from rtc_cli.execution.reaction import Pushes, measured_reaction
from rtc_cli.execution.timeline import Cycle, cycle, first_inference, timeline
from rtc_cli.execution.worlds import FloatArray, IntArray, Worlds
from rtc_cli.samplers import Sampler, get_sampler
from rtc_cli.tasks.scene import Status

# One inference runs while the next one waits: the thread is never idle while tiles are full.
_IN_FLIGHT = 2


@dataclass(frozen=True)
class Plan:
    """The numbers of a cell that a rollout needs."""

    geometry: ChunkGeometry
    schedule: str
    hold: str
    max_ticks: int

    @property
    def exec_horizon(self) -> int:
        return int(self.geometry.exec_horizon)

    @property
    def delay(self) -> int:
        return int(self.geometry.delay)

    @cached_property
    def cycle(self) -> Cycle:
        return cycle(self.exec_horizon, self.delay, self.schedule)

    @property
    def longest(self) -> int:
        """Ticks that may be executed: the last cycle may reach beyond the end."""
        return self.max_ticks + self.cycle.ticks

    @property
    def inferences(self) -> int:
        """How many inferences of an episode are recorded: all that start within the longest."""
        plan = timeline(
            horizon=self.geometry.horizon,
            exec_horizon=self.exec_horizon,
            delay=self.delay,
            ticks=self.max_ticks,
            schedule=self.schedule,
        )
        return len(plan.inferences)


class Rollout:
    """State of a cell while it runs: arrays per slot (a world), arrays per episode."""

    def __init__(
        self,
        plan: Plan,
        maker: ChunkMaker,
        sampler: Sampler,
        worlds: Worlds,
        thread: ThreadPoolExecutor,
        episodes: IntArray,
    ) -> None:
        self.plan, self.maker, self.worlds, self.thread = plan, maker, worlds, thread
        self.sampler, self.first_sampler = sampler, get_sampler("plain")
        self.episodes = episodes
        horizon, actions = maker.shape
        count, slots = len(episodes), min(len(episodes), worlds.n)
        # Per episode, by position in `episodes`.
        self.executed = np.zeros((count, plan.longest, actions), np.float32)
        self.lengths = np.zeros(count, np.int64)
        self.status = np.zeros(count, np.int8)
        self.solved_last = np.zeros(count, bool)
        self.seam_gap = np.full((count, plan.inferences), np.nan)
        self.prefix_error = np.full((count, plan.inferences), np.nan)
        # Per slot.
        self.position = np.zeros(slots, np.int64)
        self.observed: FloatArray = np.zeros((slots, maker.obs_dim), np.float32)
        # Of two: normalised, and in physical units.
        self.overlap = np.zeros((slots, 2, horizon, actions), np.float32)
        self.last = np.zeros((slots, 2, actions), np.float32)
        self.cycles = np.zeros(slots, np.int64)
        # Slots that wait for their free chunk, and for their next inference.
        self.fresh: deque[int] = deque()
        self.ready: deque[int] = deque()
        self.waiting = deque(range(count))
        self.pending: deque[tuple[bool, IntArray, Future[FloatArray]]] = deque()

    def run(self, progress: Callable[[int, int], None]) -> None:
        """Run all episodes to their end."""
        total = len(self.episodes)
        self._start(np.arange(len(self.position)))
        while self.fresh or self.ready or self.pending:
            self._submit()
            first, slots, future = self.pending.popleft()
            if first:
                self._begin(slots, future.result())
            else:
                self._cycle(slots, future.result())
            progress(int((self.status != Status.RUNNING).sum()), total)

    def reaction_to(self, pushes: Pushes, twin: Rollout) -> NDArray[np.float64]:
        """Measured reaction (m,) of the first m episodes, whose pushed twins ran in `twin`."""
        count = len(twin.episodes)
        lengths = self.lengths[:count], twin.lengths
        return measured_reaction(self.executed[:count], twin.executed, pushes, lengths)

    def _start(self, slots: IntArray) -> None:
        """Put waiting episodes into free slots."""
        slots = slots[: len(self.waiting)]
        if not len(slots):
            return
        positions = np.array([self.waiting.popleft() for _ in slots])
        self.position[slots], self.cycles[slots] = positions, 0
        self.observed[slots] = self.worlds.reset(self.episodes[positions], worlds=slots)
        self.fresh.extend(slots.tolist())

    def _submit(self) -> None:
        """Hand tiles to the inference thread; a tile that is not full only if nothing else runs."""
        while len(self.pending) < _IN_FLIGHT:
            tile = self.maker.tile
            full = [queue for queue in (self.ready, self.fresh) if len(queue) >= tile]
            partial = [queue for queue in (self.fresh, self.ready) if queue]
            if not full and (self.pending or not partial):
                return
            queue = (full or partial)[0]
            slots = np.array([queue.popleft() for _ in range(min(tile, len(queue)))])
            first = queue is self.fresh
            self.pending.append((first, slots, self._infer(slots, first)))

    def _infer(self, slots: IntArray, first: bool) -> Future[FloatArray]:
        positions = self.position[slots]
        observed, episodes = self.observed[slots], self.episodes[positions]
        if first:
            return self.thread.submit(self.maker.first, self.first_sampler, observed, episodes)
        overlap = self.overlap[slots]
        if self.plan.schedule == "oracle" and self.plan.delay:
            observed = self.worlds.predict(overlap[:, 1, : self.plan.delay], worlds=slots)
        ticks = self.lengths[positions]
        return self.thread.submit(
            self.maker.next, self.sampler, observed, episodes, ticks, overlap[:, 0]
        )

    def _begin(self, slots: IntArray, chunk: FloatArray) -> None:
        """Take the free chunk: ``sync`` executes it, the others keep it as the overlap."""
        steps = self.plan.exec_horizon
        if first_inference(steps, self.plan.schedule):
            self._execute(slots, chunk[:, :, :steps])
        else:
            self.overlap[slots] = shifted(chunk, 0, chunk.shape[2] - steps)
            self.ready.extend(slots.tolist())

    def _cycle(self, slots: IntArray, chunk: FloatArray) -> None:
        """Execute one cycle with the new chunk (m, 2, H, A)."""
        plan, overlap = self.plan.cycle, self.overlap[slots]
        if self.plan.schedule != "sync":
            self._compare(slots, chunk[:, 0], overlap[:, 0])
        held = np.repeat(self._held(slots)[:, :, None], plan.hold, axis=2)
        old, new = overlap[:, :, : plan.overlap_stop], chunk[:, :, plan.new_start : plan.new_stop]
        self.overlap[slots] = shifted(chunk, plan.new_stop, chunk.shape[2])
        self._execute(slots, np.concatenate([held, old, new], axis=2))

    def _held(self, slots: IntArray) -> FloatArray:
        """(m, 2, A) hold action of each slot, normalised and physical."""
        if self.plan.hold == "last":
            return self.last[slots]
        return np.broadcast_to(self.maker.zero_action, (len(slots), *self.maker.zero_action.shape))

    def _compare(self, slots: IntArray, chunk: FloatArray, overlap: FloatArray) -> None:
        """Record how far the new chunk is from the overlap, before it is executed."""
        delay, entry = self.plan.delay, (self.position[slots], self.cycles[slots])
        geometry = self.plan.geometry
        if delay < geometry.horizon - geometry.exec_horizon:
            first = self.plan.cycle.new_start
            self.seam_gap[entry] = gap(chunk[:, first], overlap[:, delay])
        # Only under ``async`` does a chunk begin with what is committed; and ``prefix`` returns
        # the committed actions themselves: there is nothing to compare.
        if delay and self.plan.schedule == "async" and self.sampler.name != "prefix":
            self.prefix_error[entry] = gap(chunk[:, :delay], overlap[:, :delay]).mean(axis=1)
        self.cycles[slots] += 1

    def _execute(self, slots: IntArray, actions: FloatArray) -> None:
        """Step the worlds of these slots through actions (m, 2, T, A) open loop.

        Slots whose episode ends are given the next one.
        """
        record = self._step(slots, actions[:, 1])
        positions = self.position[slots]
        ticks = self.lengths[positions][:, None] + np.arange(actions.shape[2])
        self.executed[positions[:, None], ticks] = actions[:, 0]
        self.last[slots] = actions[:, :, -1]
        self.lengths[positions] += record.ticks
        self.status[positions] = record.status
        self.solved_last[positions] = record.solved_last
        self.observed[slots] = record.obs
        running = record.status == Status.RUNNING
        self.ready.extend(slots[running].tolist())
        self._start(slots[~running])

    def _step(self, slots: IntArray, actions: FloatArray) -> Any:
        """Run the worlds through physical actions (m, T, A); the record's obs is what they show."""
        return self.worlds.step(actions, worlds=slots)


def gap(new: FloatArray, old: FloatArray) -> NDArray[np.float64]:
    """Euclidean distances (...) of actions (..., A)."""
    gap: NDArray[np.float64] = np.linalg.norm(new.astype(np.float64) - old, axis=-1)
    return gap


def shifted(chunk: FloatArray, start: int, stop: int) -> FloatArray:
    """``chunk[:, :, start:stop]`` moved to index 0, zeros after it, in the shape of ``chunk``."""
    moved, rest = np.zeros_like(chunk), chunk[:, :, start:stop]
    moved[:, :, : rest.shape[2]] = rest
    return moved
