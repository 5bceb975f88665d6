"""Which part of a series of latencies is stationary: its warm-up and its drift."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from rtc_cli.autocorrelation import integrated_time, ranks

FALSE_ALARM = 0.01
"""How often a clean series is said to have a warm-up, and how often a drift, about."""

MATERIAL_DRIFT = 0.02
"""A change of less than this share of the level is not called drift, however certain it is."""

FEWEST_ROWS = 20
"""Shorter series are not searched for a warm-up."""

_WARM_UP_SHARE = 0.2  # a warm-up is looked for in this first share of the series
_PENALTY = 2.0  # of each row, against its surprise -log p, which is 1 on average
_PENALTY_RATE = 0.7968  # solves 1 - r = exp(-_PENALTY r)
_TAIL_INDEX = 2.0  # beyond the slowest known row, surprise grows as under a Pareto tail
_MOST_BLOCKS, _FEWEST_BLOCKS = 40, 8
_ROWS_PER_BLOCK = 10  # at least, and in integrated autocorrelation times
_LOWEST_LEVEL = 0.1

Series = NDArray[np.float64]


@dataclass(frozen=True)
class WarmUp:
    """The first `rows` of a series are slower than what follows; `ratio` of medians. 0: none."""

    rows: int = 0
    ratio: float = 1.0


@dataclass(frozen=True)
class Drift:
    """Slow change of level over `rows` rows: a line through the medians of `blocks` blocks.

    `change` is the whole change as a share of the level in the middle, with its 95% interval; NaN
    where the series is too short to tell. `found`: significant (FALSE_ALARM) and material.
    """

    rows: int
    found: bool = False
    change: float = math.nan
    low: float = math.nan
    high: float = math.nan
    p_value: float = math.nan
    blocks: int = 0

    def levels(self, rows: ArrayLike) -> Series:
        """Level at some rows, 1 in the middle; 1 everywhere where no drift was found."""
        place = (np.asarray(rows, np.float64) + 0.5) / self.rows - 0.5
        slope = self.change if self.found else 0.0
        return np.maximum(1 + slope * place, _LOWEST_LEVEL)


def find_warm_up(values: Series) -> WarmUp:
    """Return the leading transient above the later level, in the first fifth of a series.

    Each row's surprise is -log p, with p its rank among the later rows (drift taken out). Over a
    clean series the running sum of (surprise - 2) drifts down and rises beyond x at any time with
    probability at most exp(-0.797 x) (Lundberg's inequality). A maximum beyond the x of FALSE_ALARM
    is a warm-up, which ends there. Autocorrelated surprises multiply that x by their integrated
    time. Source of the bound: W. Feller, An Introduction to Probability Theory II, XII.5.
    """
    if len(values) < FEWEST_ROWS:
        return WarmUp()
    search = int(_WARM_UP_SHARE * len(values))
    flat = values / find_drift(values[search:]).levels(np.arange(len(values)) - search)
    later = np.sort(flat[search:])
    walk = np.cumsum(_surprise(flat[:search], later) - _PENALTY)
    time = integrated_time(_surprise(flat[search:], later))
    if walk.max() <= -math.log(FALSE_ALARM) / _PENALTY_RATE * time:
        return WarmUp()
    rows = int(walk.argmax()) + 1
    return WarmUp(rows, float(np.median(values[:rows]) / np.median(values[rows:])))


def find_drift(values: Series) -> Drift:
    """Return the slow change of level of a series (N,), by regression on medians of blocks.

    Blocks are at least ten integrated autocorrelation times long where the series allows it, so
    that their medians are nearly independent and the t test of the slope holds.
    """
    count = len(values)
    if count < _FEWEST_BLOCKS * _ROWS_PER_BLOCK:
        return Drift(count)
    rough = _line(values, min(_MOST_BLOCKS, count // _ROWS_PER_BLOCK))
    time = integrated_time(ranks(values - rough.at(np.arange(count))))
    blocks = int(np.clip(count / (_ROWS_PER_BLOCK * time), _FEWEST_BLOCKS, _MOST_BLOCKS))
    line = _line(values, blocks)
    if line.level <= 0:
        return Drift(count)
    change, error = line.slope * count / line.level, line.slope_error * count / line.level
    half = float(stats.t.ppf(0.975, blocks - 2)) * error
    p_value = float(2 * stats.t.sf(abs(change) / error, blocks - 2)) if error else float(not change)
    found = p_value < FALSE_ALARM and abs(change) >= MATERIAL_DRIFT
    return Drift(count, found, change, change - half, change + half, p_value, blocks)


def _surprise(values: Series, later: Series) -> Series:
    """-log of the share of later rows (sorted) that are as slow, extended beyond the slowest."""
    slower = later.size - np.searchsorted(later, values, side="left")
    surprise = np.log((later.size + 1) / (slower + 1.0))
    slowest = max(float(later[-1]), np.finfo(float).tiny)
    return surprise + _TAIL_INDEX * np.log(np.maximum(values / slowest, 1.0))


@dataclass(frozen=True)
class _Line:
    """level + slope (row - middle), with the standard error of the slope (per row)."""

    level: float
    slope: float
    slope_error: float
    middle: float

    def at(self, rows: ArrayLike) -> Series:
        return self.level + self.slope * (np.asarray(rows, np.float64) - self.middle)


def _line(values: Series, blocks: int) -> _Line:
    """Least squares through the medians of equally long blocks; a rest at the start is left out."""
    size = len(values) // blocks
    rest = len(values) - blocks * size
    medians = np.median(values[rest:].reshape(blocks, size), axis=1)
    centres = rest + size * np.arange(blocks) + (size - 1) / 2
    middle = centres.mean()
    spread = float(((centres - middle) ** 2).sum())
    slope = float(((centres - middle) * medians).sum() / spread)
    residuals = medians - medians.mean() - slope * (centres - middle)
    error = math.sqrt(float((residuals**2).sum()) / (blocks - 2) / spread)
    return _Line(float(medians.mean()), slope, error, float(middle))
