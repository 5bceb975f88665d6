"""Synthetic latencies of a known law: lognormal body, a tail of slow chunks, warm-up, drift."""

import numpy as np
from scipy import optimize, signal, stats

MEDIAN_MS, SIGMA, TAIL, FACTOR = 90.0, 0.1, 0.02, 3.0


def draw(
    seed: int,
    count: int = 2000,
    *,
    warm_up: int = 0,
    height: float = 4.0,
    drift: float = 0.0,
    correlation: float = 0.0,
    stay: float = TAIL,
) -> np.ndarray:
    """(count,) ms. `warm_up` rows decay from (1 + `height`) times the level, by e every quarter.

    `drift`: linear change over the trace, a share of the level in the middle. `correlation`: of the
    body's logarithms, AR(1). `stay`: chance that a slow chunk follows a slow one (TAIL: none).
    """
    generator = np.random.default_rng([seed, 20_2607])
    normal = generator.standard_normal(count)
    scale = np.sqrt(1 - correlation**2)
    start = [correlation / scale * generator.standard_normal() * scale]
    body = signal.lfilter([scale], [1, -correlation], normal, zi=np.array(start))[0]
    slow = _slow(generator.random(count), stay)
    values = MEDIAN_MS * np.exp(SIGMA * body) * np.where(slow, FACTOR, 1.0)
    values *= 1 + drift * ((np.arange(count) + 0.5) / count - 0.5)
    values[:warm_up] *= 1 + height * np.exp(-4 * np.arange(warm_up) / max(warm_up, 1))
    return values


def _slow(uniform: np.ndarray, stay: float) -> np.ndarray:
    enter = TAIL * (1 - stay) / (1 - TAIL)
    slow, now = np.zeros(uniform.size, bool), False
    for place, number in enumerate(uniform):
        chance = TAIL if place == 0 else stay if now else enter
        slow[place] = now = bool(number < chance)
    return slow


def quantile(level: float) -> float:
    """The quantile of the stationary law, in ms, from its distribution function."""

    def excess(value: float) -> float:
        body = stats.norm.cdf(np.log(value / MEDIAN_MS) / SIGMA)
        tail = stats.norm.cdf(np.log(value / MEDIAN_MS / FACTOR) / SIGMA)
        return (1 - TAIL) * body + TAIL * tail - level

    return float(optimize.brentq(excess, 1.0, 10_000.0, xtol=1e-9))
