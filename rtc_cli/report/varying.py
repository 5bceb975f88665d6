"""Tables of delays that vary: a line per law of delays and what is told, a column per method.

A row whose delays vary has them in its method's label (see `selection.timing_label`); the tables
of constant delays, a column per delay, leave such rows to the tables here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rtc_cli.report.render import CASES, Grid, difference_cell, rich_table, success_cell
from rtc_cli.report.selection import delay_label, fits_protocol, method_order
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Condition:
    """A law of delays, what samplers are told of it with all other settings, and s."""

    delays: str
    told: str
    exec_horizon: int

    @property
    def order(self) -> tuple[str, bool, str, int]:
        """What lines are sorted by: the truth comes before what is estimated."""
        return self.delays, self.told != "exact", self.told, self.exec_horizon


def constant(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of tables with a column per delay, those of success or of differences.

    None, where the tables of delays that vary hold them all.
    """
    mine = [row for row in rows if not delay_label(row["method"])]
    shared = {_cell(row) for row in varying(rows)}
    return mine if {_cell(row) for row in mine} - shared else []


def varying(rows: Sequence[Row]) -> list[Row]:
    """Return the other rows, and those of constant delays in the same cells, to compare with."""
    cells = {_cell(row) for row in rows if delay_label(row["method"])}
    return [row for row in rows if _cell(row) in cells]


def delays_grid(rows: Sequence[Row], *, task: str = ALL) -> Grid:
    """Return success in percent; `rows` are those of one protocol and number of flow steps."""
    mine = pick(varying(rows), task=task, train_seed=ALL)
    methods = method_order(list(dict.fromkeys(_name(row) for row in mine)))
    found = {(_condition(row), _name(row)): success_cell(row) for row in mine}
    return _by_condition(found, methods)


def delay_differences_grid(gaps: Sequence[Row], rows: Sequence[Row], *, task: str = ALL) -> Grid:
    """Return differences of methods under the same delays; `rows` say what the labels mean."""
    known = {(row["method"], *_cell(row)): _condition(row) for row in varying(rows)}
    found: dict[tuple[Condition, str], str] = {}
    for row in pick(gaps, task=task):
        condition = known.get((row["method"], *_cell(row)))
        if condition is not None and delay_label(row["method"]) == delay_label(row["baseline"]):
            names = (_without_label(row[side]) for side in ("method", "baseline"))
            found[condition, " − ".join(names)] = difference_cell(row)
    return _by_condition(found, list(dict.fromkeys(pair for _, pair in found)))


def cases_grid(rows: Sequence[Row]) -> Grid:
    """Return how often something special happened per episode, where anything did."""
    mine = [
        row
        for row in pick(rows, task=_whole(rows), train_seed=ALL)
        if any(row.get(name) for name in CASES)
    ]
    shown = [name for name in CASES if any(row[name] for row in mine)]
    lines = [
        [_condition(row).delays, _condition(row).told, _name(row), str(row["exec_horizon"])]
        + [f"{row[name]:.3g}" for name in shown]
        for row in sorted(mine, key=lambda row: _condition(row).order)
    ]
    return Grid(["delays", "told", "method", "s", *(CASES[name] for name in shown)], lines, left=3)


# -- terminal --------------------------------------------------------------------------------


def render_varying(rows: Sequence[Row], gaps: Sequence[Row]) -> "list[Table]":
    """Return the rich tables: success, differences, what happened to chunks.

    Of each protocol and number of flow steps; of all tasks where there are several, else of the
    one.
    """
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["protocol"], row["flow_steps"]), []).append(row)
    return [table for group in groups.values() for table in _render_group(group, gaps)]


def _render_group(rows: Sequence[Row], gaps: Sequence[Row]) -> "list[Table]":
    task = _whole(rows)
    count = len({row["task"] for row in rows} - {ALL})
    what = f"mean of {count} tasks" if task == ALL else task
    protocol, steps = rows[0]["protocol"], rows[0]["flow_steps"]
    tables = []
    if varying(rows):
        title = f"Episodes solved (%), {what}, protocol {protocol}, {steps} flow steps"
        caption = "below: 95% Wilson interval, for these checkpoints"
        grid = delays_grid(rows, task=task)
        if grid.rows:
            tables.append(rich_table(grid, title, caption))
        grid = delay_differences_grid(gaps, rows, task=task)
        if grid.rows:
            title = f"Paired differences (percentage points), protocol {protocol}"
            mine = [row for row in gaps if fits_protocol(row, protocol)]
            tables.append(rich_table(grid, title, difference_interval_text(mine)))
    grid = cases_grid(rows)
    if grid.rows:
        title = f"Per episode, protocol {protocol}"
        caption = "late and dropped chunks, starved ticks, clipped and exceeded requests"
        tables.append(rich_table(grid, title, caption))
    return tables


def _by_condition(found: Mapping[tuple[Condition, str], str], columns: Sequence[str]) -> Grid:
    conditions = sorted({condition for condition, _ in found}, key=lambda each: each.order)
    several = len({condition.exec_horizon for condition in conditions}) > 1
    lines = []
    for condition in conditions:
        s = [str(condition.exec_horizon)] if several else []
        cells = [found.get((condition, name), "-") for name in columns]
        lines.append([condition.delays, condition.told, *s, *cells])
    return Grid(["delays", "told", *(["s"] if several else []), *columns], lines, left=2)


def _whole(rows: Sequence[Row]) -> str:
    tasks = {row["task"] for row in rows} - {ALL}
    return ALL if len(tasks) != 1 else min(tasks)


def _condition(row: Row) -> Condition:
    others = (
        "" if row["on_late"] == "play" else row["on_late"],
        "" if row["on_exceed"] == "play" else row["on_exceed"],
        f"lag {row['observation_lag']}" if row["observation_lag"] else "",
    )
    told = ", ".join([row["estimator"], *filter(None, others)])
    return Condition(row["delay_model"], told, row["exec_horizon"])


def _cell(row: Row) -> tuple[int, int, int]:
    return row["delay"], row["exec_horizon"], row["flow_steps"]


def _name(row: Row) -> str:
    return _without_label(row["method"])


def _without_label(method: str) -> str:
    return method.removesuffix(delay_label(method))
