"""Rollouts of one cell: a policy, a method and a geometry on many episodes of one task.

One cycle of an episode is one inference followed by one open-loop call of the physics. Episodes do
not wait for each other: whatever episodes are ready make up the next tile, so finished episodes
cost no inference, and physics (here) overlaps with inference (one other thread; XLA releases the
interpreter lock). An episode's result is a function of the policy, the cell, the seeds and its
number only, bit for bit, whatever the other episodes, the tiles' composition and the workers.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy
from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.execution.inference import TILE, ChunkMaker
from rtc_cli.execution.methods import Method
from rtc_cli.execution.metrics import Trace, episode_metrics
from rtc_cli.execution.reaction import PushedWorlds, Pushes, draw_pushes, measured_reaction
from rtc_cli.execution.timeline import Cycle, cycle, first_inference, timeline
from rtc_cli.execution.worlds import FloatArray, IntArray, Worlds
from rtc_cli.samplers import Sampler, get_sampler
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

SLOTS = 256
"""Worlds that run at once if the caller brings none: enough to fill tiles, few for the caches."""

HOLDS = ("last", "zero")

# One inference runs while the next one waits: the thread is never idle while tiles are full.
_IN_FLIGHT = 2


def method_sampler(method: Method) -> Sampler:
    """The sampler of a method, with its settings; ``.settings`` has the defaults filled in."""
    return get_sampler(method.sampler, **dict(method.settings))


def is_beyond_trained(
    method: Method, delay: int, trained_support: Sequence[int] | None = None
) -> bool:
    """Whether the sampler conditions on a delay that the checkpoint was not trained for.

    ``trained_support`` is the support of the checkpoint's delay distribution, None for one that
    was trained without delays. Only the sampler ``prefix`` needs such training.
    """
    return method.sampler == "prefix" and delay > max(trained_support or (0,))


def evaluate_cell(
    scene: Scene,
    policy: Policy,
    method: Method,
    geometry: ChunkGeometry,
    *,
    flow_steps: int,
    episodes: Sequence[int],
    eval_seed: int,
    hold: Literal["last", "zero"] = "last",
    tile: int = TILE,
    workers: int = 1,
    trained_support: Sequence[int] | None = None,
    reaction_episodes: int = 0,
    worlds: Worlds | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> pd.DataFrame:
    """Run every episode of a cell once.

    Args:
        scene: the task.
        policy: the checkpoint that ``method.checkpoint`` names.
        method: sampler, settings and schedule.
        geometry: H, s and d; H must be the policy's.
        flow_steps: Euler steps K of the sampler.
        episodes: numbers (and world seeds) of the episodes, each once.
        eval_seed: seed of the chunks' initial noise.
        hold: what ``sync`` executes while it waits: the last action, or zero in physical units.
        tile: rows of one inference.
        workers: processes that step the worlds; ignored if ``worlds`` is given.
        trained_support: support of the delay distribution the checkpoint was trained with.
        reaction_episodes: the first so many episodes run once more, with a push, to measure the
            reaction (``rtc_cli.execution.reaction``).
        worlds: a batch of this scene to reuse, of any size; it is left as it ends up.
        progress: called with (finished episodes, all episodes).

    Returns:
        One row per episode, in the order of ``episodes``: the columns of
        ``rtc_cli.results.EPISODE_COLUMNS`` but ``train_seed``, ``protocol``, ``policy`` and
        ``cell``, which only the caller knows (``rtc_cli.results.relabel``).

    Raises:
        UsageError: the arguments do not fit each other.
        DivergedError: the policy produced NaN or infinity.
    """
    _check(scene, policy, geometry, episodes, hold, tile)
    maker = ChunkMaker(
        policy,
        _asked(geometry, method),
        flow_steps=flow_steps,
        task=scene.name,
        eval_seed=eval_seed,
        tile=tile,
    )
    sampler = method_sampler(method)
    plan = _Plan(geometry, method.schedule, hold, scene.max_ticks)
    numbers = np.asarray(episodes, np.int64)
    with _worlds(scene, len(episodes), workers, worlds) as batch, ThreadPoolExecutor(1) as thread:
        run = _Rollout(plan, maker, sampler, batch, thread, numbers)
        run.run(progress or (lambda done, total: None))
        reaction = np.full(len(numbers), np.nan)
        if reaction_episodes:
            first = numbers[:reaction_episodes]
            pushes = draw_pushes(scene, first, run.lengths[: len(first)], geometry.horizon)
            pushed = PushedWorlds(batch, first, pushes)
            twin = _Rollout(plan, maker, sampler, pushed, thread, first)
            twin.run(lambda done, total: None)
            reaction[: len(first)] = run.reaction_to(pushes, twin)
    return _rows(scene, method, geometry, run, sampler).assign(
        measured_reaction_ticks=reaction,
        flow_steps=flow_steps,
        beyond_trained=is_beyond_trained(method, int(geometry.delay), trained_support),
    )


def _check(
    scene: Scene,
    policy: Policy,
    geometry: ChunkGeometry,
    episodes: Sequence[int],
    hold: str,
    tile: int,
) -> None:
    config = policy.config
    if geometry.horizon != config.horizon:
        raise UsageError(
            f"horizon {geometry.horizon} does not fit a policy of horizon {config.horizon}",
            "evaluate with the horizon that the policy was trained with",
        )
    if (scene.obs_dim, scene.action_dim) != (config.obs_dim, config.action_dim):
        raise UsageError(
            f"task {scene.name} has {scene.obs_dim} observations and {scene.action_dim} actions, "
            f"the policy {config.obs_dim} and {config.action_dim}",
            "evaluate the policy on the task that it was trained on",
        )
    if hold not in HOLDS:
        raise UsageError(f'unknown hold "{hold}".{did_you_mean(hold, HOLDS)}')
    if tile < 1:
        raise UsageError(f"tile {tile} is not possible", "give an integer >= 1")
    if not len(episodes) or len(set(episodes)) != len(episodes):
        raise UsageError(
            f"{len(episodes)} episodes, {len(set(episodes))} of them different: must be at least "
            "one, each once",
            "give every episode number once",
        )


def _asked(geometry: ChunkGeometry, method: Method) -> ChunkGeometry:
    """What the sampler is asked for: only under ``async`` does it begin at index d of its chunk."""
    return geometry if method.schedule == "async" else replace(geometry, delay=0)


@contextmanager
def _worlds(scene: Scene, count: int, workers: int, given: Worlds | None) -> Iterator[Worlds]:
    if given is not None:
        yield given
        return
    with WorldBatch(scene, min(count, SLOTS), workers=workers) as made:
        yield made


@dataclass(frozen=True)
class _Plan:
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
    def inferences(self) -> int:
        """Inferences that start within the longest episode."""
        plan = timeline(
            horizon=self.geometry.horizon,
            exec_horizon=self.exec_horizon,
            delay=self.delay,
            ticks=self.max_ticks,
            schedule=self.schedule,
        )
        return len(plan.inferences)


class _Rollout:
    """State of a cell while it runs: arrays per slot (a world), arrays per episode."""

    def __init__(
        self,
        plan: _Plan,
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
        longest = plan.max_ticks + plan.cycle.ticks
        # Per episode, by position in `episodes`.
        self.executed = np.zeros((count, longest, actions), np.float32)
        self.lengths = np.zeros(count, np.int64)
        self.status = np.zeros(count, np.int8)
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

    def reaction_to(self, pushes: Pushes, twin: _Rollout) -> NDArray[np.float64]:
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
            self.overlap[slots] = _shifted(chunk, 0, chunk.shape[2] - steps)
            self.ready.extend(slots.tolist())

    def _cycle(self, slots: IntArray, chunk: FloatArray) -> None:
        """Execute one cycle with the new chunk (m, 2, H, A)."""
        plan, overlap = self.plan.cycle, self.overlap[slots]
        if self.plan.schedule != "sync":
            self._compare(slots, chunk[:, 0], overlap[:, 0])
        held = np.repeat(self._held(slots)[:, :, None], plan.hold, axis=2)
        old, new = overlap[:, :, : plan.overlap_stop], chunk[:, :, plan.new_start : plan.new_stop]
        self.overlap[slots] = _shifted(chunk, plan.new_stop, chunk.shape[2])
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
            self.seam_gap[entry] = _gap(chunk[:, first], overlap[:, delay])
        # Only under ``async`` does a chunk begin with what is committed; and ``prefix`` returns
        # the committed actions themselves: there is nothing to compare.
        if delay and self.plan.schedule == "async" and self.sampler.name != "prefix":
            self.prefix_error[entry] = _gap(chunk[:, :delay], overlap[:, :delay]).mean(axis=1)
        self.cycles[slots] += 1

    def _execute(self, slots: IntArray, actions: FloatArray) -> None:
        """Step the worlds of these slots through actions (m, 2, T, A) open loop.

        Slots whose episode ends are given the next one.
        """
        record = self.worlds.step(actions[:, 1], worlds=slots)
        positions = self.position[slots]
        ticks = self.lengths[positions][:, None] + np.arange(actions.shape[2])
        self.executed[positions[:, None], ticks] = actions[:, 0]
        self.last[slots] = actions[:, :, -1]
        self.lengths[positions] += record.ticks
        self.status[positions] = record.status
        self.observed[slots] = record.obs
        running = record.status == Status.RUNNING
        self.ready.extend(slots[running].tolist())
        self._start(slots[~running])


def _gap(new: FloatArray, old: FloatArray) -> NDArray[np.float64]:
    """Euclidean distances (...) of actions (..., A)."""
    gap: NDArray[np.float64] = np.linalg.norm(new.astype(np.float64) - old, axis=-1)
    return gap


def _shifted(chunk: FloatArray, start: int, stop: int) -> FloatArray:
    """``chunk[:, :, start:stop]`` moved to index 0, zeros after it, in the shape of ``chunk``."""
    moved = np.zeros_like(chunk)
    moved[:, :, : stop - start] = chunk[:, :, start:stop]
    return moved


def _rows(
    scene: Scene, method: Method, geometry: ChunkGeometry, run: _Rollout, sampler: Sampler
) -> pd.DataFrame:
    solved = run.status == Status.SOLVED
    trace = Trace(
        actions=run.executed[:, : scene.max_ticks],
        lengths=run.lengths,
        solved=solved,
        seam_gap=run.seam_gap,
        prefix_error=run.prefix_error,
    )
    exec_horizon, delay = int(geometry.exec_horizon), int(geometry.delay)
    metrics = episode_metrics(
        trace,
        horizon=geometry.horizon,
        exec_horizon=exec_horizon,
        delay=delay,
        schedule=method.schedule,
        control_hz=scene.control_hz,
    )
    columns: dict[str, NDArray[np.generic] | str | float] = {
        "task": scene.name,
        "method": method.name,
        "checkpoint": method.checkpoint,
        "sampler": method.sampler,
        "settings": json.dumps(sampler.settings, sort_keys=True),
        "schedule": method.schedule,
        "delay": delay,
        "exec_horizon": exec_horizon,
        "action_noise": scene.action_noise,
        "episode": run.episodes,
        "status": run.status.astype(np.int64),
        "solved": solved,
        "length": run.lengths,
        "scene": scene.digest,
    }
    return pd.DataFrame(columns | metrics)
