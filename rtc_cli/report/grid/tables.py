"""Tables of a grid ablation, for the report and the terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rtc_cli.report.grid.rows import PAIRS, last_cell
from rtc_cli.report.grid.text import SHORT_NAMES, factor_name, value_text
from rtc_cli.report.render import Grid, rich_table
from rtc_cli.report.selection import method_order
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text, interval, points

if TYPE_CHECKING:
    from rich.table import Table


def settings_grid(
    rows: Sequence[Row],
    gaps: Sequence[Row],
    settings: Sequence[Mapping[str, Any]],
    cell: Mapping[str, int],
    *,
    task: str = ALL,
    pairs: Sequence[tuple[str, str]] = PAIRS,
) -> Grid:
    """Return one line per setting: success of each method at one cell, and the differences."""
    mine = pick(rows, task=task, train_seed=ALL, **cell)
    found_gaps = pick(gaps, task=task, **cell)
    methods = method_order(list(dict.fromkeys(row["method"] for row in mine)))
    pairs = [pair for pair in pairs if set(pair) <= set(methods)]
    lines = []
    for setting in settings:
        line = [value_text(value) for value in setting.values()]
        for method in methods:
            found = pick(mine, method=method, **setting)
            line.append(points(found[0]["success"]) if found else "-")
        for method, baseline in pairs:
            found = pick(found_gaps, method=method, baseline=baseline, **setting)
            line.append(_difference(found[0]) if found else "-")
        lines.append(line)
    factors = [SHORT_NAMES.get(key, key) for key in (settings[0] if settings else ())]
    heads = [f"{method} − {baseline}" for method, baseline in pairs]
    return Grid([*factors, *methods, *heads], lines, left=len(factors))


def _difference(row: Row) -> str:
    text = points(row["difference"], sign=True)
    if row["low"] is not None and (row["low"] > 0 or row["high"] < 0):
        text = f"**{text}**"
    return f"{text} {interval(row['low'], row['high'], sign=True)}"


def effects_grid(effects: Sequence[Row], delays: Sequence[int], *, task: str = ALL) -> Grid:
    """Return one line per factor and quantity: how it changes, at each delay of one protocol."""
    mine = pick(effects, task=task)
    keys = dict.fromkeys((row["factor"], row["method"], row["baseline"]) for row in mine)
    lines = []
    for factor, method, baseline in keys:
        rows = pick(mine, factor=factor, method=method, baseline=baseline)
        ends = f"{value_text(rows[0]['start'])} → {value_text(rows[0]['end'])}"
        line = [factor_name(factor), ends, f"{method} − {baseline}" if baseline else method]
        for delay in delays:
            found = pick(rows, delay=delay)
            line.append(_difference(found[0]) if found else "-")
        lines.append(line)
    return Grid(["factor", "from → to", "change of", *(f"d={d}" for d in delays)], lines, left=3)


def render_grid(data: Mapping[str, Any]) -> "list[Table]":
    """Return the tables that a terminal shows after a grid ablation, of its first protocol."""
    rows, gaps = data["rows"], data["differences"]
    if not pick(gaps, task=ALL):
        return []
    protocol = rows[0]["protocol"]
    cell = last_cell(gaps, protocol)
    mine = pick(rows, protocol=protocol)
    tasks = sorted({row["task"] for row in mine} - {ALL})
    where = f"mean of {len(tasks)} tasks" if len(tasks) > 1 else tasks[0]
    title = f"Episodes solved (%) at d = {cell['delay']}, s = {cell['exec_horizon']}, {where}"
    table = settings_grid(mine, gaps, data["settings"], cell, pairs=PAIRS[:2])
    narrow = [name.replace(" ", "\n", 1) for name in table.columns]  # 80 columns have to do
    table = replace(table, columns=narrow)
    return [rich_table(table, title, difference_interval_text(pick(gaps, task=ALL, **cell)))]
