"""The rows behind every table and figure: success, differences, D90, the matrix, naive's fall.

Input is the episodes table of a run (one row per episode). Success rates are 0 to 1. Delays and
exec horizons are control steps. Row keys are those of the results format; differences and
derived rows carry a few more, which say what the interval describes.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rtc_cli.errors import StateError, did_you_mean
from rtc_cli.intervals import d90, paired_by_episode, paired_by_seed, wilson
from rtc_cli.report.selection import (
    METRICS,
    TIMING,
    condition_label,
    in_protocol,
    method_order,
    prepare,
    protocols_of,
)

Row = dict[str, Any]

ALL = "all"
DEFAULT_PAIRS = (
    ("prefix", "pinv"),
    ("prefix", "pinv-tuned"),
    ("prefix", "naive"),
    ("pinv", "naive"),
)
D90_SHARE = 0.9
FEWEST_DEGREES = 4
"""With fewer degrees of freedom, tasks x (seeds - 1), an interval over seeds is not given: with one
task and two seeds it would be 12.7 standard errors wide to either side."""
_CELL = ["task", "method", "train_seed", "delay", "exec_horizon", "flow_steps"]


# -- success ---------------------------------------------------------------------------------


def summarise(episodes: pd.DataFrame) -> list[Row]:
    """Return the success rows: per task and `all`, per training seed and `all`.

    `all` tasks is the equal-weight mean over the protocol's tasks and appears only where every
    task has the cell; `all` seeds pools the episodes. The interval is a 95% Wilson interval and
    describes these checkpoints only; for several tasks the tasks' intervals are combined
    (square-and-add, Newcombe 1998).
    """
    rows = prepare(episodes)
    found: list[Row] = []
    for protocol in protocols_of(rows):
        found.extend(_summarise_protocol(in_protocol(rows, protocol), protocol))
    return found


def _summarise_protocol(rows: pd.DataFrame, protocol: str) -> list[Row]:
    if rows.empty:
        return []
    metrics = [name for name in METRICS if name in rows.columns]
    pooled = rows.assign(train_seed=ALL)
    counted = pd.concat([_count(rows, metrics), _count(pooled, metrics)], ignore_index=True)
    found = [_task_row(cell, protocol, metrics) for cell in counted.to_dict("records")]
    tasks = sorted(rows["task"].unique())
    cells: dict[tuple[Any, ...], list[Row]] = {}
    for row in found:
        cells.setdefault(tuple(row[name] for name in _CELL[1:]), []).append(row)
    means = [_mean_row(group, metrics) for group in cells.values() if len(group) == len(tasks)]
    return sorted(found + means, key=lambda row: _row_order(row, tasks))


def _count(rows: pd.DataFrame, metrics: list[str]) -> pd.DataFrame:
    groups = rows.groupby(_CELL, sort=False, dropna=False)
    aggregates: dict[str, tuple[str, str]] = {
        "checkpoint": ("checkpoint", "first"),
        "sampler": ("sampler", "first"),
        "schedule": ("schedule", "first"),
        "settings": ("settings", "first"),
        "episodes": ("solved", "size"),
        "solved": ("solved", "sum"),
    }
    if "beyond_trained" in rows.columns:
        aggregates["beyond_trained"] = ("beyond_trained", "max")
    aggregates |= {name: (name, "first") for name in TIMING if name in rows.columns}
    aggregates |= {name: (name, "mean") for name in metrics}
    return groups.agg(**aggregates).reset_index()


def _task_row(cell: Mapping[Any, Any], protocol: str, metrics: list[str]) -> Row:
    episodes, solved = int(cell["episodes"]), int(cell["solved"])
    _, low, high = wilson(solved, episodes)
    return {
        "task": str(cell["task"]),
        "method": str(cell["method"]),
        "checkpoint": str(cell["checkpoint"]),
        "sampler": str(cell["sampler"]),
        "schedule": str(cell["schedule"]),
        "train_seed": ALL if cell["train_seed"] == ALL else int(cell["train_seed"]),
        "protocol": protocol,
        "delay": int(cell["delay"]),
        "exec_horizon": int(cell["exec_horizon"]),
        "flow_steps": int(cell["flow_steps"]),
        "episodes": episodes,
        "solved": solved,
        "success": solved / episodes,
        "success_low": float(low),
        "success_high": float(high),
        "beyond_trained": bool(cell.get("beyond_trained", False)),
        **{name: number(cell[name]) for name in metrics},
        "settings": str(cell["settings"]),
        **{name: cell[name] for name in TIMING if name in cell},
    }


def _mean_row(group: list[Row], metrics: list[str]) -> Row:
    """Average the rows of one cell over its tasks with equal weights."""
    success = float(np.mean([row["success"] for row in group]))
    below = math.hypot(*(row["success"] - row["success_low"] for row in group)) / len(group)
    above = math.hypot(*(row["success_high"] - row["success"] for row in group)) / len(group)
    means = {}
    for name in metrics:
        values = [row[name] for row in group]
        means[name] = None if None in values else float(np.mean(values))
    return group[0] | {
        "task": ALL,
        "episodes": sum(row["episodes"] for row in group),
        "solved": sum(row["solved"] for row in group),
        "success": success,
        "success_low": success - below,
        "success_high": success + above,
        "beyond_trained": any(row["beyond_trained"] for row in group),
        **means,
    }


def _row_order(row: Row, tasks: Sequence[str]) -> tuple[Any, ...]:
    task = len(tasks) if row["task"] == ALL else tasks.index(row["task"])
    seed = math.inf if row["train_seed"] == ALL else row["train_seed"]
    place = method_order([row["method"], "sync"]).index(row["method"])
    return task, row["flow_steps"], place, row["method"], seed, row["delay"], row["exec_horizon"]


def number(value: object) -> float | None:
    """Return a finite float, or None."""
    found = float(value) if value is not None else math.nan  # type: ignore[arg-type]
    return found if math.isfinite(found) else None


def pick(rows: Iterable[Row], **wanted: object) -> list[Row]:
    """Return the rows whose keys have the wanted values."""
    return [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]


def main_flow_steps(episodes: pd.DataFrame) -> int:
    """Return the number of flow steps that most episodes used; tables compare at this one."""
    return int(episodes["flow_steps"].mode().iloc[0])


# -- differences -----------------------------------------------------------------------------


def pairs_among(
    methods: Iterable[str], pairs: Iterable[tuple[str, str]] = DEFAULT_PAIRS
) -> list[tuple[str, str]]:
    """Return the pairs (method, baseline) that were evaluated, with the same noise and delays."""
    present, pairs = set(methods), list(pairs)
    labelled = [
        (method + label, baseline + label)
        for label in sorted({condition_label(method) for method in present})
        for method, baseline in pairs
    ]
    return [pair for pair in labelled if present.issuperset(pair)]


def differences(
    episodes: pd.DataFrame, pairs: Iterable[tuple[str, str]] = DEFAULT_PAIRS
) -> list[Row]:
    """Return success(method) - success(baseline) with 95% intervals, per task and for `all`.

    Episodes are matched by task, training seed and episode number. With enough training seeds (see
    `estimate`) the interval is paired by seed (Student's t); else it is paired by episode and
    describes these checkpoints only: the key `interval` is "seeds" or "checkpoints".
    """
    rows = prepare(episodes)
    found: list[Row] = []
    for method, baseline in pairs_among(rows["method"].unique(), pairs):
        matched = _match(rows, "method", method, baseline)
        found.extend(_difference_rows(matched, method, baseline))
    return found


def _match(rows: pd.DataFrame, column: str, left: str, right: str) -> pd.DataFrame:
    """Return matched episodes with `gap` in {-1, 0, 1}: solved on the left minus on the right."""
    keys = ["task", "train_seed", "delay", "exec_horizon", "flow_steps", "episode"]
    sides = [rows.loc[rows[column] == name, [*keys, "solved"]] for name in (left, right)]
    matched = sides[0].merge(sides[1], on=keys, suffixes=("_left", "_right"))
    return matched.assign(gap=matched["solved_left"].astype(int) - matched["solved_right"])


def _difference_rows(matched: pd.DataFrame, method: str, baseline: str) -> list[Row]:
    found: list[Row] = []
    every_task = sorted(matched["task"].unique())
    cells = matched.groupby(["flow_steps", "delay", "exec_horizon"])
    for (flow_steps, delay, exec_horizon), cell in cells:
        tasks = sorted(cell["task"].unique())
        groups = [(task, [task]) for task in tasks]
        if tasks == every_task:
            groups.append((ALL, tasks))
        for name, members in groups:
            estimate = estimate_gap(cell, members)
            if estimate is None:
                continue
            found.append(
                {
                    "task": name,
                    "delay": int(delay),
                    "exec_horizon": int(exec_horizon),
                    "method": method,
                    "baseline": baseline,
                    **estimate,
                    "flow_steps": int(flow_steps),
                }
            )
    return found


def estimate_gap(cell: pd.DataFrame, tasks: Sequence[str]) -> Row | None:
    """Estimate the mean of `gap` over tasks with equal weights, from the seeds all tasks share.

    `cell` holds matched episodes of one cell: columns task, train_seed, gap. Returns the keys
    difference, low, high, seeds, interval; None where the tasks share no training seed.
    """
    means = cell.groupby(["task", "train_seed"])["gap"].mean().unstack("train_seed")
    means = means.reindex(tasks).dropna(axis="columns")

    def strata() -> list[NDArray[np.float64]]:
        mine = cell[cell["train_seed"].isin(means.columns)]
        return [mine.loc[mine["task"] == task, "gap"].to_numpy(float) for task in tasks]

    return estimate(means.to_numpy(), strata)


def estimate(
    means: NDArray[np.float64], strata: Callable[[], Sequence[NDArray[np.float64]]]
) -> Row | None:
    """Estimate a mean paired difference from its (tasks, shared seeds) means.

    With one seed, or with fewer than `FEWEST_DEGREES` degrees of freedom, the interval comes from
    `strata`, the differences of each task's episodes in all of these seeds, and describes these
    checkpoints only. Returns the keys of `estimate_gap`; None without a shared seed.
    """
    tasks, seeds = means.shape
    if seeds == 0:
        return None
    kind = kind_of_interval(tasks, seeds)
    found = paired_by_seed(means) if kind == "seeds" else paired_by_episode(strata())
    return {
        "difference": float(found.estimate),
        "low": number(found.low),
        "high": number(found.high),
        "seeds": seeds,
        "interval": kind,
    }


def kind_of_interval(tasks: int, seeds: int) -> str:
    """Say what an interval can describe: "seeds", or with too few of them "checkpoints"."""
    return "seeds" if tasks * (seeds - 1) >= FEWEST_DEGREES else "checkpoints"


# -- derived rows ----------------------------------------------------------------------------


def d90_rows(summary: Sequence[Row], *, control_hz: float = 30.0) -> list[Row]:
    """Return the delay tolerance of each method at each fixed exec horizon with two delays.

    D90 is the largest delay (interpolated) at which success is still 0.9 of naive's at d = 0.
    `censored` is ">" where no evaluated delay falls below, "<" where already the first one does.
    """
    found: list[Row] = []
    pooled = [row for row in summary if row["train_seed"] == ALL]
    for task, protocol, s, steps in _ordered_keys(
        pooled, "task", "protocol", "exec_horizon", "flow_steps"
    ):
        if protocol == "paper":  # s changes with d there
            continue
        cell = pick(pooled, task=task, protocol=protocol, exec_horizon=s, flow_steps=steps)
        start = pick(cell, method="naive", delay=0)
        if not start:
            continue
        for method in method_order(sorted({row["method"] for row in cell})):
            curve = sorted(pick(cell, method=method), key=lambda row: row["delay"])
            if len(curve) > 1:
                found.append(_d90_row(curve, start[0]["success"], control_hz))
    return found


def _d90_row(curve: Sequence[Row], reference: float, control_hz: float) -> Row:
    delays, success = [row["delay"] for row in curve], [row["success"] for row in curve]
    result = d90(delays, success, reference, D90_SHARE)
    value = float(result.value)
    keys = ("task", "method", "protocol", "exec_horizon", "flow_steps")
    return {name: curve[0][name] for name in keys} | {
        "reference": reference,
        "threshold": D90_SHARE * reference,
        "d90": value,
        "d90_ms": value * 1000.0 / control_hz,
        "censored": result.censored,
    }


def naive_fall_rows(episodes: pd.DataFrame, *, method: str = "naive") -> list[Row]:
    """Return how much success a method loses from d = 0 to the largest delay, per protocol."""
    rows = prepare(episodes)
    steps = main_flow_steps(rows)
    found: list[Row] = []
    for protocol in protocols_of(rows):
        mine = in_protocol(rows, protocol)
        mine = mine[(mine["method"] == method) & (mine["flow_steps"] == steps)]
        if protocol == "grid" or not {0} < set(mine["delay"]):
            continue
        found.extend(_fall_rows(mine, protocol, method))
    return found


def _fall_rows(rows: pd.DataFrame, protocol: str, method: str) -> list[Row]:
    last = int(rows["delay"].max())
    keys = ["task", "train_seed", "episode"]
    ends = [rows.loc[rows["delay"] == d, [*keys, "solved"]] for d in (0, last)]
    matched = ends[0].merge(ends[1], on=keys, suffixes=("_left", "_right"))
    matched = matched.assign(gap=matched["solved_left"].astype(int) - matched["solved_right"])
    tasks = sorted(matched["task"].unique())
    found = []
    for name, members in [*((task, [task]) for task in tasks), (ALL, tasks)]:
        estimate = estimate_gap(matched, members) if members else None
        if estimate is not None:
            means = matched[matched["task"].isin(members)].groupby("task")
            found.append(
                {
                    "task": name,
                    "method": method,
                    "protocol": protocol,
                    "delay": last,
                    "success_at_zero": float(means["solved_left"].mean().mean()),
                    "success_at_delay": float(means["solved_right"].mean().mean()),
                    "fall": estimate.pop("difference"),
                    **estimate,
                }
            )
    return found


MATRIX_SAMPLERS = ("plain", "pinv", "prefix")
MATRIX_CHECKPOINTS = ("base", "prefix")


def matrix_rows(summary: Sequence[Row]) -> list[Row]:
    """Return success of {base, prefix} x {plain, pinv, prefix} at every cell, for `all` tasks.

    base x prefix asks a network for something it was not trained on: `untrained` is true there.
    Empty unless at least one of the combinations without a method of its own was evaluated.
    """
    wanted = {(c, s) for c in MATRIX_CHECKPOINTS for s in MATRIX_SAMPLERS}
    ordinary = {("base", "plain"), ("base", "pinv"), ("prefix", "prefix")}
    found: list[Row] = []
    seen: set[tuple[Any, ...]] = set()
    for row in pick(summary, task=ALL, train_seed=ALL, schedule="async"):
        combination = (row["checkpoint"], row["sampler"])
        # "pinv-tuned" shares checkpoint and sampler with "pinv"; the matrix uses one setting.
        key = (*combination, row["protocol"], row["delay"], row["exec_horizon"], row["flow_steps"])
        if combination not in wanted or "tuned" in row["method"] or key in seen:
            continue
        seen.add(key)
        found.append(
            {
                "checkpoint": row["checkpoint"],
                "sampler": row["sampler"],
                "untrained": combination == ("base", "prefix"),
                **{k: row[k] for k in ("protocol", "delay", "exec_horizon", "flow_steps")},
                **{k: row[k] for k in ("episodes", "success", "success_low", "success_high")},
            }
        )
    combinations = {(row["checkpoint"], row["sampler"]) for row in found}
    return found if combinations - ordinary else []


def _ordered_keys(rows: Iterable[Row], *names: str) -> list[tuple[Any, ...]]:
    return list(dict.fromkeys(tuple(row[name] for name in names) for row in rows))


# -- ablation --------------------------------------------------------------------------------


def ablation_table(episodes: pd.DataFrame) -> list[Row]:
    """Return success rows per `variant` (training delay distribution), as `summarise` does."""
    found: list[Row] = []
    for variant, rows in _by_variant(episodes):
        found.extend({"variant": variant, **row} for row in summarise(rows))
    return found


def ablation_differences(episodes: pd.DataFrame, baseline: str) -> list[Row]:
    """Return paired differences of every variant against `baseline`, per task and for `all`.

    `method` and `baseline` hold names of variants. StateError where the baseline has no rows.
    """
    groups = dict(_by_variant(episodes))
    if baseline not in groups:
        raise StateError(
            f'the baseline variant "{baseline}" has no evaluated episodes.'
            f"{did_you_mean(baseline, groups)}",
            "run `rtc ablate` again: it goes on where it stopped",
        )
    frames = [prepare(rows).assign(method=variant) for variant, rows in groups.items()]
    rows = pd.concat(frames, ignore_index=True)
    found: list[Row] = []
    for variant in groups:
        if variant != baseline:
            matched = _match(rows, "method", variant, baseline)
            found.extend(_difference_rows(matched, variant, baseline))
    return found


def _by_variant(episodes: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    if "variant" not in episodes.columns:
        raise StateError(
            "the episode rows have no column `variant`: this run is no ablation",
            "give the run of an `rtc ablate` with --run DIR",
        )
    named = episodes[episodes["variant"].notna()]
    return [
        (str(name), rows.drop(columns="variant"))
        for name, rows in named.groupby("variant", sort=False)
    ]
