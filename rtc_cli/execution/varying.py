"""Rollouts of cells in which every inference may take another time, and old observations.

What differs from ``rtc_cli.execution.running``: worlds of one tile may have different delays, ages
of their running chunks and requests, so each row of an inference has its own (s, d), and the
physics runs in groups of equal length. A ``Clock`` says beforehand what happens when.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtc_cli.errors import PartialResult
from rtc_cli.execution.delay_models import DelayModel
from rtc_cli.execution.metrics import Layout
from rtc_cli.execution.running import Plan, Rollout, gap, shifted
from rtc_cli.execution.timing import Clock, most_inferences
from rtc_cli.execution.worlds import FloatArray, IntArray
from rtc_cli.tasks.randomness import stream
from rtc_cli.tasks.scene import Scene


def draw_delays(model: DelayModel, scene: Scene, eval_seed: int, episodes: IntArray) -> IntArray:
    """(n, most_inferences) delays of episodes: one sequence each, so that bursts stay.

    Functions of (evaluation seed, task, episode, number of the inference) only, the same for all
    methods, estimators and execution horizons.
    """
    count, purpose = most_inferences(scene.max_ticks), f"delays/{eval_seed}"
    streams = (stream(scene.name, purpose, int(episode)) for episode in episodes)
    return np.stack([model.sequence(generator, count) for generator in streams])


@dataclass(frozen=True)
class VaryingPlan(Plan):
    """The numbers of a cell whose delays vary; ``geometry`` is what it is filed under."""

    clock: Clock
    fails_beyond: int | None = None
    """Longest trained delay, where a longer d_cond ends the cell."""

    @cached_property
    def longest(self) -> int:
        """Ticks that may be executed: the last cycle may reach beyond the end."""
        return self.max_ticks + int(self.clock.steps.max())

    @property
    def inferences(self) -> int:
        """How many inferences of an episode are recorded."""
        return self.clock.delay.shape[1]

    def layout(self) -> Layout:
        """What acts when, for the metrics."""
        chunk, _ = self.clock.acting(self.max_ticks)
        return Layout(
            schedule=self.schedule,
            chunk=chunk,
            ready=self.clock.arrival,
            late=self.clock.late,
            reaction=self.clock.reaction(self.max_ticks),
        )


def count_cases(clock: Clock, lengths: IntArray) -> dict[str, IntArray]:
    """(n,) inferences of episodes of these lengths whose chunk or request was a special case.

    A dropped chunk counts when it arrives, as late ones do; a request when it is made.
    """
    arrived = clock.arrival < lengths[:, None]
    asked = clock.start < lengths[:, None]
    return {
        "dropped_chunks": (arrived & ~clock.kept).sum(axis=1),
        "clipped_requests": (asked & clock.clipped).sum(axis=1),
        "exceeded_requests": (asked & clock.exceeded).sum(axis=1),
    }


class VaryingRollout(Rollout):
    """State of such a cell. ``overlap`` holds all that is left of the running chunk."""

    plan: VaryingPlan

    def __init__(self, plan: VaryingPlan, *rest: Any) -> None:
        super().__init__(plan, *rest)
        # Of the last lag + 1 ticks, the oldest first.
        lag = plan.clock.lag
        self.seen = np.zeros((len(self.position), lag + 1, self.observed.shape[1]), np.float32)

    def _start(self, slots: IntArray) -> None:
        super()._start(slots)
        self.seen[slots] = self.observed[slots][:, None]

    def _entry(self, slots: IntArray) -> tuple[IntArray, IntArray]:
        """Where the clock has what concerns the slots' present inferences."""
        return self.position[slots], self.cycles[slots]

    def _infer(self, slots: IntArray, first: bool) -> Future[FloatArray]:
        if first:
            return super()._infer(slots, first)
        clock, entry = self.plan.clock, self._entry(slots)
        self._check_trained(entry)
        return self.thread.submit(
            self.maker.next,
            self.sampler,
            self._shown(slots),
            self.episodes[entry[0]],
            self.lengths[entry[0]],
            self.overlap[slots, 0],
            (clock.asked_exec_horizon[entry], clock.asked_delay[entry]),
        )

    def _check_trained(self, entry: tuple[IntArray, IntArray]) -> None:
        clock, longest = self.plan.clock, self.plan.fails_beyond
        if longest is None or not clock.exceeded[entry].any():
            return
        row = int(np.argmax(clock.exceeded[entry]))
        position, cycle = entry[0][row], entry[1][row]
        raise PartialResult(
            f"episode {self.episodes[position]}, tick {clock.start[position, cycle]}: the "
            f"conditioned delay {clock.asked_delay[position, cycle]} exceeds {longest}, the "
            "longest that the checkpoint was trained for",
            "use --on-exceed play or clamp, or another estimator",
        )

    def _shown(self, slots: IntArray) -> FloatArray:
        """(m, O) what the policy sees."""
        shown = self.observed[slots]
        if self.plan.schedule == "oracle":
            for delay, rows in self._by_delay(slots):
                if delay:
                    committed = self._running(slots[rows], delay)
                    shown[rows] = self.worlds.predict(committed[:, 1], worlds=slots[rows])
        return shown

    def _by_delay(self, slots: IntArray) -> Iterator[tuple[int, IntArray]]:
        """(d_true, places among the slots that have it), for each delay that occurs."""
        delays = self.plan.clock.delay[self._entry(slots)]
        for delay in np.unique(delays).tolist():
            yield delay, np.flatnonzero(delays == delay)

    def _begin(self, slots: IntArray, chunk: FloatArray) -> None:
        if self.plan.schedule == "sync":
            super()._begin(slots, chunk)
            return
        self.overlap[slots] = chunk
        self.ready.extend(slots.tolist())

    def _cycle(self, slots: IntArray, chunk: FloatArray) -> None:
        steps = self.plan.clock.steps[self._entry(slots)]
        actions = np.zeros((*chunk.shape[:2], steps.max(), chunk.shape[3]), np.float32)
        for delay, rows in self._by_delay(slots):
            due = self._hand_over(slots[rows], chunk[rows], delay)
            actions[rows, :, : due.shape[2]] = due
        self.cycles[slots] += 1
        # Delays up to s make cycles of equal length: the physics runs them together.
        for ticks in np.unique(steps).tolist():
            alike = steps == ticks
            self._execute(slots[alike], actions[alike, :, :ticks])

    def _hand_over(self, slots: IntArray, chunk: FloatArray, delay: int) -> FloatArray:
        """(m, 2, T, A) actions of the cycle of slots with this delay, whose chunks are new.

        What of the chunks (m, 2, H, A) is left after the cycle becomes the overlap.
        """
        schedule, horizon = self.plan.schedule, chunk.shape[2]
        entry = self._entry(slots)
        if schedule == "sync":
            held = np.repeat(self._held(slots)[:, :, None], delay, axis=2)
            return np.concatenate([held, chunk[:, :, : self.plan.exec_horizon]], axis=2)
        kept = self.plan.clock.kept[entry]
        self._compare_kept(slots[kept], chunk[kept, 0], delay, (entry[0][kept], entry[1][kept]))
        steps = max(delay, self.plan.exec_horizon)
        begin = delay if schedule == "async" else 0
        actions = self._running(slots, steps)
        actions[kept, :, delay:] = chunk[kept, :, begin : begin + steps - delay]
        self.overlap[slots] = shifted(self.overlap[slots], steps, horizon)
        self.overlap[slots[kept]] = shifted(chunk[kept], begin + steps - delay, horizon)
        return actions

    def _running(self, slots: IntArray, ticks: int) -> FloatArray:
        """(m, 2, ticks, A) the running chunk from now on, then hold actions: starved ticks."""
        left = self.plan.clock.left[self._entry(slots)]
        tick = np.arange(ticks)
        index = np.clip(np.minimum(tick, left[:, None] - 1), 0, None)
        actions = np.take_along_axis(self.overlap[slots], index[:, None, :, None], axis=2)
        starved = tick >= (left if self.plan.hold == "zero" else np.where(left, ticks, 0))[:, None]
        held = self._held(slots)[:, :, None]
        return np.where(starved[:, None, :, None], held, actions).astype(np.float32)

    def _compare_kept(
        self, slots: IntArray, chunk: FloatArray, delay: int, entry: tuple[IntArray, IntArray]
    ) -> None:
        """Record how far chunks that will be used are from the overlap, as ``_compare`` does."""
        if not len(slots):
            return
        overlap, schedule, clock = self.overlap[slots, 0], self.plan.schedule, self.plan.clock
        asked = self.plan.geometry.horizon - clock.asked_exec_horizon[entry]
        length = np.minimum(asked, clock.left[entry])
        first = delay if schedule == "async" else 0
        if delay < self.plan.geometry.horizon:
            gaps = gap(chunk[:, first], overlap[:, delay])
            self.seam_gap[entry] = np.where(delay < length, gaps, np.nan)
        if delay and schedule == "async" and self.sampler.name != "prefix":
            known = np.arange(delay) < length[:, None]
            gaps = np.where(known, gap(chunk[:, :delay], overlap[:, :delay]), 0.0)
            count = known.sum(axis=1)
            errors = gaps.sum(axis=1) / np.maximum(count, 1)
            self.prefix_error[entry] = np.where(count > 0, errors, np.nan)

    def _step(self, slots: IntArray, actions: FloatArray) -> Any:
        """Run the worlds; with a lag, the last ticks one by one, to see what they show."""
        lag, ticks = self.plan.clock.lag, actions.shape[1]
        if not lag:
            return super()._step(slots, actions)
        pieces = [p for p in (max(ticks - lag, 0), *(1,) * min(lag, ticks)) if p]
        executed, done = np.zeros(len(slots), np.int32), 0
        for piece in pieces:
            record = super()._step(slots, actions[:, done : done + piece])
            done += piece
            executed += record.ticks
            seen = self.seen[slots]
            self.seen[slots] = np.concatenate([seen[:, 1:], record.obs[:, None]], axis=1)
        return replace(record, ticks=executed, obs=self.seen[slots, 0])
