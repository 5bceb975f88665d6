"""Cycles of inference under a sequence of delays: what an execution horizon and d_cond lead to.

One inference is in flight at a time; the next starts max(s, d_true) ticks after the last. Delays
are given per inference, in the order of the trace. NumPy and plain Python, nothing is evaluated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Delays = NDArray[np.int64]

MAX_OF_LAST = 10


@dataclass(frozen=True)
class Cycles:
    """Counts over some cycles; shares are of cycles, but `starved` is of control ticks.

    `violated`: not d <= s <= H - d. `starved`: no action was left. `dropped`: d >= H.
    """

    cycles: int
    ticks: int
    violated: float
    starved: float
    dropped: float


@dataclass(frozen=True)
class Told:
    """What an estimator tells the sampler: `mean` d_cond, share of chunks later than that."""

    estimator: str
    mean: float
    low: int
    high: int
    late: float


def run_cycles(delays: ArrayLike, horizon: int, exec_horizon: int) -> Cycles:
    """Go through delays (N,) in control steps at one H and s <= H, legal or not.

    The execution horizon of a cycle is the realised one, max(s, d). Before the first cycle a whole
    chunk is there.
    """
    given = np.asarray(delays, dtype=np.int64)
    realised = np.maximum(given, exec_horizon)
    violated = (given > exec_horizon) | (realised > horizon - given)
    ticks = int(realised.sum())
    return Cycles(
        given.size,
        ticks,
        float(violated.mean()),
        _starved(given, realised, horizon) / max(ticks, 1),
        float((given >= horizon).mean()),
    )


def _starved(delays: Delays, realised: Delays, horizon: int) -> int:
    """Ticks without an action; a dropped chunk leaves the old one to run out."""
    if not (delays >= horizon).any():
        left = np.concatenate([[horizon], horizon - realised[:-1]])
        return int(np.maximum(delays - left, 0).sum())
    starved, remaining = 0, horizon
    for delay, steps in zip(delays.tolist(), realised.tolist(), strict=True):
        is_used = delay < horizon
        starved += max((delay if is_used else steps) - remaining, 0)
        remaining = horizon - steps if is_used else max(remaining - steps, 0)
    return starved


def told_constant(delays: ArrayLike, value: int, limit: int, estimator: str) -> Told:
    """Always tell `value`, at most `limit`, the largest legal delay."""
    given = np.asarray(delays, dtype=np.int64)
    return _told(estimator, given, np.full(given.size, min(value, limit), dtype=np.int64))


def told_max_of_last(delays: ArrayLike, limit: int, last: int = MAX_OF_LAST) -> Told:
    """Tell the largest of the last `last` delays, at most `limit`."""
    given = np.asarray(delays, dtype=np.int64)
    return _told(f"max-of-last:{last}", given, running_max(given, limit, last))


def running_max(delays: Delays, limit: int, last: int = MAX_OF_LAST) -> Delays:
    """(N,) the largest of the `last` delays before each, at most `limit`.

    The first rows have fewer before them; the first is told its own.
    """
    padded = np.concatenate([np.full(last, -1), delays])
    windows = np.lib.stride_tricks.sliding_window_view(padded, last)[: delays.size]
    told = windows.max(axis=1)
    told[:1] = delays[:1]
    return np.minimum(told, limit)


def _told(estimator: str, delays: Delays, told: Delays) -> Told:
    late = float((delays > told).mean())
    return Told(estimator, float(told.mean()), int(told.min()), int(told.max()), late)
