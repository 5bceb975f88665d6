"""Success by the number of flow steps, where a run was evaluated with several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rtc_cli.report.document import Block, Fold, Paragraph, Picture, Section
from rtc_cli.report.figures import success_panel
from rtc_cli.report.render import Grid
from rtc_cli.report.sections import Results, as_table
from rtc_cli.report.selection import method_order
from rtc_cli.report.style import new_figure
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text, interval, points
from rtc_cli.report.varying import constant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_PANELS = 3


def flow_steps_sections(results: Results) -> list[Section]:
    """Compare numbers of flow steps; nothing for a run that has one only."""
    protocol, several = shared_protocol(results.every_summary)
    if len(several) < 2:
        return []
    rows = pick(constant(results.every_summary), protocol=protocol)
    mean = pick(rows, task=ALL, train_seed=ALL)
    if not mean:
        return []
    gaps = pick(constant(results.every_difference), task=ALL, baseline="pinv", method="prefix")
    blocks: list[Block] = [
        Paragraph(
            f"Protocol `{protocol}`. One Euler step gives the mean of the actions that the policy "
            "knows; more steps give one of them."
        )
    ]
    delays = {
        steps: len({row["delay"] for row in pick(mean, flow_steps=steps)}) for steps in several
    }
    most = max(delays.values())
    drawn = [steps for steps in several if most > 1 and delays[steps] == most]
    if drawn:
        blocks.append(
            Picture(
                "flow-steps",
                "Success against delay, one panel for each number of flow steps",
                flow_steps_figure(mean, drawn[-MAX_PANELS:]),
                "Bands: 95% intervals for these checkpoints.",
            )
        )
    blocks.append(as_table(flow_steps_grid(mean), "Episodes solved (%), mean of the tasks."))
    shown = [row for row in gaps if any(_same_cell(row, cell) for cell in mean)]
    if shown:
        caption = f"prefix - pinv, percentage points. {difference_interval_text(shown)}"
        blocks.append(as_table(gaps_grid(shown), caption))
    if len(results.tasks) > 1:
        tables = [
            as_table(flow_steps_grid(pick(rows, task=task, train_seed=ALL)), f"Task: {task}")
            for task in results.tasks
        ]
        blocks.append(Fold("The same for each task", tables))
    return [Section("flow-steps", "Fewer flow steps", blocks)]


def shared_protocol(rows: Sequence[Row]) -> tuple[str, list[int]]:
    """The protocol evaluated with most numbers of flow steps, and these numbers."""
    found: dict[str, set[int]] = {}
    for row in rows:
        found.setdefault(row["protocol"], set()).add(row["flow_steps"])
    if not found:
        return "", []
    protocol = max(found, key=lambda name: len(found[name]))
    return protocol, sorted(found[protocol])


def flow_steps_figure(rows: Sequence[Row], several: Sequence[int]) -> Figure:
    """Draw success against delay, one panel per number of flow steps, most steps first."""
    figure = new_figure(4.4 * len(several) + 0.6, 3.9)
    panels = figure.subplots(1, len(several), squeeze=False, sharey=True)[0]
    for axes, steps in zip(panels, sorted(several, reverse=True), strict=True):
        success_panel(axes, pick(rows, flow_steps=steps), title=f"K = {steps}")
    for axes in panels[1:]:
        axes.set_ylabel("")
    return figure


def flow_steps_grid(rows: Sequence[Row]) -> Grid:
    """One line per method and number of flow steps, one column per delay."""
    delays = sorted({row["delay"] for row in rows})
    lines = []
    for method in method_order(list(dict.fromkeys(row["method"] for row in rows))):
        for steps in sorted({row["flow_steps"] for row in pick(rows, method=method)}):
            line = [method, str(steps)]
            for delay in delays:
                cell = pick(rows, method=method, flow_steps=steps, delay=delay)
                line.append(points(cell[0]["success"]) if cell else "-")
            lines.append(line)
    return Grid(["method", "K", *(f"d={delay}" for delay in delays)], lines)


def gaps_grid(rows: Sequence[Row]) -> Grid:
    """One line per number of flow steps, one column per delay, with intervals."""
    delays = sorted({row["delay"] for row in rows})
    lines = []
    for steps in sorted({row["flow_steps"] for row in rows}):
        line = [str(steps)]
        for delay in delays:
            found = pick(rows, flow_steps=steps, delay=delay)
            line.append(_gap(found[0]) if found else "-")
        lines.append(line)
    return Grid(["K", *(f"d={delay}" for delay in delays)], lines, left=1)


def _gap(row: Row) -> str:
    spread = interval(row["low"], row["high"], sign=True)
    return f"{points(row['difference'], sign=True)} {spread}"


def _same_cell(row: Row, cell: Row) -> bool:
    keys = ("delay", "exec_horizon", "flow_steps")
    return all(row[key] == cell[key] for key in keys)
