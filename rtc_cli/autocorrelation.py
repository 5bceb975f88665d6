"""How far the values of a series depend on those before: what it does to intervals and bootstraps.

Series are (N,), in order of time. A series without any spread counts as uncorrelated.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

_WINDOW = 5.0  # Sokal's window, in integrated times
_QUIET_LAGS = 5  # Politis and White: so many insignificant lags in a row end the correlation


def autocorrelation(values: ArrayLike, lags: int) -> NDArray[np.float64]:
    """(lags + 1,) autocorrelation at lags 0 to `lags`, with divisor N; entry 0 is 1.

    Lags that the series is too short for are 0.
    """
    series = np.asarray(values, dtype=np.float64)
    centred = series - series.mean()
    power = np.abs(np.fft.rfft(centred, 2 * series.size)) ** 2
    products = np.fft.irfft(power)[: series.size]
    result = np.zeros(lags + 1)
    result[0] = 1.0
    count = min(lags + 1, series.size)
    if np.ptp(series) > 0:
        result[1:count] = products[1:count] / products[0]
    return result


def integrated_time(values: ArrayLike) -> float:
    """Integrated autocorrelation time τ = 1 + 2 Σ r(k), at least 1.

    N correlated values tell as much about their mean as N / τ independent ones. The sum ends at
    the first lag that reaches 5 τ (A. Sokal, "Monte Carlo Methods in Statistical Mechanics", 1996).
    """
    series = np.asarray(values, dtype=np.float64)
    lags = series.size // 2
    times = 1 + 2 * np.cumsum(autocorrelation(series, lags)[1:])
    wide = np.flatnonzero(np.arange(1, lags + 1) >= _WINDOW * times)
    if not times.size:
        return 1.0
    return max(1.0, float(times[wide[0]] if wide.size else times.max()))


def block_length(values: ArrayLike) -> float:
    """Mean block length of a stationary bootstrap, from 1 to min(3 √N, N / 3).

    The automatic choice of Politis and White, Econometric Reviews 23 (2004) 53-70, as corrected by
    Patton, Politis and White, the same 28 (2009) 372-375. For an AR(1) process it estimates
    (2ρ / (1 - ρ²))^(2/3) N^(1/3).
    """
    series = np.asarray(values, dtype=np.float64)
    count = series.size
    if count < 4:
        return 1.0
    most = math.ceil(math.sqrt(count)) + _QUIET_LAGS
    correlations = autocorrelation(series, most + _QUIET_LAGS)
    width = min(2 * _last_significant(correlations, count), most)
    lag = np.arange(1, width + 1)
    weighted = np.clip(2 * (1 - lag / max(width, 1)), 0, 1) * correlations[1 : width + 1]
    slope, level = 2 * float((lag * weighted).sum()), 1 + 2 * float(weighted.sum())
    longest = max(1.0, min(3 * math.sqrt(count), count / 3))
    if level <= 0:
        return longest
    return float(np.clip((slope / level) ** 2 * count, 1.0, longest**3) ** (1 / 3))


def ranks(values: ArrayLike) -> NDArray[np.float64]:
    """(N,) ranks from 0 on, ties shared: what one huge value cannot dominate."""
    series = np.asarray(values, dtype=np.float64)
    _, place, counts = np.unique(series, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts + 1) / 2)[place]


def _last_significant(correlations: NDArray[np.float64], count: int) -> int:
    """The lag after which `_QUIET_LAGS` in a row are within noise."""
    noise = 2 * math.sqrt(math.log10(count) / count)
    quiet = np.abs(correlations[1:]) < noise
    for lag in range(quiet.size - _QUIET_LAGS + 1):
        if quiet[lag : lag + _QUIET_LAGS].all():
            return lag
    return int(np.flatnonzero(~quiet)[-1]) + 1
