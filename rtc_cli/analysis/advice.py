"""From a distribution of latencies to H, s, the conditioned delay and the training distribution."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtc_cli.analysis.cycles import (
    Cycles,
    Delays,
    Told,
    run_cycles,
    running_max,
    told_constant,
    told_max_of_last,
)

LATE_SHARE = 0.05
"""The estimator with the smallest mean d_cond is taken among those with no more late chunks."""

WORTH_FOLLOWING = 0.25
"""Control steps of mean d_cond that a running maximum has to save against a fixed value."""

EVEN_SHARE = 0.2
"""Share of the training distribution that is even over all legal delays, 0 included."""

LONGEST_HORIZON = 1000  # of a recipe
LINE = 78


@dataclass(frozen=True)
class Choice:
    """The smallest H and s that hold a delay, and what the measured trace makes of them.

    `age` is the mean age of the observation behind an action, in control steps.
    """

    percentile: float
    delay: int
    exec_horizon: int
    horizon: int
    age: float
    cycles: Cycles


@dataclass(frozen=True)
class Recommendation:
    """H, s, what to tell the sampler and what to train on; delays in control steps.

    `delay` is the one that `percentile` of cycles stay within, at the upper end of its interval.
    `fits`: s holds it. `limit` = min(s, H - s) is the largest legal d_cond and D of the training
    support. `largest_exec_horizon` is the largest s that holds `delay`, None where none does.
    `support` and `weights` are empty where a recipe cannot be that long.
    """

    percentile: float
    delay: int
    horizon: int
    horizon_given: bool
    exec_horizon: int
    largest_exec_horizon: int | None
    limit: int
    fits: bool
    estimator: str
    delay_cond: int | None
    support: tuple[int, ...]
    weights: tuple[float, ...]
    cycles: Cycles


def choose(delay: int, percentile: float, delays: Delays) -> Choice:
    """Return the smallest legal H and s for one delay, tried on the delays of the trace."""
    steps = max(delay, 1)
    cycles = run_cycles(delays, steps + delay, steps)
    age = float(delays.mean()) + (steps - 1) / 2
    return Choice(percentile, delay, steps, steps + delay, age, cycles)


def recommend(
    delays: Delays,
    delay: int,
    percentile: float,
    told: Sequence[tuple[str, int]],
    horizon: int | None,
) -> tuple[Recommendation, list[Told]]:
    """Return the recommendation and how the estimators compare under its limit.

    Args:
        delays: (N,) control steps, the stationary part of the trace as measured.
        delay: what s has to hold.
        percentile: share of cycles that stay within it.
        told: fixed values of d_cond that are compared with a running maximum, by name.
        horizon: H where the policy fixes it; otherwise the smallest is taken.
    """
    steps = max(delay, 1)
    chosen = steps + delay if horizon is None else horizon
    fits = steps + delay <= chosen
    if not fits:
        steps = max(chosen // 2, 1)
    limit = min(steps, chosen - steps)
    compared = [told_constant(delays, value, limit, name) for name, value in told]
    running = told_max_of_last(delays, limit)
    best = _best(compared, running)
    fixed = dict(told).get(best.estimator)
    support, weights = _training(delays, limit, fixed)
    return Recommendation(
        percentile=percentile,
        delay=delay,
        horizon=chosen,
        horizon_given=horizon is not None,
        exec_horizon=steps,
        largest_exec_horizon=chosen - delay if fits else None,
        limit=limit,
        fits=fits,
        estimator=best.estimator,
        delay_cond=None if fixed is None else min(fixed, limit),
        support=support,
        weights=weights,
        cycles=run_cycles(delays, chosen, steps),
    ), [*compared, running]


def recipe_snippet(recommendation: Recommendation, delays: Delays) -> str | None:
    """Return keys of a recipe, as TOML; None where H is longer than a recipe allows."""
    if recommendation.horizon > LONGEST_HORIZON:
        return None
    return (
        f"horizon = {recommendation.horizon}\n\n"
        "[train.delays]\n"
        'kind = "weights"\n'
        f"{_array('support', recommendation.support)}\n"
        f"{_array('weights', recommendation.weights)}\n\n"
        "[eval]\n"
        f'protocols = ["fixed:{recommendation.exec_horizon}"]\n'
        f"{_array('delays', _evaluated(recommendation, delays))}\n"
    )


def recipe_overrides(recommendation: Recommendation, delays: Delays) -> tuple[str, ...]:
    """Return the same as texts for `--set`; empty where there is no snippet."""
    if recommendation.horizon > LONGEST_HORIZON:
        return ()
    return (
        f"horizon={recommendation.horizon}",
        "train.delays.kind=weights",
        f"train.delays.support=0-{recommendation.limit}",
        "train.delays.weights=" + ",".join(f"{weight:.4f}" for weight in recommendation.weights),
        f"eval.protocols=fixed:{recommendation.exec_horizon}",
        "eval.delays=" + ",".join(map(str, _evaluated(recommendation, delays))),
    )


def _array(key: str, values: Sequence[float]) -> str:
    """Return a TOML array whose lines fit a terminal."""
    text = ", ".join(f"{value:.4f}" if isinstance(value, float) else str(value) for value in values)
    if len(text) < LINE - 10:
        return f"{key} = [{text}]"
    body = textwrap.fill(text, LINE, initial_indent="  ", subsequent_indent="  ")
    return f"{key} = [\n{body}\n]"


def _best(fixed: Sequence[Told], running: Told) -> Told:
    enough = [told for told in fixed if told.late <= LATE_SHARE]
    best = min(enough, key=lambda told: told.mean, default=None)
    if best is None:
        return min((*fixed, running), key=lambda told: told.late)
    saved = best.mean - running.mean
    return running if running.late <= LATE_SHARE and saved >= WORTH_FOLLOWING else best


def _training(
    delays: Delays, limit: int, fixed: int | None
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """What the sampler will be told, and EVEN_SHARE of every delay that it may be told.

    Empty where no recipe can hold it.
    """
    if limit >= LONGEST_HORIZON:
        return (), ()
    support = range(limit + 1)
    if fixed is None:
        told = running_max(delays, limit)
    else:
        told = np.full(1, min(fixed, limit), dtype=np.int64)
    shares = np.bincount(told, minlength=limit + 1) / told.size
    mixed = (1 - EVEN_SHARE) * shares + EVEN_SHARE / len(support)
    return tuple(support), tuple(round(float(weight), 4) for weight in mixed)


def _evaluated(recommendation: Recommendation, delays: Delays) -> list[int]:
    """Delays worth evaluating at the recommended s: 0, the usual one, d_cond, the longest legal."""
    usual = int(np.median(delays))
    told = recommendation.delay_cond if recommendation.delay_cond is not None else usual
    return sorted({min(d, recommendation.limit) for d in (0, usual, told, recommendation.limit)})
