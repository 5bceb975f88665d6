"""The analysis of a trace in sentences: what was found, and what to do."""

import math

from rtc_cli.analysis.latency import LATE_LEVEL, LatencyAnalysis
from rtc_cli.analysis.quantiles import Quantile, needed_for
from rtc_cli.analysis.stationary import FEWEST_ROWS

_DEAR_TAIL = 1.5  # a tail that multiplies the delay by this is worth a sentence
_SLACK = {"ceil": 0.0, "nearest": 0.5, "floor": 1.0}  # ticks beyond d that still count as d


def findings(analysis: LatencyAnalysis) -> list[str]:
    """Return short sentences, the warnings of the trace first."""
    return [
        *analysis.trace.warnings,
        *_about_the_source(analysis),
        _warm_up(analysis),
        _drift(analysis),
        _outliers(analysis),
        _bursts(analysis),
        *_bound(analysis),
    ]


def advice(analysis: LatencyAnalysis) -> list[str]:
    """Return what to do, in sentences: H and s, the tail, the conditioned delay."""
    told = [_conditioned(analysis)] if analysis.recommendation.limit else []
    return [*_horizons(analysis), *_tail(analysis), *_dropped(analysis), *told]


def _about_the_source(analysis: LatencyAnalysis) -> list[str]:
    if analysis.trace.kind != "profile":
        return []
    return [
        "These chunks were timed one by one: camera, network and other load are not in them. Add "
        "what is constant with --fixed-ms, or trace the robot itself."
    ]


def _warm_up(analysis: LatencyAnalysis) -> str:
    warm_up = analysis.warm_up
    if len(analysis.trace) < FEWEST_ROWS:
        return f"Fewer than {FEWEST_ROWS} rows: warm-up was not looked for."
    if not warm_up.rows:
        return "No warm-up was found."
    which = "The first chunk is" if warm_up.rows == 1 else f"The first {warm_up.rows} chunks are"
    return (
        f"{which} a warm-up: the median is {warm_up.ratio:.1f} times the later one. It is left out "
        "below; run as many chunks before the robot moves."
    )


def _drift(analysis: LatencyAnalysis) -> str:
    drift = analysis.drift
    if math.isnan(drift.change):
        return "Too few rows to tell whether the level drifts."
    interval = f"(95% interval {drift.low:+.1%} to {drift.high:+.1%})"
    if not drift.found:
        return f"No drift was found: the level changes by {drift.change:+.1%} {interval}."
    end = "end" if drift.change > 0 else "beginning"
    return (
        f"The level drifts by {drift.change:+.1%} over the trace {interval}. Percentiles are those "
        f"at its slower end, the {end}. Find the cause, or trace until the level stays."
    )


def _outliers(analysis: LatencyAnalysis) -> str:
    outliers = analysis.outliers
    limit = f"{outliers.limit_ms:.4g} ms"
    if not outliers.count:
        return f"No outliers: no chunk takes longer than {limit} (upper quartile + 3 IQR)."
    return (
        f"{outliers.share:.1%} of chunks ({outliers.low:.1%} to {outliers.high:.1%}) are outliers: "
        f"slower than {limit} (upper quartile + 3 IQR)."
    )


def _bursts(analysis: LatencyAnalysis) -> str:
    bursts = analysis.bursts
    lag = f"autocorrelation at lag 1 is {bursts.correlation[1]:.2f}"
    if not bursts.found:
        return f"No bursts were found: {lag} (noise: ±{bursts.noise:.2f})."
    again = ""
    if not math.isnan(bursts.late_after_late):
        again = (
            f" After a chunk above the {LATE_LEVEL:.0%} quantile, the next is above it in "
            f"{bursts.late_after_late:.0%} of cases; the longest run is {bursts.longest_run}."
        )
    return f"Chunks are not independent: {lag} (noise: ±{bursts.noise:.2f}).{again}"


def _bound(analysis: LatencyAnalysis) -> list[str]:
    quantile = _asked(analysis)
    if not math.isnan(quantile.high):
        return []
    return [
        f"Too few rows for an upper end of p{100 * quantile.level:g}: they tell as much as "
        f"{quantile.effective:.0f} independent ones, and {needed_for(quantile.level)} are needed. "
        "The slowest chunk is taken instead."
    ]


