"""Intervals, differences and their ratios: what a number of episodes and training seeds can tell.

A Wilson interval describes *one checkpoint*. A comparison of methods is over a *fixed* set of
tasks with equal weights; its unit of replication is the training seed. With one seed only,
``paired_by_episode`` describes these checkpoints and nothing more. All fractions are 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from rtc_cli.errors import UsageError


class Interval(NamedTuple):
    """An estimate with the ends of its interval; NaN ends where none can be given."""

    estimate: float
    low: float
    high: float


@dataclass(frozen=True)
class DelayTolerance:
    """D90, the largest delay (control steps, interpolated) with enough success left.

    ``censored`` is ``"<"`` if success is too low at the smallest delay already (``value`` is that
    delay), ``">"`` if it is still enough at the largest, and empty otherwise. ``str`` gives
    ``"2.4"``, ``"< 0"`` or ``"> 4"``.
    """

    value: float
    censored: Literal["", "<", ">"] = ""

    def __str__(self) -> str:
        return f"{self.censored} {self.value:g}" if self.censored else f"{self.value:.1f}"


def wilson(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Wilson score interval of a success rate; all NaN for n = 0."""
    if n < 0 or not 0 <= successes <= n:
        raise UsageError(f"{successes} successes of {n} episodes: must satisfy 0 <= successes <= n")
    if n == 0:
        return Interval(np.nan, np.nan, np.nan)
    z = _normal_quantile(confidence)
    rate = successes / n
    centre = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    # At 0 and n successes the exact end is 0 or 1; rounding must not move it.
    low = 0.0 if successes == 0 else float(centre - half)
    high = 1.0 if successes == n else float(centre + half)
    return Interval(rate, low, high)


def paired_by_seed(differences: ArrayLike, confidence: float = 0.95) -> Interval:
    """Mean paired difference over a fixed set of tasks, replicated over training seeds.

    Args:
        differences: (G, R) differences of success on task k with training seed r, or (R,) for one
            task.
        confidence: coverage of the interval.

    The standard error is ``sqrt(sum_k var_k / R) / G``, var_k the sample variance of task k's R
    differences; t distribution with G (R - 1) degrees of freedom. Ends are NaN for R = 1.
    """
    values = np.atleast_2d(np.asarray(differences, dtype=np.float64))
    if values.ndim != 2 or values.size == 0:
        raise UsageError(f"differences of shape {values.shape}: must be (tasks, seeds), not empty")
    tasks, seeds = values.shape
    estimate = float(values.mean())
    if seeds == 1:
        return Interval(estimate, np.nan, np.nan)
    error = float(np.sqrt(values.var(axis=1, ddof=1).sum() / seeds) / tasks)
    t = float(stats.t.ppf(0.5 + confidence / 2, tasks * (seeds - 1)))
    return Interval(estimate, estimate - t * error, estimate + t * error)


def paired_by_episode(
    differences: Sequence[ArrayLike] | NDArray[np.floating], confidence: float = 0.95
) -> Interval:
    """Mean paired difference for these checkpoints, stratified by task with equal weights.

    Args:
        differences: one array per task with the differences of its n_k episodes (outcome of the
            method minus outcome of the baseline, same episode).
        confidence: coverage of the interval.

    Normal interval with standard error ``sqrt(sum_k var_k / n_k) / G``. It says nothing about
    other training seeds. Ends are NaN where a task has fewer than 2 episodes.
    """
    strata = [np.asarray(values, dtype=np.float64).ravel() for values in differences]
    if not strata or any(values.size == 0 for values in strata):
        raise UsageError("paired_by_episode needs one non-empty array of differences per task")
    estimate = float(np.mean([values.mean() for values in strata]))
    if min(values.size for values in strata) < 2:
        return Interval(estimate, np.nan, np.nan)
    variance = sum(values.var(ddof=1) / values.size for values in strata)
    half = _normal_quantile(confidence) * float(np.sqrt(variance)) / len(strata)
    return Interval(estimate, estimate - half, estimate + half)


