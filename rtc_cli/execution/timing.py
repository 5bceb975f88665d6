"""What decides the delays of an evaluation's cell, and when everything happens in its episodes.

A ``Timing`` is what was asked for: model, estimator, what happens to late chunks. A ``Clock`` is
what follows from it for given delays: it depends on no action, only the end of an episode does.

One inference is in flight at a time. It starts at tick t and its chunk arrives d_true ticks later;
the next one starts at t + max(s, d_true). So the execution horizon that an inference meets, the
*realised* s, is the age of the running chunk at that moment: the chunk's first ``age`` actions are
in the past, H - age are left. The sampler is asked for (realised s, d_cond) with

    d_cond = min(estimate, realised s, H - realised s)

which is what ``ChunkGeometry`` allows. A chunk is *late* if d_true > d_cond. It acts from its index
d_true on; it is *dropped* if d_true >= H, or if it is late and late chunks are discarded. A tick at
which the running chunk has no action left executes the hold action: it is *starved*.

``sync`` waits for its chunk however long it takes, and ``oracle`` predicts the state that its chunk
will meet: neither is told a delay, and nothing of theirs is late or dropped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rtc_cli.execution.delay_models import DelayModel, constant, nominal_delay
from rtc_cli.execution.estimators import EXACT, Estimator
from rtc_cli.execution.timeline import HOLD, first_inference

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

OnLate = Literal["play", "discard"]
OnExceed = Literal["play", "clamp", "fail"]
ON_LATE: tuple[str, ...] = get_args(OnLate)
ON_EXCEED: tuple[str, ...] = get_args(OnExceed)

_SPARE = 8  # inferences beyond the last tick: an event near the end is answered by one of them


@dataclass(frozen=True)
class Timing:
    """The delays of a cell, and what is done about them.

    Attributes:
        model: delays as they happen.
        estimator: delays as the sampler is told.
        on_late: whether a late chunk is played from its index d_true on, or discarded.
        on_exceed: what happens if d_cond exceeds the delays that the checkpoint was trained for:
            it is told all the same and the row is flagged, it is clamped, or the evaluation ends.
        observation_lag: the observation at tick t shows t - lag (at the start, tick 0).
    """

    model: DelayModel
    estimator: Estimator = EXACT
    on_late: OnLate = "play"
    on_exceed: OnExceed = "play"
    observation_lag: int = 0

    @property
    def delay(self) -> int:
        """The delay that the cell is filed under: the model's mean in whole steps."""
        return nominal_delay(self.model)

    @property
    def is_plain(self) -> bool:
        """Whether this is one constant delay that everybody knows, and nothing else."""
        rest = (self.estimator.kind, self.on_exceed, self.observation_lag)
        return self.model == constant(self.delay) and rest == ("exact", "play", 0)

    @property
    def columns(self) -> dict[str, str | int]:
        """What a row says about it."""
        return {
            "delay_model": self.model.text,
            "estimator": self.estimator.text,
            "on_late": self.on_late,
            "on_exceed": self.on_exceed,
            "observation_lag": self.observation_lag,
        }

    @property
    def content(self) -> dict[str, Any]:
        """What a result's key holds."""
        return self.columns | {"delay_model": self.model.content}


def plain(delay: int) -> Timing:
    """The timing of one constant delay."""
    return Timing(constant(delay))


@dataclass(frozen=True)
class Clock:
    """When C inferences of n episodes start, and what becomes of their chunks; arrays (n, C).

    Attributes:
        horizon: H.
        schedule: as in ``rtc_cli.execution.timeline``.
        exec_horizon: s of the cell.
        lag: how old observations are, in ticks.
        delay: d_true.
        start: tick at which the inference starts.
        asked_exec_horizon: the realised s, which the sampler is asked with.
        asked_delay: d_cond, which the sampler is asked with.
        left: actions of the running chunk that are unexecuted at the start; H at tick 0.
        kept: whether the chunk is ever used.
        late: d_true > d_cond.
        clipped: the estimate was longer than the geometry allows.
        exceeded: d_cond (before a clamp) exceeds the trained delays.
    """

    horizon: int
    schedule: str
    exec_horizon: int
    lag: int
    delay: IntArray
    start: IntArray
    asked_exec_horizon: IntArray
    asked_delay: IntArray
    left: IntArray
    kept: BoolArray
    late: BoolArray
    clipped: BoolArray
    exceeded: BoolArray

    @property
    def arrival(self) -> IntArray:
        """(n, C) tick from which on the chunk can be used."""
        return self.start + self.delay

    @property
    def steps(self) -> IntArray:
        """(n, C) ticks from one start of inference to the next."""
        return _steps(self.delay, self.exec_horizon, self.schedule)

    def acting(self, ticks: int) -> tuple[IntArray, IntArray]:
        """(n, ticks) number of the acting chunk and index of its action, as a ``Timeline``'s.

        Chunk 0 is the free one, k is that of the k-th inference; both are ``HOLD`` at a tick
        without an action.
        """
        count = len(self.delay)
        number = np.zeros((count, ticks), np.int64)
        episode, inference = np.nonzero(self.kept & (self.arrival < ticks))
        # Of two that arrive in one tick, the one that started later acts.
        np.maximum.at(number, (episode, self.arrival[episode, inference]), inference + 1)
        number = np.maximum.accumulate(number, axis=1)
        due = self.start if self.schedule == "async" else self.arrival
        due = np.concatenate([np.zeros((count, 1), np.int64), due], axis=1)
        index = np.arange(ticks) - np.take_along_axis(due, number, axis=1)
        holds = index >= (self.exec_horizon if self.schedule == "sync" else self.horizon)
        return np.where(holds, HOLD, number), np.where(holds, HOLD, index)

    def reaction(self, ticks: int) -> NDArray[np.float64]:
        """(n, ticks) ticks from an event to the first action that could depend on it.

        As ``timeline.reaction_ticks``; an observation shows an event ``lag`` ticks later, and a
        dropped chunk answers nothing. NaN where no chunk of these inferences answers.
        """
        wait = np.full((len(self.delay), ticks), np.nan)
        event = np.arange(ticks)
        for episode, kept in enumerate(self.kept):
            starts, arrivals = self.start[episode, kept], self.arrival[episode, kept]
            first = np.searchsorted(starts, event + self.lag)
            seen = first < len(starts)
            wait[episode, seen] = arrivals[first[seen]] - event[seen]
        wait[:, 0] = 0
        return wait


