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
"""

from __future__ import annotations

from dataclasses import dataclass

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


def episode_metrics(
    trace: Trace,
    *,
    horizon: int,
    exec_horizon: int,
    delay: int,
    schedule: str,
    control_hz: float,
) -> dict[str, NDArray[np.generic]]:
    """All metrics of n episodes: name -> (n,) array, NaN where undefined."""
    ticks = trace.actions.shape[1]
    plan = timeline(
        horizon=horizon, exec_horizon=exec_horizon, delay=delay, ticks=ticks, schedule=schedule
    )
    lengths = trace.lengths.astype(np.int64)
    usable = np.array([window.ready for window in plan.inferences], dtype=np.int64)
    counted = usable[None, :] < lengths[:, None]
    holds = np.concatenate([[0], np.cumsum(plan.chunk == HOLD)])
    seconds = lengths / control_hz
    return {
        "time_to_success_s": np.where(trace.solved, seconds, np.nan),
        "throughput_per_min": np.where(trace.solved, 60.0 / np.maximum(seconds, 1e-9), 0.0),
        "seam_jump": _seam_jump(trace.actions, lengths, plan.handovers),
        "seam_gap": _masked_mean(trace.seam_gap, counted & np.isfinite(trace.seam_gap)),
        "prefix_error": _masked_mean(trace.prefix_error, counted & np.isfinite(trace.prefix_error)),
        "action_delta": _difference(trace.actions, lengths, 1),
        "action_delta2": _difference(trace.actions, lengths, 2),
        "starved_ticks": np.zeros(len(lengths), np.int64),
        "late_chunks": np.zeros(len(lengths), np.int64),
        "waiting_ticks": holds[lengths],
        "reaction_ticks": _reaction(lengths, ticks, exec_horizon, delay, schedule),
    }


def _masked_mean(values: Float, mask: NDArray[np.bool_]) -> Float:
    """(n, m) -> (n,) means of the masked entries in float64; NaN where there are none."""
    total = np.where(mask, values, 0.0).astype(np.float64).sum(axis=1)
    count = mask.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _seam_jump(actions: Float, lengths: Int, handovers: Int) -> Float:
    steps = np.linalg.norm(np.diff(actions.astype(np.float64), axis=1), axis=2)
    tick = np.arange(1, actions.shape[1])
    executed = tick[None, :] < lengths[:, None]
    seam = np.isin(tick, handovers)[None, :]
    elsewhere = _masked_mean(steps, executed & ~seam)
    return _masked_mean(steps, executed & seam) / np.where(elsewhere > 0, elsewhere, np.nan)


def _difference(actions: Float, lengths: Int, order: int) -> Float:
    change = np.abs(np.diff(actions.astype(np.float64), n=order, axis=1)).mean(axis=2)
    tick = np.arange(order, actions.shape[1])
    return _masked_mean(change, tick[None, :] < lengths[:, None])


def _reaction(lengths: Int, ticks: int, exec_horizon: int, delay: int, schedule: str) -> Float:
    plan = cycle(exec_horizon, delay, schedule)
    wait = reaction_ticks(plan, first_inference(exec_horizon, schedule), delay, ticks)
    total = np.concatenate([[0], np.cumsum(wait)])[lengths]
    return np.where(lengths > 1, total / np.maximum(lengths - 1, 1), np.nan)
