"""The loss decomposition as tables for people."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rtc_cli.report.losses.costs import CLASSES, DIFFERENT, INSENSITIVE, NAIVE
from rtc_cli.report.losses.text import control_alarms
from rtc_cli.report.render import Grid, rich_table
from rtc_cli.report.selection import method_order
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import interval, points

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

ADD_UP = "S(0,1) - open-loop - irreducible - avoidable = naive"
_PARTS = {
    "open_loop_cost": "open-loop",
    "irreducible": "irreducible",
    "avoidable": "avoidable",
}


def classes_of(classes: Sequence[Row], protocol: str) -> dict[str, str]:
    """Return the class of each task at one fixed exec horizon."""
    return {row["task"]: row["class"] for row in classes if row["protocol"] == protocol}


def by_class(tasks: Sequence[str], classes: Mapping[str, str]) -> list[str]:
    """Sort tasks by their class, then by name; those without a class come last."""
    order = {name: place for place, name in enumerate(CLASSES)}
    return sorted(tasks, key=lambda task: (order.get(classes.get(task, ""), len(order)), task))


def last_delay(rows: Sequence[Row]) -> int:
    """Return the largest delay of some rows."""
    return max(row["delay"] for row in rows)


def costs_grid(rows: Sequence[Row], classes: Mapping[str, str], delay: int) -> Grid:
    """Return the costs in percentage points, one line per task, at one delay of one protocol."""
    mine = {row["task"]: row for row in pick(rows, delay=delay)}
    tasks = by_class([task for task in mine if task != ALL], classes)
    lines = [
        [task, classes.get(task, "-").removesuffix("-limited"), *_levels(mine[task])]
        for task in tasks
    ]
    if ALL in mine and len(tasks) > 1:
        lines.append(["mean", "", *_levels(mine[ALL])])
    return Grid(["task", "class", "S(0,1)", *_PARTS.values(), "naive"], lines, left=2)


def costs_by_delay_grid(rows: Sequence[Row], *, task: str = ALL) -> Grid:
    """Return the costs of one task (or the mean), one line per delay."""
    lines = [
        [f"d={row['delay']} s={row['exec_horizon']}", *_levels(row)]
        for row in sorted(pick(rows, task=task), key=lambda row: row["delay"])
    ]
    return Grid(["cell", "S(0,1)", *_PARTS.values(), "naive"], lines)


def _levels(row: Row) -> list[str]:
    start = row["success_closed_loop"]
    return [
        "-" if start is None else points(start),
        *(_cost(row, name) for name in _PARTS),
        points(row["success_naive"]),
    ]


def _cost(row: Row, name: str) -> str:
    if row[name] is None:
        return "-"
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{points(row[name], sign=True)} {interval(low, high, sign=True)}"


def recovered_grid(rows: Sequence[Row], delay: int, classes: Mapping[str, str]) -> Grid:
    """Return the recovered fractions in percent at one delay: a line per task, then the mean."""
    mine = pick(rows, delay=delay)
    methods = method_order(list(dict.fromkeys(row["method"] for row in mine)))
    tasks = by_class(sorted({row["task"] for row in mine} - {ALL}), classes)
    names = [*tasks, ALL] if len(tasks) > 1 and pick(mine, task=ALL) else tasks
    lines = [
        [
            "mean" if task == ALL else task,
            *(_recovered(pick(mine, task=task, method=method)) for method in methods),
        ]
        for task in names
    ]
    return Grid(["task", *methods], lines)


def recovered_by_delay_grid(rows: Sequence[Row], *, task: str = ALL) -> Grid:
    """Return the recovered fractions in percent for one task (or the mean): a line per method."""
    mine = pick(rows, task=task)
    cells = sorted({(row["delay"], row["exec_horizon"]) for row in mine})
    methods = method_order(list(dict.fromkeys(row["method"] for row in mine)))
    lines = [
        [m, *(_recovered(pick(mine, method=m, delay=d, exec_horizon=s)) for d, s in cells)]
        for m in methods
    ]
    return Grid(["method", *(f"d={d} s={s}" for d, s in cells)], lines)


def _recovered(found: Sequence[Row]) -> str:
    if not found or found[0]["recovered"] is None:
        return "-"
    row = found[0]
    return f"{round(100 * row['recovered'])} {_whole(row['recovered_low'], row['recovered_high'])}"


def _whole(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return "(no interval)"
    return f"({round(100 * low)} to {round(100 * high)})"


def classes_grid(classes: Sequence[Row], protocol: str) -> Grid:
    """Return the classes with the two numbers that decide them."""
    mine = {row["task"]: row for row in pick(classes, protocol=protocol)}
    order = by_class(list(mine), classes_of(classes, protocol))
    lines = [
        [
            task,
            mine[task]["class"],
            f"d={mine[task]['delay']}",
            _cost(mine[task], "delay_cost"),
            _cost(mine[task], "balance"),
        ]
        for task in order
    ]
    columns = ["task", "class", "at", "lost to delay", "avoidable − irreducible"]
    return Grid(columns, lines, left=3)


def control_grid(rows: Sequence[Row]) -> Grid:
    """Return the negative control: methods minus naive on insensitive tasks, one line per pair."""
    delays = sorted({row["delay"] for row in rows})
    lines = []
    for task, method in dict.fromkeys((row["task"], row["method"]) for row in rows):
        line = [task, f"{method} − {NAIVE}"]
        for delay in delays:
            found = pick(rows, task=task, method=method, delay=delay)
            line.append(_control(found[0]) if found else "-")
        lines.append(line)
    return Grid([f"{INSENSITIVE} task", "difference", *(f"d={d}" for d in delays)], lines, left=2)


def _control(row: Row) -> str:
    text = points(row["difference"], sign=True)
    text = f"**{text}**" if row["verdict"] == DIFFERENT else text
    return f"{text} {interval(row['low'], row['high'], sign=True)}"


# -- terminal --------------------------------------------------------------------------------


def render_losses(data: Mapping[str, Sequence[Row]]) -> "list[RenderableType]":
    """Return the terminal's tables of `Results.losses`; nothing without the oracle."""
    found: list[RenderableType] = []
    costs, shares = data.get("decomposition", []), data.get("recovered", [])
    for protocol in dict.fromkeys(row["protocol"] for row in costs):
        if protocol != "grid":
            rows, parts = pick(costs, protocol=protocol), pick(shares, protocol=protocol)
            found.extend(_render_protocol(rows, parts, classes_of(data["classes"], protocol)))
    found.extend(f"[bold red]{text}[/]" for text in control_alarms(data.get("controls", [])))
    return found


