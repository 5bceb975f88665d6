"""Rows as tables for people: text grids (shared by Markdown and HTML) and rich tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rtc_cli.report.selection import condition_label, fits_protocol, method_order
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text, interval, points

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Grid:
    """A table of text: the first `left` columns hold names, the rest numbers."""

    columns: list[str]
    rows: list[list[str]]
    left: int = 1


def success_grid(
    rows: Sequence[Row], *, series: str = "method", intervals: bool = True, task: str = ALL
) -> Grid:
    """Return success in percent: one line per method (or variant), one column per (d, s)."""
    mine = pick(rows, task=task, train_seed=ALL)
    cells = _cells(mine)
    names = list(dict.fromkeys(str(row[series]) for row in mine))
    names = method_order(names) if series == "method" else names
    lines = []
    for name in names:
        line = [name]
        for delay, exec_horizon in cells:
            found = pick(mine, **{series: name}, delay=delay, exec_horizon=exec_horizon)
            line.append(success_cell(found[0], intervals) if found else "-")
        lines.append(line)
    return Grid([series, *_heads(cells)], lines)


def success_cell(row: Row, intervals: bool = True) -> str:
    """Return success in percent with its interval; * marks requests beyond the trained delays."""
    mark = "*" if row.get("beyond_trained") else ""
    text = points(row["success"]) + mark
    low, high = points(row["success_low"]), points(row["success_high"])
    return f"{text} ({low} to {high})" if intervals else text


def _cells(rows: Sequence[Row]) -> list[tuple[int, int]]:
    return sorted({(row["delay"], row["exec_horizon"]) for row in rows})


def _heads(cells: Sequence[tuple[int, int]]) -> list[str]:
    """Name the columns; s is left out where it is the same in all of them."""
    if len({s for _, s in cells}) == 1:
        return [f"d={d}" for d, _ in cells]
    return [f"d={d} s={s}" for d, s in cells]


def differences_grid(
    rows: Sequence[Row], protocol: str, *, task: str = ALL, intervals: bool = True
) -> Grid:
    """Return differences in percentage points; bold where the interval excludes 0."""
    mine = [row for row in pick(rows, task=task) if fits_protocol(row, protocol)]
    cells = _cells(mine)
    lines = []
    for method, baseline in dict.fromkeys((row["method"], row["baseline"]) for row in mine):
        line = [pair_text(method, baseline)]
        for delay, s in cells:
            found = pick(mine, method=method, baseline=baseline, delay=delay, exec_horizon=s)
            line.append(difference_cell(found[0], intervals) if found else "-")
        lines.append(line)
    return Grid(["difference", *_heads(cells)], lines)


def pair_text(method: str, baseline: str) -> str:
    """Name a difference; the noise and delays of both are said once."""
    label = condition_label(method)
    shared = label and label == condition_label(baseline)
    return f"{method.removesuffix(label) if shared else method} − {baseline}"


def difference_cell(row: Row, intervals: bool = True) -> str:
    """Return a difference in percentage points, bold where the interval excludes 0."""
    text = points(row["difference"], sign=True)
    if row["low"] is not None and (row["low"] > 0 or row["high"] < 0):
        text = f"**{text}**"
    ends = interval(row["low"], row["high"], sign=True)
    return f"{text} {ends}" if intervals else text


def d90_text(row: Row) -> str:
    """Return D90 in control steps: "2.4", "> 4" or "< 1"."""
    if row["censored"]:
        return f"{row['censored']} {row['d90']:g}"
    return f"{row['d90']:.1f}"


def d90_grid(rows: Sequence[Row], *, task: str = ALL) -> Grid:
    """Return the delay tolerance of each method in control steps and milliseconds."""
    lines = []
    for row in pick(rows, task=task):
        sign = f"{row['censored']} " if row["censored"] else ""
        lines.append(
            [
                row["method"],
                str(row["exec_horizon"]),
                d90_text(row),
                f"{sign}{row['d90_ms']:.0f}",
                f"{points(row['threshold'])}%",
            ]
        )
    return Grid(["method", "s", "D90 (steps)", "D90 (ms)", "success needed"], lines)


def task_by_method_grid(rows: Sequence[Row], value: Callable[[Row], str]) -> Grid:
    """Return one line per task (`all` last, as "mean") and one column per method."""
    methods = method_order(list(dict.fromkeys(row["method"] for row in rows)))
    tasks = sorted({row["task"] for row in rows} - {ALL})
    names = [*tasks, ALL] if len(tasks) > 1 and pick(rows, task=ALL) else tasks
    lines = []
    for task in names:
        found = [pick(rows, task=task, method=method) for method in methods]
        cells = [value(match[0]) if match else "-" for match in found]
        lines.append(["mean" if task == ALL else task, *cells])
    return Grid(["task", *methods], lines)


def matrix_grid(rows: Sequence[Row], protocol: str) -> Grid:
    """Return the matrix {base, prefix} x {plain, pinv, prefix}, one line per combination."""
    mine = pick(rows, protocol=protocol)
    cells = _cells(mine)
    lines = []
    for checkpoint, sampler in dict.fromkeys((row["checkpoint"], row["sampler"]) for row in mine):
        chosen = pick(mine, checkpoint=checkpoint, sampler=sampler)
        mark = " (untrained)" if chosen[0]["untrained"] else ""
        line = [checkpoint, sampler + mark]
        for delay, s in cells:
            found = pick(chosen, delay=delay, exec_horizon=s)
            line.append(points(found[0]["success"]) if found else "-")
        lines.append(line)
    return Grid(["policy", "sampler", *_heads(cells)], lines, left=2)


METRIC_TITLES = {
    "seam_jump": "seam jump",
    "seam_gap": "seam gap",
    "prefix_error": "prefix error",
    "measured_reaction_ticks": "reaction, measured (steps)",
    "reaction_ticks": "reaction, possible (steps)",
    "action_delta": "mean |Δa|",
    "action_delta2": "mean |Δ²a|",
    "length": "length (steps)",
    "time_to_success_s": "time to success (s)",
    "throughput_per_min": "solved per minute",
    "starved_ticks": "starved ticks",
    "late_chunks": "late chunks",
    "dropped_chunks": "dropped chunks",
    "clipped_requests": "clipped requests",
    "exceeded_requests": "exceeded requests",
    "waiting_ticks": "waiting ticks",
}


def metrics_grid(rows: Sequence[Row], delay: int) -> Grid:
    """Return the means of the other metrics at one delay, one line per method."""
    mine = pick(rows, task=ALL, train_seed=ALL, delay=delay)
    shown = [name for name in METRIC_TITLES if any(row.get(name) for row in mine)]
    lines = [
        [row["method"], *("-" if row[name] is None else f"{row[name]:.3g}" for name in shown)]
        for row in mine
    ]
    return Grid(["method", *(METRIC_TITLES[name] for name in shown)], lines)


CASES = {
    "late_chunks": "late",
    "dropped_chunks": "dropped",
    "starved_ticks": "starved",
    "clipped_requests": "clipped",
    "exceeded_requests": "exceeded",
}


# -- terminal --------------------------------------------------------------------------------


def rich_table(grid: Grid, title: str = "", caption: str = "") -> "Table":
    """Return a grid as a rich table; intervals go to a second line so that 80 columns suffice."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=title or None,
        caption=caption or None,
        box=box.SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
        pad_edge=False,
    )
    for place, name in enumerate(grid.columns):
        left = place < grid.left
        table.add_column(
            name.replace(" s=", "\ns="), justify="left" if left else "right", overflow="fold"
        )
    for row in grid.rows:
        cells = []
        for place, cell in enumerate(row):
            bold = "**" in cell
            text = cell.replace("**", "").replace(" (pymunk", "\n(pymunk")
            if place >= grid.left:
                text = text.replace(" (", "\n(").replace("\n(", "\n").replace(" to ", "…")
                text = text.removeprefix("(").rstrip(")")
            cells.append(Text(text, style="bold" if bold or place == 0 else ""))
        table.add_row(*cells)
    return table


