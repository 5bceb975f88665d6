"""Percentiles of a stationary series with intervals that allow for its autocorrelation."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from rtc_cli.autocorrelation import integrated_time

CONFIDENCE = 0.95
_BISECTIONS = 60
_SOKAL_WINDOW = 5  # of integrated_time, for its standard error


class Quantile(NamedTuple):
    """A quantile with its interval; an end is NaN where there are too few values for it.

    `effective` is the number of independent values that say as much about this quantile.
    """

    level: float
    value: float
    low: float
    high: float
    effective: float


def quantile_interval(values: ArrayLike, level: float, confidence: float = CONFIDENCE) -> Quantile:
    """Distribution-free interval for the `level` quantile (0 to 1) of a stationary series (N,).

    The r-th of n independent values lies at a Beta(r, n + 1 - r) distributed level. The ends are
    the fractional r at which `level` is cut off with half of the error probability, interpolated
    between neighbouring values (A. D. Hutson, J. Appl. Statist. 26 (1999) 343-353), so coverage is
    not above `confidence` for want of an integer r. n is N / τ, with τ the integrated
    autocorrelation time of being below the quantile, see `_time`.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    value = float(np.quantile(ordered, level, method="weibull"))
    below = np.asarray(values) <= value
    effective = ordered.size / _time(below)
    error = (1 - confidence) / 2
    low, high = (_cut(level, effective, tail) for tail in (1 - error, error))
    scale = (ordered.size + 1) / (effective + 1)
    return Quantile(
        level, value, _at(ordered, low * scale), _at(ordered, high * scale), float(effective)
    )


def needed_for(level: float, confidence: float = CONFIDENCE) -> int:
    """Independent values that are needed for both ends of a quantile's interval."""
    error = (1 - confidence) / 2
    return math.ceil(math.log(error) / math.log(max(level, 1 - level)))


def _time(below: NDArray[np.bool_]) -> float:
    """Integrated autocorrelation time, erring upwards: slow chunks in bursts are few bursts.

    1 where the estimate is within two standard errors of it, else one standard error more than the
    estimate. Without that, intervals of p99 covered 87 to 89% of traces with bursts, not 95%.
    """
    time = integrated_time(below)
    error = time * math.sqrt((4 * _SOKAL_WINDOW * time + 2) / below.size)
    return 1.0 if time < 1 + 2 * error else time + error


def _cut(level: float, count: float, tail: float) -> float:
    """The fractional rank r with P(Beta(r, count + 1 - r) <= level) = tail; it falls with r."""
    low, high = 0.0, count + 1
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if special.betainc(middle, count + 1 - middle, level) > tail:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def _at(ordered: NDArray[np.float64], rank: float) -> float:
    """The value at a fractional rank from 1 to N; NaN beyond."""
    if not 1 <= rank <= ordered.size:
        return math.nan
    return float(np.interp(rank, np.arange(1, ordered.size + 1), ordered))