def _render_protocol(
    costs: Sequence[Row], shares: Sequence[Row], classes: Mapping[str, str]
) -> "list[Table]":
    protocol, last = costs[0]["protocol"], last_delay(costs)
    found = []
    if classes:
        title = f"Where success is lost (points), protocol {protocol}, d = {last}"
        grid = _class_below(costs_grid(costs, classes, last))
        found.append(rich_table(grid, title, ADD_UP))
    tasks = sorted({row["task"] for row in costs} - {ALL})
    task = ALL if len(tasks) > 1 and pick(costs, task=ALL) else tasks[0]
    what = f"mean of {len(tasks)} tasks" if task == ALL else task
    title = f"Where success is lost (points), {what}, protocol {protocol}"
    found.append(rich_table(costs_by_delay_grid(costs, task=task), title))
    if shares:
        title = f"Avoidable cost recovered (%), {what}, protocol {protocol}"
        caption = "-: the avoidable cost cannot be told from 0"
        found.append(rich_table(recovered_by_delay_grid(shares, task=task), title, caption))
    return found


def _class_below(grid: Grid) -> Grid:
    """Write the class below the task's name, so that 80 columns suffice."""
    rows = [[f"{task}\n{kind}" if kind else task, *rest] for task, kind, *rest in grid.rows]
    return Grid([grid.columns[0], *grid.columns[2:]], rows)
