"""How much of the loss under delay could be won back: costs, recovered fractions, classes of tasks.

With S(d, s) the success of naive at delay d and exec horizon s, and S_oracle that of the reference
method `oracle` (a plain policy that is shown the state predicted without noise):

- open-loop cost   S(0, 1) - S(0, s): what acting on old observations costs without any delay;
- irreducible cost S(0, s) - S_oracle(d, s): what even the predicted state does not win back;
- avoidable cost   S_oracle(d, s) - S(d, s): what that prediction wins back;
- recovered fraction of a method m: (S_m(d, s) - S(d, s)) / (S_oracle(d, s) - S(d, s)).

The three costs and S(d, s) add up to S(0, 1). All rates are 0 to 1; each cost may be negative.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rtc_cli.intervals import Interval, equivalent, ratio_by_episode, ratio_by_seed
from rtc_cli.report.selection import (
    fits_protocol,
    fixed_protocols,
    in_protocol,
    method_order,
    prepare,
    protocols_of,
)
from rtc_cli.report.tables import (
    ALL,
    Row,
    differences,
    estimate,
    kind_of_interval,
    number,
    pick,
)

NAIVE, ORACLE = "naive", "oracle"
LEVELS = ("closed_loop", "open_loop", ORACLE, NAIVE)
"""S(0, 1), S(0, s), S_oracle(d, s) and S(d, s): the levels between which the costs lie."""
KEYS = ("task", "train_seed", "episode")
# Each cost as a weighted sum of levels; `balance` is avoidable - irreducible.
COSTS: dict[str, dict[str, float]] = {
    "open_loop_cost": {"closed_loop": 1, "open_loop": -1},
    "irreducible": {"open_loop": 1, ORACLE: -1},
    "avoidable": {ORACLE: 1, NAIVE: -1},
    "delay_cost": {"open_loop": 1, NAIVE: -1},
    "balance": {ORACLE: 2, NAIVE: -1, "open_loop": -1},
}
CONTROL, INFORMATION = "control-limited", "information-limited"
INSENSITIVE, UNDECIDED = "insensitive", "undecided"
EQUAL, OPEN, DIFFERENT = "equal", "open", "different"
CLASSES = (CONTROL, INFORMATION, INSENSITIVE, UNDECIDED)
MARGIN = 0.05
"""Half-width of the zone that counts as "no loss": 5 percentage points."""
FLOOR = 0.25
"""Below this success without delay, at s, a task has too little to lose to be classified."""
LARGEST_DELAY = 4
"""Tasks are classified at the largest evaluated delay up to this one (control steps)."""


@dataclass(frozen=True)
class LossCell:
    """The matched episodes of one cell of a protocol, in which naive and the oracle were run.

    `frame` has the columns task, train_seed, episode, one 0/1 column per level of `LEVELS` and one
    per further method; `tasks` are all tasks of the run.
    """

    protocol: str
    delay: int
    exec_horizon: int
    flow_steps: int
    frame: pd.DataFrame
    tasks: tuple[str, ...]

    @property
    def keys(self) -> Row:
        """What names the cell in a row."""
        names = ("protocol", "delay", "exec_horizon", "flow_steps")
        return {name: getattr(self, name) for name in names}

    @property
    def methods(self) -> list[str]:
        """The methods beside naive and the oracle, without combinations made for the matrix."""
        known = {*KEYS, *LEVELS}
        return method_order([m for m in self.frame.columns if m not in known and "+" not in m])

    @property
    def seeds(self) -> NDArray[np.int64]:
        """The training seeds of the cell, in order."""
        return np.unique(self.frame["train_seed"].to_numpy(np.int64))

    @cached_property
    def rates(self) -> dict[str, NDArray[np.float64]]:
        """Each column's (tasks, seeds) means over episodes; NaN where an episode lacks it."""
        columns = [name for name in self.frame.columns if name not in KEYS]
        groups = self.frame.groupby(["task", "train_seed"])[columns]
        means = groups.mean().where(groups.count().eq(groups.size(), axis=0))
        index = pd.MultiIndex.from_product([self.tasks, self.seeds])
        table = means.reindex(index).to_numpy()
        return {
            name: table[:, place].reshape(len(self.tasks), -1) for place, name in enumerate(columns)
        }

    def groups(self) -> list[tuple[str, list[str]]]:
        """Each task of the cell, then `all` where no task of the run is missing."""
        present = sorted(self.frame["task"].unique())
        single = [(task, [task]) for task in present]
        return [*single, (ALL, present)] if present == list(self.tasks) else single

    def shared(self, tasks: Sequence[str], names: Iterable[str]) -> NDArray[np.bool_]:
        """Mark the seeds in which all of some tasks have all of some columns."""
        places = [self.tasks.index(task) for task in tasks]
        known = [np.isfinite(self.rates[name][places]).all(axis=0) for name in names]
        return np.logical_and.reduce(known)

    def mean_gap(
        self, weights: Mapping[str, float], tasks: Sequence[str], seeds: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return the (tasks, seeds) means of a weighted sum of columns."""
        places = [self.tasks.index(task) for task in tasks]
        terms = [weight * self.rates[name][places][:, seeds] for name, weight in weights.items()]
        return np.sum(terms, axis=0)

    def gaps(
        self, weights: Mapping[str, float], tasks: Sequence[str], seeds: NDArray[np.bool_]
    ) -> list[NDArray[np.float64]]:
        """Return the same for the single episodes of each task."""
        mine = self.frame[self.frame["train_seed"].isin(self.seeds[seeds])]
        columns, factors = list(weights), list(weights.values())
        return [mine.loc[mine["task"] == task, columns].to_numpy() @ factors for task in tasks]

    def estimate(self, weights: Mapping[str, float], tasks: Sequence[str]) -> Row | None:
        """Estimate the mean of a weighted sum of columns over tasks; None without shared seeds."""
        seeds = self.shared(tasks, weights)
        means = self.mean_gap(weights, tasks, seeds)
        return estimate(means, lambda: self.gaps(weights, tasks, seeds))


# -- costs -----------------------------------------------------------------------------------


def decomposition_rows(cells: Iterable[LossCell]) -> list[Row]:
    """Return the costs in every cell, per task and for `all`, with 95% intervals.

    All levels are counted on the same episodes. Intervals are those of `estimate`: paired by
    training seed, or with too few of them by episode (`interval` is "checkpoints"). The open-loop
    cost is null where S(0, 1) was not evaluated on all of them. `delay_cost` is irreducible +
    avoidable, `balance` is avoidable - irreducible.
    """
    return [
        {"task": name, **cell.keys, **row}
        for cell in cells
        for name, members in cell.groups()
        if (row := _cost_row(cell, members)) is not None
    ]


def _cost_row(cell: LossCell, tasks: list[str]) -> Row | None:
    seeds = cell.shared(tasks, ("open_loop", ORACLE, NAIVE))
    if not seeds.any():
        return None
    frame = cell.frame
    mine = frame["task"].isin(tasks) & frame["train_seed"].isin(cell.seeds[seeds])
    row: Row = {"episodes": int(mine.sum())}
    for level in LEVELS:
        row[f"success_{level}"] = number(cell.mean_gap({level: 1.0}, tasks, seeds).mean())
    for name, weights in COSTS.items():
        whole = np.array_equal(cell.shared(tasks, weights), seeds)
        row |= _named(name, cell.estimate(weights, tasks) if whole else None)
    count = int(seeds.sum())
    return row | {"seeds": count, "interval": kind_of_interval(len(tasks), count)}


def _named(name: str, estimate: Row | None) -> Row:
    found = estimate or {}
    return {
        name: found.get("difference"),
        f"{name}_low": found.get("low"),
        f"{name}_high": found.get("high"),
    }


def loss_cells(episodes: pd.DataFrame) -> Iterator[LossCell]:
    """Match the episodes of each cell with d > 0; nothing where the oracle was not evaluated."""
    rows = prepare(episodes, reference=True)
    protocols, tasks = protocols_of(rows), tuple(sorted(rows["task"].unique()))
    for steps, same_steps in rows.groupby("flow_steps"):
        wide = _wide(same_steps)
        for protocol in protocols:
            mine = in_protocol(same_steps, protocol)
            mine = mine[(mine["method"] == ORACLE) & (mine["delay"] > 0)]
            cells = mine[["delay", "exec_horizon"]].drop_duplicates()
            for delay, s in sorted(cells.itertuples(index=False, name=None)):
                frame = _frame(wide, int(delay), int(s))
                if not frame.empty:
                    yield LossCell(protocol, int(delay), int(s), int(str(steps)), frame, tasks)


def _wide(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per (task, seed, episode), one column per (method, d, s): 0, 1 or NaN."""
    index = rows.set_index(["task", "train_seed", "episode", "method", "delay", "exec_horizon"])
    return index["solved"].astype(float).unstack(["method", "delay", "exec_horizon"])


def _frame(wide: pd.DataFrame, delay: int, s: int) -> pd.DataFrame:
    def column(method: str, d: int, horizon: int) -> pd.Series:
        key = (method, d, horizon)
        return wide[key] if key in wide.columns else pd.Series(float("nan"), wide.index)

    here = [m for m, d, horizon in wide.columns if (d, horizon) == (delay, s)]
    levels = {
        "closed_loop": column(NAIVE, 0, 1),
        "open_loop": column(NAIVE, 0, s),
        **{method: column(method, delay, s) for method in (ORACLE, NAIVE, *here)},
    }
    frame = pd.DataFrame(levels).reset_index()
    return frame.dropna(subset=["open_loop", ORACLE, NAIVE])


# -- recovered fractions ---------------------------------------------------------------------


def recovered_rows(cells: Iterable[LossCell]) -> list[Row]:
    """Return each method's share of the avoidable cost, per task and for `all`, per cell.

    For `all` it is the ratio of the two means over tasks. `recovered` and its Fieller interval are
    null unless the interval of the avoidable cost lies above 0.
    """
    found: list[Row] = []
    for cell in cells:
        for method in cell.methods:
            part = cell
            if cell.frame[method].isna().any():
                part = replace(cell, frame=cell.frame.dropna(subset=[method]))
            for name, members in part.groups():
                row = _recovered_row(part, method, members)
                if row is not None:
                    found.append({"task": name, "method": method, **cell.keys, **row})
    return found


def _recovered_row(cell: LossCell, method: str, tasks: list[str]) -> Row | None:
    gain, whole = {method: 1.0, NAIVE: -1.0}, COSTS["avoidable"]
    won, avoidable = cell.estimate(gain, tasks), cell.estimate(whole, tasks)
    if won is None or avoidable is None:
        return None
    share = Interval(float("nan"), float("nan"), float("nan"))
    if avoidable["low"] is not None and avoidable["low"] > 0:
        seeds = cell.shared(tasks, (method, ORACLE, NAIVE))
        if avoidable["interval"] == "seeds":
            part = cell.mean_gap(gain, tasks, seeds)
            share = ratio_by_seed(part, cell.mean_gap(whole, tasks, seeds))
        else:
            share = ratio_by_episode(cell.gaps(gain, tasks, seeds), cell.gaps(whole, tasks, seeds))
    return {
        "gain": won["difference"],
        **_named("avoidable", avoidable),
        "recovered": number(share.estimate),
        "recovered_low": number(share.low),
        "recovered_high": number(share.high),
        "seeds": avoidable["seeds"],
        "interval": avoidable["interval"],
    }


# -- classes ---------------------------------------------------------------------------------


def class_rows(decomposition: Sequence[Row], *, margin: float = MARGIN) -> list[Row]:
    """Say of each task why delay hurts it: one row per task and fixed exec horizon.

    The rule looks at naive and the oracle only, at the largest evaluated d ≤ 4, in this order:

    1. `undecided`: S(0, s) is below `FLOOR`; what is never solved cannot be lost.
    2. `insensitive`: the interval of the delay cost S(0, s) - S(d, s) lies within ± `margin`.
    3. `undecided`: that interval does not lie above 0, so no loss is established.
    4. `control-limited`: the interval of avoidable - irreducible lies above 0;
       `information-limited`: it lies below 0; `undecided`: it contains 0.
    """
    protocols = fixed_protocols(list(dict.fromkeys(row["protocol"] for row in decomposition)))
    found: list[Row] = []
    for protocol in protocols:
        rows = [row for row in decomposition if row["protocol"] == protocol]
        rows = [row for row in rows if row["delay"] <= LARGEST_DELAY and row["task"] != ALL]
        for task in sorted({row["task"] for row in rows}):
            last = max(pick(rows, task=task), key=lambda row: row["delay"])
            found.append(_class_row(last, margin))
    return found


def _class_row(row: Row, margin: float) -> Row:
    keys = ("task", "protocol", "delay", "exec_horizon", "flow_steps")
    ends = [f"{name}{end}" for name in ("delay_cost", "balance") for end in ("", "_low", "_high")]
    return {
        **{name: row[name] for name in keys},
        "class": _class_of(row, margin),
        "margin": margin,
        **{name: row[name] for name in (*ends, "seeds", "interval")},
    }


def _class_of(row: Row, margin: float) -> str:
    low, high = row["delay_cost_low"], row["delay_cost_high"]
    if low is None or high is None or row["success_open_loop"] < FLOOR:
        return UNDECIDED
    if equivalent(Interval(row["delay_cost"], low, high), margin):
        return INSENSITIVE
    if low <= 0:
        return UNDECIDED
    if row["balance_low"] > 0:
        return CONTROL
    return INFORMATION if row["balance_high"] < 0 else UNDECIDED


def control_rows(episodes: pd.DataFrame, classes: Sequence[Row]) -> list[Row]:
    """Compare every method with naive on the insensitive tasks: the negative control.

    Rows are those of `differences` for the cells with 0 < d ≤ 4 of the protocol in which the task
    is insensitive, with `verdict`: "equal" where the interval lies within the margin, "different"
    where it lies outside, "open" where it does neither. `sync` is no part of it (waiting is another
    loss), nor are combinations that nobody trained for (`base+prefix`).
    """
    tasks = {(row["task"], row["protocol"]): row for row in pick(classes, **{"class": INSENSITIVE})}
    if not tasks:
        return []
    rows = prepare(episodes)
    names = [m for m in rows["method"].unique() if m not in (NAIVE, "sync") and "+" not in m]
    mine = episodes[episodes["task"].isin([task for task, _ in tasks])]
    gaps = differences(mine, [(name, NAIVE) for name in method_order(names)])
    found: list[Row] = []
    for (task, protocol), kind in tasks.items():
        for gap in pick(gaps, task=task, flow_steps=kind["flow_steps"]):
            if fits_protocol(gap, protocol) and 0 < gap["delay"] <= LARGEST_DELAY:
                verdict = _verdict(gap, kind["margin"])
                found.append({**gap, "protocol": protocol, "verdict": verdict})
    return found


def _verdict(gap: Row, margin: float) -> str:
    if gap["low"] is None or gap["high"] is None:
        return OPEN
    if equivalent(Interval(gap["difference"], gap["low"], gap["high"]), margin):
        return EQUAL
    return DIFFERENT if gap["low"] > margin or gap["high"] < -margin else OPEN
