"""What a trace of latencies says: its stationary part, its percentiles, and what follows for RTC.

Order of the analysis: the warm-up is cut off, drift is taken out (values are multiplied so that
the level everywhere is that of the slower end), and all the rest describes what is left. Cycles
are counted over the latencies as they were measured.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rtc_cli.analysis.advice import (
    Choice,
    Recommendation,
    choose,
    recipe_overrides,
    recipe_snippet,
    recommend,
)
from rtc_cli.analysis.cycles import Cycles, Delays, Told, run_cycles
from rtc_cli.analysis.quantiles import CONFIDENCE, Quantile, quantile_interval
from rtc_cli.analysis.stationary import Drift, Series, WarmUp, find_drift, find_warm_up
from rtc_cli.autocorrelation import autocorrelation, integrated_time, ranks
from rtc_cli.errors import UsageError
from rtc_cli.intervals import wilson
from rtc_cli.traces import LatencyTrace, to_delays
from rtc_cli.units import Rounding, latency_to_delay

PERCENTILES = (0.5, 0.9, 0.95, 0.99)
LATE_LEVEL = 0.95
"""Chunks slower than this quantile count as late where bursts are looked for."""

_TOLD = (0.95, 0.99)  # fixed d_cond that are compared with a running maximum
_LAGS = 50
_FENCE = 3.0  # interquartile ranges above the upper quartile (Tukey's "far out")
_LEAST_SPREAD = 0.01  # of the median: what the fence takes for the spread of equal values


@dataclass(frozen=True)
class Outliers:
    """Rows above `limit_ms` (upper quartile + 3 interquartile ranges); Wilson interval of share."""

    limit_ms: float
    count: int
    share: float
    low: float
    high: float


@dataclass(frozen=True)
class Bursts:
    """Dependence of one chunk's latency on those before, and what it does to late chunks.

    `correlation` is the autocorrelation of ranks at lags 0, 1, ...; |values| below `noise` mean
    nothing. `time` is its integrated time in chunks. Late: above `late_ms`, a share `late` of rows;
    `late_after_late` is that share among rows after a late one (NaN without any).
    """

    correlation: tuple[float, ...]
    noise: float
    time: float
    late_ms: float
    late: float
    late_after_late: float
    longest_run: int
    mean_run: float

    @property
    def found(self) -> bool:
        """Whether neighbouring chunks, or late ones, depend on each other."""
        # Three standard errors of a share among the late rows, of which there are late * n.
        chance = self.late + 3 * math.sqrt(1 - self.late) * self.noise / 2
        clustered = self.late_after_late > max(2 * self.late, chance)
        return clustered or abs(self.correlation[1]) > 2 * self.noise


@dataclass(frozen=True)
class LatencyAnalysis:
    """Everything that `rtc latency` knows about a trace. Latencies in ms, delays in control steps.

    `stationary_ms` (n,) are the rows after the warm-up, at the level of the slower end where the
    trace drifts; `quantiles` describe them and `delays` (n,) are theirs. `measured` (n,) are the
    delays of the same rows as they were measured.
    """

    trace: LatencyTrace
    hz: float
    rounding: Rounding
    warm_up: WarmUp
    drift: Drift
    stationary_ms: Series
    measured: Delays
    quantiles: tuple[Quantile, ...]
    outliers: Outliers
    bursts: Bursts
    delays: Delays
    choices: tuple[Choice, ...]
    estimators: tuple[Told, ...]
    recommendation: Recommendation
    with_warm_up: Cycles

    def delay_of(self, latency_ms: float) -> int | None:
        """The delay of a latency at this control rate; None for NaN."""
        if math.isnan(latency_ms):
            return None
        return latency_to_delay(latency_ms, self.hz, self.rounding)


def analyse(
    trace: LatencyTrace,
    *,
    hz: float,
    rounding: Rounding = "ceil",
    horizon: int | None = None,
    percentile: float = 0.99,
) -> LatencyAnalysis:
    """Analyse a trace at a control rate.

    `percentile` is the share of cycles that the recommended H and s have to hold; `horizon` is H
    where the policy fixes it. Raises UsageError for a rate, percentile or horizon out of range.
    """
    if not 0.5 <= percentile < 1:
        raise UsageError(f"percentile {percentile:g} is not possible", "give a share in 0.5..0.999")
    if horizon is not None and horizon < 1:
        raise UsageError(f"horizon {horizon} is not possible", "give an integer >= 1")
    latency_to_delay(0.0, hz, rounding)  # refuses a bad rate before anything is computed
    warm_up = find_warm_up(trace.total_ms)
    kept = trace.after(warm_up.rows)
    drift = find_drift(kept.total_ms)
    flat = kept.total_ms / drift.levels(np.arange(len(kept)))
    levels = sorted({*PERCENTILES, percentile})
    quantiles = [_at_slower_end(quantile_interval(flat, level), drift) for level in levels]
    stationary = flat * _slower_end(drift)
    whole = trace.delays(hz, rounding)
    measured = whole[warm_up.rows :]
    held = {q.level: _held(q, stationary, hz, rounding) for q in quantiles}
    shown = [quantile for quantile in quantiles if quantile.level > 0.5]
    choices = [choose(held[q.level], q.level, measured) for q in shown]
    choices.append(choose(int(measured.max()), 1.0, measured))
    told = [(f"percentile:{level:g}", _told_at(quantiles, level, hz, rounding)) for level in _TOLD]
    advice, estimators = recommend(measured, held[percentile], percentile, told, horizon)
    return LatencyAnalysis(
        trace=trace,
        hz=hz,
        rounding=rounding,
        warm_up=warm_up,
        drift=drift,
        stationary_ms=stationary,
        measured=measured,
        quantiles=tuple(quantiles),
        outliers=_outliers(stationary),
        bursts=_bursts(flat),
        delays=to_delays(stationary, hz, rounding),
        choices=tuple(choices),
        estimators=tuple(estimators),
        recommendation=advice,
        with_warm_up=run_cycles(whole, advice.horizon, advice.exec_horizon),
    )


def analysis_document(analysis: LatencyAnalysis) -> dict[str, Any]:
    """Return the analysis as plain values: what `--json` prints and the page is made from.

    NaN stands for what too few rows cannot tell.
    """
    advice, measured = analysis.recommendation, analysis.measured
    delays, counts = np.unique(analysis.delays, return_counts=True)
    return {
        "rows": [_row(analysis, quantile) for quantile in analysis.quantiles] + [_max(analysis)],
        "trace": _trace(analysis.trace),
        "hz": analysis.hz,
        "rounding": analysis.rounding,
        "confidence": CONFIDENCE,
        "warm_up": asdict(analysis.warm_up),
        "drift": asdict(analysis.drift) | {"slower_end": _slower_end(analysis.drift)},
        "outliers": asdict(analysis.outliers),
        "autocorrelation": asdict(analysis.bursts) | {"found": analysis.bursts.found},
        "delays": [
            {"delay": int(delay), "count": int(count), "share": float(count / counts.sum())}
            for delay, count in zip(delays, counts, strict=True)
        ],
        "choices": [asdict(choice) for choice in analysis.choices],
        "estimators": [asdict(told) for told in analysis.estimators],
        "recommendation": asdict(advice),
        "with_warm_up": asdict(analysis.with_warm_up),
        "recipe": recipe_snippet(advice, measured),
        "overrides": list(recipe_overrides(advice, measured)),
        "samples_ms": analysis.trace.total_ms.tolist(),
    }


def _slower_end(drift: Drift) -> float:
    """Level at the slower end of the series, relative to that in the middle."""
    return float(drift.levels([0, drift.rows - 1]).max())


def _at_slower_end(quantile: Quantile, drift: Drift) -> Quantile:
    """Move a quantile from the level in the middle to that of the slower end.

    The level in the middle and the slope are estimated nearly independently, so the squares of
    both uncertainties add up.
    """
    if not drift.found:
        return quantile
    level, value = _slower_end(drift), quantile.value
    slope = value * (drift.high - drift.low) / 4  # half of the half-width lies at each end
    low = level * value - math.hypot(level * (value - quantile.low), slope)
    high = level * value + math.hypot(level * (quantile.high - value), slope)
    return quantile._replace(value=level * value, low=low, high=high)


def _held(quantile: Quantile, stationary: Series, hz: float, rounding: Rounding) -> int:
    """The delay that s has to hold: at the upper end of the interval, or the largest seen."""
    bound = float(stationary.max()) if math.isnan(quantile.high) else quantile.high
    return latency_to_delay(bound, hz, rounding)


def _told_at(quantiles: Sequence[Quantile], level: float, hz: float, rounding: Rounding) -> int:
    value = next(quantile.value for quantile in quantiles if quantile.level == level)
    return latency_to_delay(value, hz, rounding)


def _outliers(values: Series) -> Outliers:
    lower, median, upper = np.percentile(values, [25, 50, 75])
    limit = float(upper + _FENCE * max(upper - lower, _LEAST_SPREAD * median))
    count = int((values > limit).sum())
    share = wilson(count, values.size)
    return Outliers(limit, count, share.estimate, share.low, share.high)


def _bursts(values: Series) -> Bursts:
    order = ranks(values)
    late_ms = float(np.quantile(values, LATE_LEVEL))
    late = values > late_ms
    after = late[1:][late[:-1]]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], late.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return Bursts(
        correlation=tuple(autocorrelation(order, min(_LAGS, values.size - 1)).tolist()),
        noise=2 / math.sqrt(values.size),
        time=integrated_time(order),
        late_ms=late_ms,
        late=float(late.mean()),
        late_after_late=float(after.mean()) if after.size else math.nan,
        longest_run=int(runs.max()) if runs.size else 0,
        mean_run=float(runs.mean()) if runs.size else 0.0,
    )


def _trace(trace: LatencyTrace) -> dict[str, Any]:
    components = {name: float(values.mean()) for name, values in trace.components_ms.items()}
    return {
        "source": trace.source,
        "kind": trace.kind,
        "unit": trace.unit,
        "rows": len(trace),
        "mean_ms_of_components": components,
        "warnings": list(trace.warnings),
    }


def _row(analysis: LatencyAnalysis, quantile: Quantile) -> dict[str, Any]:
    return {
        "percentile": quantile.level,
        "latency_ms": quantile.value,
        "low_ms": quantile.low,
        "high_ms": quantile.high,
        "delay": analysis.delay_of(quantile.value),
        "delay_low": analysis.delay_of(quantile.low),
        "delay_high": analysis.delay_of(quantile.high),
        "effective_rows": quantile.effective,
    }


def _max(analysis: LatencyAnalysis) -> dict[str, Any]:
    slowest = float(analysis.stationary_ms.max())
    return _row(analysis, Quantile(1.0, slowest, math.nan, math.nan, math.nan))