def render_summary(
    rows: Sequence[Row], *, task: str = ALL, series: str = "method"
) -> "list[Table]":
    """Return one rich success table per protocol and number of flow steps."""
    tables = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        mine = pick(rows, protocol=protocol)
        for steps in sorted({row["flow_steps"] for row in mine}):
            tasks = sorted({row["task"] for row in mine} - {ALL})
            what = f"mean of {len(tasks)} tasks" if task == ALL and len(tasks) > 1 else task
            what = tasks[0] if what == ALL else what
            title = f"Episodes solved (%), {what}, protocol {protocol}, {steps} flow steps"
            caption = "below: 95% Wilson interval, for these checkpoints"
            grid = success_grid(pick(mine, flow_steps=steps), series=series, task=task)
            tables.append(rich_table(grid, title, caption))
    return tables


def render_differences(rows: Sequence[Row], protocol: str, *, task: str = ALL) -> "Table":
    """Return the rich table of paired differences of one protocol."""
    mine = [row for row in rows if fits_protocol(row, protocol)]
    title = f"Paired differences (percentage points), protocol {protocol}"
    return rich_table(
        differences_grid(mine, protocol, task=task), title, difference_interval_text(mine)
    )


def render_d90(rows: Sequence[Row]) -> "list[Table]":
    """Return the rich tables of delay tolerances: the mean, and tasks by methods."""
    if not rows:
        return []
    tables = [rich_table(d90_grid(rows), "Delay tolerance D90 at fixed s")]
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        mine = pick(rows, protocol=protocol)
        if protocol != "grid" and len({row["task"] for row in mine} - {ALL}) > 1:
            title = f"D90 per task (control steps), protocol {protocol}"
            tables.append(rich_table(task_by_method_grid(mine, d90_text), title))
    return tables


def render_by_task(rows: Sequence[Row], protocol: str) -> "Table":
    """Return the rich table of success at the largest delay: tasks by methods."""
    mine = pick(rows, protocol=protocol, train_seed=ALL)
    last = max((row["delay"], row["exec_horizon"]) for row in mine)
    cell = pick(mine, delay=last[0], exec_horizon=last[1])
    title = f"Episodes solved (%) at d = {last[0]}, s = {last[1]}"
    return rich_table(task_by_method_grid(cell, lambda row: points(row["success"])), title)


def render_matrix(rows: Sequence[Row], protocol: str) -> "Table":
    """Return the rich table of the matrix {base, prefix} x {plain, pinv, prefix}."""
    return rich_table(
        matrix_grid(rows, protocol), f"Policy x sampler: episodes solved (%), protocol {protocol}"
    )