def ratio_by_seed(parts: ArrayLike, wholes: ArrayLike, confidence: float = 0.95) -> Interval:
    """Ratio of two mean paired differences over a fixed set of tasks, replicated over seeds.

    Args:
        parts: (G, R) numerators on task k with training seed r, or (R,) for one task.
        wholes: the denominators, of the same shape and from the same episodes.
        confidence: coverage of the interval.

    The ratio of the means over tasks, with Fieller's interval: variances and covariance are those
    of ``paired_by_seed``, on G (R - 1) degrees of freedom. The interval is finite exactly where
    ``paired_by_seed(wholes)`` excludes 0; elsewhere, and for R = 1, the ends are NaN.
    Source: E. C. Fieller, J. R. Statist. Soc. B 16 (1954) 175-185.
    """
    part = np.atleast_2d(np.asarray(parts, dtype=np.float64))
    whole = np.atleast_2d(np.asarray(wholes, dtype=np.float64))
    if part.ndim != 2 or part.size == 0 or part.shape != whole.shape:
        raise UsageError(
            f"parts of shape {part.shape}, wholes of shape {whole.shape}: must be (tasks, seeds), "
            "equal and not empty"
        )
    tasks, seeds = part.shape
    if seeds == 1:
        return Interval(_quotient(part.mean(), whole.mean()), np.nan, np.nan)
    covariances = [np.cov(p, w) / seeds for p, w in zip(part, whole, strict=True)]
    t = float(stats.t.ppf(0.5 + confidence / 2, tasks * (seeds - 1)))
    return _fieller(part.mean(), whole.mean(), np.sum(covariances, axis=0) / tasks**2, t)


def ratio_by_episode(
    parts: Sequence[ArrayLike], wholes: Sequence[ArrayLike], confidence: float = 0.95
) -> Interval:
    """Ratio of two mean paired differences for these checkpoints, stratified by task.

    Args:
        parts: one array per task with the numerators of its n_k episodes.
        wholes: the denominators of the same episodes.
        confidence: coverage of the interval.

    Fieller's interval with the variances of ``paired_by_episode`` and a normal quantile. NaN ends
    where ``paired_by_episode(wholes)`` does not exclude 0 or a task has fewer than 2 episodes.
    """
    pairs = [
        np.stack([np.asarray(p, dtype=np.float64).ravel(), np.asarray(w, dtype=np.float64).ravel()])
        for p, w in zip(parts, wholes, strict=True)
    ]
    if not pairs or any(pair.shape[1] == 0 for pair in pairs):
        raise UsageError("ratio_by_episode needs one non-empty array of differences per task")
    part, whole = np.mean([pair.mean(axis=1) for pair in pairs], axis=0)
    if min(pair.shape[1] for pair in pairs) < 2:
        return Interval(_quotient(part, whole), np.nan, np.nan)
    covariances = [np.cov(pair) / pair.shape[1] for pair in pairs]
    spread = np.sum(covariances, axis=0) / len(pairs) ** 2
    return _fieller(part, whole, spread, _normal_quantile(confidence))


def _quotient(part: float, whole: float) -> float:
    return float(part / whole) if whole else np.nan


def _fieller(
    part: float, whole: float, covariance: NDArray[np.floating], quantile: float
) -> Interval:
    """Solve ``(part - r whole)² <= q² var(part - r whole)`` for the ratio r."""
    estimate = _quotient(part, whole)
    scaled = quantile**2 * covariance
    lead = whole**2 - scaled[1, 1]
    if lead <= 0:
        return Interval(estimate, np.nan, np.nan)
    middle = part * whole - scaled[0, 1]
    # Not negative where lead > 0, but for rounding.
    root = np.sqrt(max(middle**2 - lead * (part**2 - scaled[0, 0]), 0.0))
    return Interval(estimate, float((middle - root) / lead), float((middle + root) / lead))


def d90(
    delays: ArrayLike, success: ArrayLike, reference: float, fraction: float = 0.9
) -> DelayTolerance:
    """Delay tolerance: the largest delay at which success is ≥ ``fraction`` · ``reference``.

    Args:
        delays: (n,) control steps, increasing.
        success: (n,) success rates at these delays, all at the same execution horizon.
        reference: naive's success rate at d = 0 (same checkpoint, same execution horizon).
        fraction: 0.9 by definition of D90.

    Linear interpolation after the last delay that still reaches the level; censored at both ends.
    """
    x = np.asarray(delays, dtype=np.float64)
    y = np.asarray(success, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or x.size == 0 or np.any(np.diff(x) <= 0):
        raise UsageError("d90 needs increasing delays and one success rate for each of them")
    level = fraction * reference
    reached = np.flatnonzero(y >= level)
    if reached.size == 0:
        return DelayTolerance(float(x[0]), "<")
    last = int(reached[-1])
    if last == x.size - 1:
        return DelayTolerance(float(x[last]), ">")
    share = (y[last] - level) / (y[last] - y[last + 1])
    return DelayTolerance(float(x[last] + share * (x[last + 1] - x[last])))


def equivalent(interval: Interval, margin: float) -> bool:
    """Whether an interval lies within ± ``margin``: equivalence within the stated margin."""
    return bool(-margin <= interval.low and interval.high <= margin)


def _normal_quantile(confidence: float) -> float:
    return float(stats.norm.ppf(0.5 + confidence / 2))
