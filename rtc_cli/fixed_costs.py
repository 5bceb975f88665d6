"""What is around the network in a chunk's latency: vision encoder, prefill, network round trip.

Each cost has a name and is a number of milliseconds, or measured latencies in milliseconds, which
are taken to be independent of the network's own time. Imports nothing heavy.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtc_cli.errors import UsageError

Cost = float | Sequence[float]
"""Milliseconds: one number, or measured ones (a tuple, or a list where JSON was read)."""

FixedCosts = Mapping[str, Cost]

_MOST = 2000
"""Values of a distribution that sums are formed of; more are thinned out to quantiles."""


def check_costs(costs: Mapping[str, Any], source: str = "fixed costs") -> dict[str, Cost]:
    """Return costs as they were read from JSON or given in code; UsageError names a bad one."""
    checked: dict[str, Cost] = {}
    for name, cost in costs.items():
        measured = isinstance(cost, list | tuple)
        values = cost if measured else [cost]
        if not values:
            raise UsageError(f"{source}: {name} has no value", "give numbers >= 0")
        for value in values:
            if not _possible(value):
                raise UsageError(f"{source}: {name} is {value} ms", "give numbers >= 0")
        checked[name] = tuple(map(float, cost)) if measured else float(cost)
    return checked


def typical_ms(cost: Cost) -> float:
    """The number itself, or the median of measured ones."""
    return float(np.median(cost))


def percentile_with(samples_ms: ArrayLike, costs: FixedCosts, percent: float) -> float:
    """Percentile of a latency with its fixed costs added, in ms.

    Exact for costs that are numbers. With measured ones it is that of the sum of independent
    draws, over all pairs; distributions of more than 2,000 values enter as 2,000 quantiles.
    """
    values = np.asarray(samples_ms, np.float64)
    constant = 0.0
    for cost in costs.values():
        if isinstance(cost, Sequence):
            values = np.add.outer(_thinned(values), _thinned(np.asarray(cost))).ravel()
        else:
            constant += cost
    return float(np.percentile(values, percent)) + constant


def say_costs(costs: FixedCosts) -> str:
    """One line for people: "vision 18 ms + network 31 ms (median of 500)"; "" without any."""
    return " + ".join(f"{name} {say_cost(cost)}" for name, cost in costs.items())


def say_cost(cost: Cost) -> str:
    """One cost for people, with its unit."""
    measured = f" (median of {len(cost)})" if isinstance(cost, Sequence) else ""
    return f"{typical_ms(cost):.4g} ms{measured}"


def _possible(value: object) -> bool:
    if not isinstance(value, float | int) or isinstance(value, bool):
        return False
    return math.isfinite(value) and value >= 0


def _thinned(values: NDArray[np.float64]) -> NDArray[np.float64]:
    if values.size <= _MOST:
        return values
    return np.percentile(values, 100 * (np.arange(_MOST) + 0.5) / _MOST)
