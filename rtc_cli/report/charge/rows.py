"""Rows of success against latency: each method and K at the delay that it is charged with."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from rtc_cli.report.tables import ALL, Row, estimate_gap, pick, summarise

PAIRS = (("prefix", "pinv"), ("prefix", "naive"), ("pinv", "naive"))
_MATCH = ["task", "train_seed", "episode", "protocol"]


@dataclass(frozen=True)
class ChargedEpisodes:
    """Episodes of one method with K flow steps, at its latency; None where it cannot be run."""

    method: str
    flow_steps: int
    latency_ms: float
    delay: int
    episodes: pd.DataFrame | None
    reason: str = ""


def charge_rows(charged: Sequence[ChargedEpisodes]) -> list[Row]:
    """One row per charge and protocol: success with its Wilson interval, or why there is none."""
    rows: list[Row] = []
    for each in charged:
        head = {
            "method": each.method,
            "flow_steps": each.flow_steps,
            "latency_ms": each.latency_ms,
            "delay": each.delay,
        }
        if each.episodes is None:
            nothing = dict.fromkeys(("success", "success_low", "success_high", "episodes"))
            rows.append(head | nothing | {"exec_horizon": None, "protocol": None} | _why(each))
            continue
        summary = summarise(each.episodes)
        several = each.episodes["task"].nunique() > 1
        tasks = pick(summary, train_seed=ALL, **({"task": ALL} if several else {}))
        keys = ("exec_horizon", "protocol", "success", "success_low", "success_high", "episodes")
        rows += [head | {key: row[key] for key in keys} | _why(each) for row in tasks]
    return rows


def charge_differences(charged: Sequence[ChargedEpisodes]) -> list[Row]:
    """Paired differences of methods with the same K, each at its own delay."""
    found = []
    for flow_steps in sorted({each.flow_steps for each in charged}):
        mine = {each.method: each for each in charged if each.flow_steps == flow_steps}
        for method, baseline in PAIRS:
            left, right = mine.get(method), mine.get(baseline)
            if left is None or right is None or left.episodes is None or right.episodes is None:
                continue
            columns = [*_MATCH, "solved"]
            matched = left.episodes[columns].merge(
                right.episodes[columns], on=_MATCH, suffixes=("_left", "_right")
            )
            gap = matched["solved_left"].astype(int) - matched["solved_right"].astype(int)
            matched = matched.assign(gap=gap)
            for protocol, cell in matched.groupby("protocol"):
                estimate = estimate_gap(cell, sorted(cell["task"].unique()))
                if estimate is not None:
                    pair = {"method": method, "baseline": baseline, "flow_steps": flow_steps}
                    delays = {"delay": left.delay, "baseline_delay": right.delay}
                    found.append(pair | delays | {"protocol": protocol} | estimate)
    return found


def best_by_method(rows: Sequence[Row]) -> list[Row]:
    """Each method's row of highest success; of equals the one with fewer flow steps."""
    possible = [row for row in rows if row["success"] is not None]
    names = dict.fromkeys(row["method"] for row in possible)
    return [
        max(
            (row for row in possible if row["method"] == name),
            key=lambda row: (row["success"], -row["flow_steps"]),
        )
        for name in names
    ]


def _why(each: ChargedEpisodes) -> Row:
    return {"reason": each.reason or None}
