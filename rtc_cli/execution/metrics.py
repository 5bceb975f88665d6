"""Metrics of an episode, from the actions it executed.

Actions are in *normalised* units and as committed: before world noise and clipping. A metric that
is not defined for an episode is NaN here and null in tables and files:

======================  ================================================================ =========
name                    meaning                                                          unit
======================  ================================================================ =========
``time_to_success_s``   length of a solved episode                                       s
``throughput_per_min``  1 / length if solved, else 0                                     1/min
``seam_jump``           mean of norm(a(t) - a(t-1)) at hand-overs / its mean elsewhere   1
``seam_gap``            mean over inferences of norm(new[d] - overlap[d]), if d < H - s  action
``prefix_error``        mean over inferences and i < d of norm(new[i] - committed[i]),   action
                        before pasting; undefined at d = 0 and for sampler ``prefix``
``action_delta``        mean of abs(a(t) - a(t-1)) over ticks and action dims            action
``action_delta2``       the same of second differences                                   action
``starved_ticks``       ticks at which a running chunk had no action left                ticks
``late_chunks``         chunks that came later than the sampler was told                 chunks
``waiting_ticks``       hold ticks while the schedule ``sync`` waits for inference       ticks
``reaction_ticks``      mean, over events visible from ticks 1 to length - 1 on, of the  ticks
                        wait for the next start of inference, plus d
======================  ================================================================ =========

``norm`` is the Euclidean norm over action dims. A hand-over is a tick at which a chunk acts for
the first time while another action went before; hold actions count as actions. With s = 1 every
tick is a hand-over, so ``seam_jump`` is undefined. An inference counts if it became usable within
the episode, that is, t + d < length. Under the schedule ``oracle`` a chunk begins at t + d: its
``seam_gap`` compares new[0] with overlap[d].

Where delays vary, d is that of the inference as it happened, H - s what was left of the running
chunk, and a chunk that is dropped has no gap and no error and answers no event.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtc_cli.execution.timeline import HOLD, cycle, first_inference, reaction_ticks, timeline

Float = NDArray[np.floating]
Int = NDArray[np.integer]


@dataclass(frozen=True)
class Trace:
    """What n episodes executed; entries from an episode's length on are ignored.

    Attributes:
        actions: (n, T, A) executed actions, normalised, before noise.
        lengths: (n,) executed ticks, each ≤ T.
        solved: (n,) bool.
        seam_gap: (n, C) gap of each of the C inferences that start within T ticks, NaN where it
            is undefined.
        prefix_error: (n, C) mismatch of each of them, NaN where it is undefined.
    """

    actions: Float
    lengths: Int
    solved: NDArray[np.bool_]
    seam_gap: Float
    prefix_error: Float


@dataclass(frozen=True)
class Layout:
    """When what acts in n episodes; a leading size of 1 stands for episodes that are all alike.

    Attributes:
        schedule: as in ``rtc_cli.execution.timeline``.
        chunk: (n or 1, T) number of the acting chunk, ``HOLD`` at a tick without an action.
        ready: (n or 1, C) tick from which on the chunk of each inference can be used.
        late: (n or 1, C) whether it comes later than the sampler was told.
        reaction: (n or 1, T) ticks from an event to the first action that could depend on it, NaN
            where there is none.
    """

    schedule: str
    chunk: Int
    ready: Int
    late: NDArray[np.bool_]
    reaction: Float

    @property
    def handover(self) -> NDArray[np.bool_]:
        """(n or 1, T - 1) whether a chunk acts for the first time at ticks 1, 2, ..."""
        order = np.maximum.accumulate(self.chunk, axis=1)
        return (order[:, 1:] > order[:, :-1]) & (self.chunk[:, 1:] != HOLD)


def constant_layout(
    *, horizon: int, exec_horizon: int, delay: int, ticks: int, schedule: str
) -> Layout:
    """The layout of every episode of a legal (H, s, d)."""
    plan = timeline(
        horizon=horizon, exec_horizon=exec_horizon, delay=delay, ticks=ticks, schedule=schedule
    )
    ready = np.array([window.ready for window in plan.inferences], dtype=np.int64)
    each, first = cycle(exec_horizon, delay, schedule), first_inference(exec_horizon, schedule)
    return Layout(
        schedule=schedule,
        chunk=plan.chunk[None],
        ready=ready[None],
        late=np.zeros((1, len(ready)), bool),
        reaction=reaction_ticks(each, first, delay, ticks)[None].astype(np.float64),
    )


def episode_metrics(
    trace: Trace,
    *,
    horizon: int,
    exec_horizon: int,
    delay: int,
    schedule: str,
    control_hz: float,
) -> dict[str, NDArray[np.generic]]:
    """All metrics of n episodes of one (H, s, d): name -> (n,) array, NaN where undefined."""
    layout = constant_layout(
        horizon=horizon,
        exec_horizon=exec_horizon,
        delay=delay,
        ticks=trace.actions.shape[1],
        schedule=schedule,
    )
    return layout_metrics(trace, layout, control_hz)


def layout_metrics(
    trace: Trace, layout: Layout, control_hz: float
) -> dict[str, NDArray[np.generic]]:
    """All metrics of n episodes: name -> (n,) array, NaN where undefined."""
    lengths = trace.lengths.astype(np.int64)
    counted = layout.ready < lengths[:, None]
    holds = up_to(layout.chunk == HOLD, lengths)
    waits = layout.schedule == "sync"
    seconds = lengths / control_hz
    return {
        "time_to_success_s": np.where(trace.solved, seconds, np.nan),
        "throughput_per_min": np.where(trace.solved, 60.0 / np.maximum(seconds, 1e-9), 0.0),
        "seam_jump": _seam_jump(trace.actions, lengths, layout.handover),
        "seam_gap": _masked_mean(trace.seam_gap, counted & np.isfinite(trace.seam_gap)),
        "prefix_error": _masked_mean(trace.prefix_error, counted & np.isfinite(trace.prefix_error)),
        "action_delta": _difference(trace.actions, lengths, 1),
        "action_delta2": _difference(trace.actions, lengths, 2),
        "starved_ticks": np.zeros_like(holds) if waits else holds,
        "late_chunks": (counted & layout.late).sum(axis=1),
        "waiting_ticks": holds if waits else np.zeros_like(holds),
        "reaction_ticks": _reaction(layout.reaction, lengths),
    }


def up_to(values: NDArray[Any], lengths: Int) -> NDArray[Any]:
    """(n or 1, T), (n,) -> (n,) sums over the first ``lengths`` ticks."""
    sums = np.cumsum(values, axis=1)
    sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], axis=1)
    sums = np.broadcast_to(sums, (len(lengths), sums.shape[1]))
    return np.take_along_axis(sums, lengths[:, None], axis=1)[:, 0]


def _masked_mean(values: Float, mask: NDArray[np.bool_]) -> Float:
    """(n, m) -> (n,) means of the masked entries in float64; NaN where there are none."""
    total = np.where(mask, values, 0.0).astype(np.float64).sum(axis=1)
    count = mask.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _seam_jump(actions: Float, lengths: Int, seam: NDArray[np.bool_]) -> Float:
    steps = np.linalg.norm(np.diff(actions.astype(np.float64), axis=1), axis=2)
    tick = np.arange(1, actions.shape[1])
    executed = tick[None, :] < lengths[:, None]
    elsewhere = _masked_mean(steps, executed & ~seam)
    return _masked_mean(steps, executed & seam) / np.where(elsewhere > 0, elsewhere, np.nan)


def _difference(actions: Float, lengths: Int, order: int) -> Float:
    change = np.abs(np.diff(actions.astype(np.float64), n=order, axis=1)).mean(axis=2)
    tick = np.arange(order, actions.shape[1])
    return _masked_mean(change, tick[None, :] < lengths[:, None])


def _reaction(wait: Float, lengths: Int) -> Float:
    """Means over the events visible from tick 1 on, of those that are answered."""
    answered = np.isfinite(wait) & (np.arange(wait.shape[1]) > 0)
    total, count = up_to(np.where(answered, wait, 0.0), lengths), up_to(answered, lengths)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
