"""Equal hardware: every method gets the delay that its own measured latency makes.

A constant delay for all methods hides what guidance and flow steps cost. Here each (method, K) is
charged with the latency that its sampler was measured at, with what is around the network added,
and evaluated at the delay that follows at the control rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtc_cli.errors import StateError, UsageError, did_you_mean
from rtc_cli.files import read_json
from rtc_cli.fixed_costs import FixedCosts, check_costs, percentile_with, say_cost
from rtc_cli.recipe import recipes_folder
from rtc_cli.units import Rounding, latency_to_delay

_SHIPPED = "latencies"


@dataclass(frozen=True)
class Charge:
    """What one method pays with K flow steps: latency in ms, delay in control steps."""

    method: str
    flow_steps: int
    latency_ms: float
    delay: int


def list_latencies() -> tuple[str, ...]:
    """Return the names of the published latencies that are shipped."""
    return tuple(sorted(file.stem for file in (recipes_folder() / _SHIPPED).glob("*.json")))


def find_latencies(name_or_path: str) -> Path:
    """Return the file of a shipped name or a path; UsageError with the nearest name."""
    if name_or_path in list_latencies():
        return recipes_folder() / _SHIPPED / f"{name_or_path}.json"
    path = Path(name_or_path)
    if not path.is_file():
        raise UsageError(
            f'no latencies "{name_or_path}".{did_you_mean(name_or_path, list_latencies())}',
            f"give a profile's JSON file, or one of these: {', '.join(list_latencies())}",
        )
    return path


def read_charges(
    path: Path,
    samplers: Mapping[str, str],
    *,
    fixed_ms: FixedCosts,
    hz: float,
    rounding: Rounding = "ceil",
) -> list[Charge]:
    """Charge methods (name -> sampler) with a profile's latencies, for every K that it holds.

    The file is the document of `rtc profile --json`, or one written by hand: `rows` with `sampler`,
    `flow_steps` and `p95_ms`, and `batch` (1), `fixed_ms` (by name) and `samples_ms` where it has
    them. Fixed costs of the file and those given here are added; a name in both is refused. What
    is charged is the 95th percentile of the whole; where a fixed cost was measured too, that of
    the sum, and without `samples_ms` the network counts with its `p95_ms`. UsageError for rows
    that cannot be used and for a sampler that the file does not have.
    """
    rows = _rows(path)
    charges = []
    for method, sampler in samplers.items():
        mine = [row for row in rows if row["sampler"] == sampler]
        if not mine:
            held = ", ".join(dict.fromkeys(str(row["sampler"]) for row in rows))
            raise UsageError(
                f'{path} has no latency of sampler "{sampler}" (method {method}); it has {held}',
                f"profile it: rtc profile --sampler {sampler}",
            )
        for row in mine:
            latency = _latency(path, row, fixed_ms)
            delay = latency_to_delay(latency, hz, rounding)
            charges.append(Charge(method, row["flow_steps"], latency, delay))
    repeated = _repeated((charge.method, charge.flow_steps) for charge in charges)
    if repeated is not None:
        raise UsageError(
            f"{path} has several latencies of {repeated[0]} with {repeated[1]} flow steps",
            "save a profile of one network, batch size and horizon",
        )
    return sorted(charges, key=lambda charge: (charge.method, charge.flow_steps))


def _rows(path: Path) -> list[dict[str, Any]]:
    content = read_json(path, "profile")
    rows = content.get("rows") if isinstance(content, dict) else None
    if not isinstance(rows, list) or not rows:
        raise StateError(f"{path} is no profile: it has no rows", "save one: rtc profile --json")
    for number, row in enumerate(rows):
        _check(path, number, row)
    return [row for row in rows if row.get("batch", 1) == 1]


def _check(path: Path, number: int, row: Any) -> None:
    where = f"{path}, row {number}"
    if not isinstance(row, dict):
        raise UsageError(f"{where} is no object", "give sampler, flow_steps and p95_ms")
    for key, kind in (("sampler", str), ("flow_steps", int), ("p95_ms", int | float)):
        if not isinstance(row.get(key), kind) or isinstance(row.get(key), bool):
            raise UsageError(f"{where}: {key} is {row.get(key)!r}", "see rtc profile --json")
    if row["flow_steps"] < 1 or not (math.isfinite(row["p95_ms"]) and row["p95_ms"] >= 0):
        raise UsageError(
            f"{where}: flow_steps {row['flow_steps']}, p95_ms {row['p95_ms']}",
            "flow_steps must be at least 1, p95_ms a number >= 0",
        )


def _latency(path: Path, row: Mapping[str, Any], fixed_ms: FixedCosts) -> float:
    own = check_costs(row.get("fixed_ms") or {}, f"{path}, fixed_ms")
    both = [name for name in fixed_ms if name in own]
    if both:
        raise UsageError(
            f'the fixed cost "{both[0]}" is in {path} already ({say_cost(own[both[0]])})',
            "leave it away, or give it another name",
        )
    costs = {**own, **fixed_ms}
    measured = any(isinstance(cost, Sequence) for cost in costs.values())
    samples = (row.get("samples_ms") if measured else None) or [row["p95_ms"]]
    return percentile_with(samples, costs, 95)


def _repeated(pairs: Iterable[tuple[str, int]]) -> tuple[str, int] | None:
    seen: set[tuple[str, int]] = set()
    for pair in pairs:
        if pair in seen:
            return pair
        seen.add(pair)
    return None