def _horizons(analysis: LatencyAnalysis) -> list[str]:
    plan = analysis.recommendation
    share = f"{1 - plan.cycles.violated:.1%} of the measured cycles"
    if not plan.fits:
        return _does_not_fit(analysis)
    said = f"d = {plan.delay} at {analysis.hz:g} Hz ({analysis.rounding})"
    held = f"p{100 * plan.percentile:g} with its interval means {said}. "
    if plan.horizon_given:
        s, largest = plan.exec_horizon, plan.largest_exec_horizon
        choice = f"s = {s}" if s == largest else f"s = {s} (up to {largest} is legal)"
        held += f"Within H = {plan.horizon}, use {choice}"
    else:
        held += f"Use H = {plan.horizon} or more and s = {plan.exec_horizon}"
    warm = ""
    if analysis.warm_up.rows:
        warm = f" ({1 - analysis.with_warm_up.violated:.1%} with the warm-up)"
    return [f"{held}: d <= s <= H - d then holds in {share}{warm}."]


def _does_not_fit(analysis: LatencyAnalysis) -> list[str]:
    plan, half = analysis.recommendation, analysis.recommendation.horizon // 2
    ticks = half + _SLACK[analysis.rounding]
    limit_ms = 1000 * ticks / analysis.hz
    bound = _bound_ms(analysis)
    fix = f"Use H >= {max(plan.delay, 1) + plan.delay}"
    if ticks:
        fix += f", a control rate below {1000 * ticks / bound:.3g} Hz, or latencies below "
        fix += f"{limit_ms:.4g} ms"
    return [
        f"H = {plan.horizon} cannot hold d = {plan.delay} (p{100 * plan.percentile:g} at "
        f"{analysis.hz:g} Hz, {analysis.rounding}): no s has d <= s <= H - d. The best, "
        f"s = {plan.exec_horizon}, is violated in {plan.cycles.violated:.1%} of the measured "
        f"cycles. {fix}."
    ]


def _tail(analysis: LatencyAnalysis) -> list[str]:
    """Say what the last percents cost, where they cost much."""
    usual = next(choice for choice in analysis.choices if choice.percentile == LATE_LEVEL)
    plan = analysis.recommendation
    if plan.percentile <= LATE_LEVEL or plan.delay < _DEAR_TAIL * max(usual.delay, 1):
        return []
    return [
        f"The tail is dear: without it (p{100 * LATE_LEVEL:g}) H = {usual.horizon} and "
        f"s = {usual.exec_horizon} would do, and now {usual.cycles.violated:.1%} of cycles violate "
        "that. A timeout or a faster network may be worth more than a longer chunk."
    ]


def _dropped(analysis: LatencyAnalysis) -> list[str]:
    plan = analysis.recommendation
    if not plan.cycles.dropped:
        return []
    return [
        f"{plan.cycles.dropped:.1%} of chunks take H = {plan.horizon} ticks or more, so nothing of "
        f"them is left to use; {plan.cycles.starved:.1%} of ticks have no action."
    ]


def _conditioned(analysis: LatencyAnalysis) -> str:
    plan = analysis.recommendation
    best = next(told for told in analysis.estimators if told.estimator == plan.estimator)
    others = "; ".join(
        f"{told.estimator}: {told.mean:.1f} and {told.late:.1%}"
        for told in analysis.estimators
        if told is not best
    )
    if plan.delay_cond is None:
        what = f"the largest of the last delays ({plan.estimator})"
    else:
        what = f"d_cond = {plan.delay_cond} always ({plan.estimator} of this trace)"
    return (
        f"Tell the sampler {what}: {best.mean:.1f} on average, {best.late:.1%} of chunks come "
        f"later than told ({others})."
    )


def _asked(analysis: LatencyAnalysis) -> Quantile:
    level = analysis.recommendation.percentile
    return next(quantile for quantile in analysis.quantiles if quantile.level == level)


def _bound_ms(analysis: LatencyAnalysis) -> float:
    """The latency that the recommendation is made for."""
    high = _asked(analysis).high
    return float(analysis.stationary_ms.max()) if math.isnan(high) else high