def count_inferences(exec_horizon: int, ticks: int, lag: int = 0) -> int:
    """Enough inferences for an episode of ``ticks`` control ticks, and to answer its events."""
    return min(math.ceil((ticks + lag) / exec_horizon) + _SPARE, most_inferences(ticks))


def most_inferences(ticks: int) -> int:
    """Delays drawn for an episode: enough for every cell, so that all cells share them."""
    return 2 * ticks + _SPARE


def make_clock(
    delays: IntArray,
    timing: Timing,
    *,
    horizon: int,
    exec_horizon: int,
    schedule: str,
    trained: int | None = None,
) -> Clock:
    """Lay out episodes whose inferences take ``delays`` (n, C) control steps.

    ``trained`` is the longest delay that the checkpoint was trained for; None for a sampler that
    needs no such training.
    """
    asked = _Asked(delays, timing, horizon, exec_horizon, trained)
    if schedule == "async":
        asked.fill(timing.on_late == "discard")
    elif schedule == "oracle":
        asked.left[:] = _left_of_oracle(delays, horizon, exec_horizon)
    steps = _steps(delays, exec_horizon, schedule)
    start = first_inference(exec_horizon, schedule) + np.cumsum(steps, axis=1) - steps
    return Clock(
        horizon=horizon,
        schedule=schedule,
        exec_horizon=exec_horizon,
        # The oracle is shown the state that its chunk will meet, which is not an observation.
        lag=0 if schedule == "oracle" else timing.observation_lag,
        delay=delays,
        start=start,
        asked_exec_horizon=asked.exec_horizon,
        asked_delay=asked.delay,
        left=asked.left,
        kept=asked.kept,
        late=asked.late,
        clipped=asked.clipped,
        exceeded=asked.exceeded,
    )


def _steps(delays: IntArray, exec_horizon: int, schedule: str) -> IntArray:
    return delays + exec_horizon if schedule == "sync" else np.maximum(delays, exec_horizon)


def _left_of_oracle(delays: IntArray, horizon: int, exec_horizon: int) -> IntArray:
    """Token 0 acts on arrival, so a chunk was used for steps - d ticks when the next one starts."""
    used = np.maximum(delays, exec_horizon) - delays
    return horizon - np.concatenate([np.zeros_like(used[:, :1]), used[:, :-1]], axis=1)


class _Asked:
    """What samplers are asked, inference by inference: each depends on what became of the last."""

    def __init__(
        self, delays: IntArray, timing: Timing, horizon: int, exec_horizon: int, trained: int | None
    ) -> None:
        self._delays, self._horizon, self._nominal = delays, horizon, exec_horizon
        self._estimates = timing.estimator.estimates(delays, timing.delay)
        self._trained = horizon if trained is None else trained
        self._clamps = timing.on_exceed == "clamp"
        self.exec_horizon = np.full_like(delays, exec_horizon)
        self.delay = np.zeros_like(delays)
        self.left = np.zeros_like(delays)
        self.kept = np.ones(delays.shape, bool)
        self.late, self.clipped, self.exceeded = np.zeros((3, *delays.shape), bool)

    def fill(self, discards: bool) -> None:
        """Go through all inferences of the schedule ``async``."""
        left = np.full(len(self._delays), self._horizon)
        for k, delay in enumerate(self._delays.T):
            # The free chunk is as old as the first inference: by convention its overlap is that
            # of the cell's s.
            realised = self._nominal if k == 0 else np.maximum(self._horizon - left, 1)
            told = self._told(k, np.broadcast_to(realised, left.shape))
            self.left[:, k] = left
            self.late[:, k] = delay > told
            self.kept[:, k] = (delay < self._horizon) & ~(discards & self.late[:, k])
            steps = np.maximum(delay, self._nominal)
            unused = np.where(self.kept[:, k], self._horizon, left) - steps
            left = np.maximum(unused, 0)

    def _told(self, k: int, realised: IntArray) -> IntArray:
        longest = np.minimum(realised, self._horizon - realised)
        estimate = self._estimates[:, k]
        told = np.minimum(estimate, longest)
        self.exec_horizon[:, k] = realised
        self.clipped[:, k] = estimate > longest
        self.exceeded[:, k] = told > self._trained
        if self._clamps:
            told = np.minimum(told, self._trained)
        self.delay[:, k] = told
        return told
