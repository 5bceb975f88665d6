"""The report of a grid ablation as a document: answer, figures, tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtc_cli.report import sections
from rtc_cli.report.document import Block, Document, Fold, Note, Paragraph, Picture, Section
from rtc_cli.report.grid.figures import grid_figure
from rtc_cli.report.grid.rows import (
    GridEpisodes,
    effect_rows,
    grid_differences,
    grid_summary,
    last_cell,
    require,
    settings_of,
)
from rtc_cli.report.grid.tables import effects_grid, settings_grid
from rtc_cli.report.grid.text import QUESTION, factor_name, grid_answer, setting_text, value_text
from rtc_cli.report.inputs import RunInputs
from rtc_cli.report.selection import fits_protocol
from rtc_cli.report.tables import ALL, Row, main_flow_steps, pick
from rtc_cli.report.text import difference_interval_text, protocol_text
from rtc_cli.results import machine_record


def grid_document(
    run: RunInputs, grid: GridEpisodes, subtitle: str
) -> tuple[Document, dict[str, Any]]:
    """Return the document of a grid ablation and its rows as JSON (schema 1).

    Raises StateError where no setting was evaluated.
    """
    require(grid, Path(run.folder))
    steps = main_flow_steps(grid.parts[0][1])
    rows = pick(grid_summary(grid), flow_steps=steps)
    gaps = pick(grid_differences(grid), flow_steps=steps)
    effects, settings = effect_rows(grid), settings_of(grid)
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    answer = grid_answer(gaps, effects, protocols[0], list(grid.factors))
    document = Document(
        title=f"Ablation: {run.name}",
        subtitle=subtitle,
        question=QUESTION,
        answer=answer,
        sections=[
            _setup(grid, run),
            *(_results(rows, gaps, grid, settings, protocol) for protocol in protocols),
            *(_effects(effects, protocol) for protocol in protocols),
            sections.experts_of_settings(
                run, [(setting_text(settings), found) for settings, found in grid.mixtures]
            ),
            sections.provenance(run),
            sections.glossary(),
        ],
    )
    data = {
        "schema": 1,
        "run": str(run.folder),
        "machine": machine_record(),
        "grid": {key: list(values) for key, values in grid.factors.items()},
        "settings": settings,
        "rows": rows,
        "differences": gaps,
        "effects": effects,
        "answer": answer,
    }
    return document, data


def _setup(grid: GridEpisodes, run: RunInputs) -> Section:
    """Say what was varied, and what was not."""
    varied = "; ".join(
        f"{factor_name(key)}: {', '.join(map(value_text, values))}"
        for key, values in grid.factors.items()
    )
    blocks: list[Block] = [
        Paragraph(
            f"{grid.count} settings: {varied}. Every combination of training settings has data, a "
            "base and a prefix policy of its own, from the same experts; all are evaluated on the "
            "same episodes. Execution noise is that of the worlds during evaluation; data were "
            "collected with each task's own."
        )
    ]
    if len(grid.parts) < grid.count:
        blocks.append(Note(f"Only {len(grid.parts)} of {grid.count} settings are evaluated yet."))
    return Section("settings", "What was varied", blocks)


def _results(
    rows: Sequence[Row],
    gaps: Sequence[Row],
    grid: GridEpisodes,
    settings: list[dict[str, Any]],
    protocol: str,
) -> Section:
    mine = pick(rows, protocol=protocol)
    found = [row for row in gaps if fits_protocol(row, protocol)]
    title = f"Results, {protocol_text(protocol).split(':')[0]}".replace("`", "")
    if not found:
        return Section(f"grid-{protocol}", title, [Note("No two methods were evaluated yet.")])
    cell, tasks = last_cell(found, protocol), sorted({row["task"] for row in mine} - {ALL})
    shown = [ALL] if len(tasks) > 1 and pick(found, task=ALL, **cell) else []
    blocks: list[Block] = []
    for task in [*shown, *tasks]:
        name = f"mean of {len(tasks)} tasks" if task == ALL else f"task {task}"
        label = f"Success and differences at d = {cell['delay']}, {name}"
        picture = f"grid-{protocol.replace(':', '-')}-{task}"
        drawing = grid_figure(mine, found, grid.factors, cell, task=task)
        blocks.append(Picture(picture, label, drawing, f"{label}. Bars: 95% intervals."))
    for delay, s in sorted({(row["delay"], row["exec_horizon"]) for row in found}, reverse=True):
        point = {"delay": delay, "exec_horizon": s}
        tables = [_table(mine, found, settings, point, task) for task in [*shown, *tasks]]
        blocks.append(tables[0])
        if tables[1:]:
            blocks.append(Fold(f"The same for each task at d = {delay}", tables[1:]))
    return Section(f"grid-{protocol.replace(':', '-')}", title, blocks)


def _table(
    rows: Sequence[Row],
    gaps: Sequence[Row],
    settings: list[dict[str, Any]],
    cell: dict[str, int],
    task: str,
) -> Block:
    where = "mean of the tasks" if task == ALL else f"task {task}"
    caption = (
        f"At d = {cell['delay']}, s = {cell['exec_horizon']}, {where}: episodes solved (%), "
        "differences in points. Bold: the interval excludes 0. "
    )
    grid = settings_grid(rows, gaps, settings, cell, task=task)
    return sections.as_table(grid, caption + difference_interval_text(pick(gaps, **cell)))


def _effects(effects: Sequence[Row], protocol: str) -> Section:
    mine = [row for row in effects if fits_protocol(row, protocol)]
    title = f"What changes it, {protocol_text(protocol).split(':')[0]}".replace("`", "")
    delays = sorted({row["delay"] for row in mine})
    text = (
        "How success of naive, and the differences between methods, change from the first to the "
        "last value of one factor; the other factors are averaged. A factor under which a "
        "difference grows is a condition for conditioning to help."
    )
    caption = f"Percentage points. {difference_interval_text(mine)}"
    table = sections.as_table(effects_grid(mine, delays), caption)
    return Section(f"effects-{protocol.replace(':', '-')}", title, [Paragraph(text), table])
