"""Builds the report of a run: report.md with PNG figures, index.html, rows.json, CSV tables."""

from pathlib import Path
from typing import Any

import pandas as pd

from rtc_cli.errors import StateError
from rtc_cli.report import figures, sections
from rtc_cli.report.charge.page import charge_section
from rtc_cli.report.document import (
    Block,
    Code,
    Document,
    Fold,
    Paragraph,
    Picture,
    Section,
)
from rtc_cli.report.grid.document import grid_document
from rtc_cli.report.grid.rows import grid_of, load_grid
from rtc_cli.report.inputs import RunInputs, load_run
from rtc_cli.report.losses import sections as loss_sections
from rtc_cli.report.losses.text import (
    control_alarms,
    loss_answer,
    main_protocol,
    trend_sentences,
)
from rtc_cli.report.render import differences_grid, success_grid
from rtc_cli.report.selection import fits_protocol
from rtc_cli.report.steps import flow_steps_sections
from rtc_cli.report.tables import ALL, Row, ablation_differences, ablation_table, pick
from rtc_cli.report.text import (
    QUESTION,
    SUMMARY_INTERVAL,
    ablation_answer,
    answer,
    difference_interval_text,
    protocol_text,
)
from rtc_cli.report.writing import ReportPaths, write_document
from rtc_cli.results import machine_record

REPORT = "report"


def build_report(run_folder: Path | str) -> ReportPaths:
    """Build the report of an evaluated run in `<run>/report/`, replacing an older one.

    Raises StateError where the run is missing, damaged, or holds no evaluated episodes.
    """
    run = load_run(run_folder)
    if run.episodes.empty and (grid_of(run.recipe) or not run.variants.empty):
        return build_ablation_report(run_folder)
    if run.episodes.empty:
        raise _nothing_to_report(run, "rtc eval")
    results = sections.compute(run.episodes)
    document = Document(
        title=f"Real-time chunking under delay: {run.name}",
        subtitle=_subtitle(run),
        question=QUESTION,
        answer=_answer(results),
        sections=[
            *loss_sections.glance(results),
            sections.how_to_read(run, results),
            sections.success(results),
            sections.paired_differences(results),
            *flow_steps_sections(results),
            loss_sections.losses(results),
            sections.tolerance(results),
            sections.matrix(results),
            sections.smoothness(results, loss_sections.seam(results)),
            sections.profile(run),
            *([charge_section(run.charge)] if run.charge else []),
            sections.training(run),
            sections.experts(run),
            sections.provenance(run),
            sections.trace(results),
            sections.glossary(),
        ],
    )
    return write_document(run.folder / REPORT, document, results_json(run, results))


def _answer(results: sections.Results) -> list[str]:
    protocol = main_protocol(results.summary)
    return [
        *control_alarms(results.controls),
        *answer(results.summary, results.differences, results.falls),
        *loss_answer(results.decomposition, results.recovered, results.classes),
        *trend_sentences(results.differences, results.classes, protocol),
    ]


def results_json(run: RunInputs, results: sections.Results) -> dict[str, Any]:
    """Return all rows of a report as one JSON document (schema 1)."""
    return {
        "schema": 1,
        "run": str(run.folder),
        "machine": machine_record(),
        "rows": results.every_summary,
        "differences": results.every_difference,
        **results.losses,
        "d90": results.d90,
        "matrix": results.matrix,
        "naive_fall": results.falls,
        "cells": results.cells,
    }


def _nothing_to_report(run: RunInputs, command: str) -> StateError:
    return StateError(
        f"run {run.folder} holds no evaluated episodes, so there is nothing to report",
        f'run "{command} --run {run.folder}" first',
    )


def _subtitle(run: RunInputs) -> str:
    created = str(run.manifest.get("created", ""))[:10]
    parts = [str(run.recipe.get("description", "")), f"Run of {created}" if created else ""]
    parts.append(f"recipe `{str(run.manifest.get('recipe_hash', ''))[:12] or 'unknown'}`")
    return ". ".join(part.rstrip(". ") for part in parts if part) + "."


# -- ablation --------------------------------------------------------------------------------


def build_ablation_report(
    run_folder: Path | str, *, episodes: pd.DataFrame | None = None, baseline: str | None = None
) -> ReportPaths:
    """Build the report of an ablation: success by evaluation delay per training distribution.

    `episodes` (default: the run's) has the column `variant`; `baseline` (default: the recipe's,
    else the first variant) is what the others are compared with. A grid has a report of its own.
    """
    run = load_run(run_folder)
    # A run may hold both: then the report of the evaluation keeps its place.
    where = REPORT if run.episodes.empty else f"{REPORT}/ablation"
    if grid_of(run.recipe):
        grid = load_grid(run.folder, run.recipe)
        return write_document(run.folder / where, *grid_document(run, grid, _subtitle(run)))
    rows = run.variants if episodes is None else episodes
    if rows.empty:
        raise _nothing_to_report(run, "rtc ablate")
    table = ablation_table(rows)
    baseline = baseline or _baseline(run, table)
    gaps = ablation_differences(rows, baseline)
    protocols = list(dict.fromkeys(row["protocol"] for row in table))
    document = Document(
        title=f"Ablation: {run.name}",
        subtitle=_subtitle(run),
        question="Which delays should be simulated in training?",
        answer=ablation_answer(gaps, baseline, protocols[0]),
        sections=[
            *(_ablation_section(table, gaps, baseline, protocol) for protocol in protocols),
            _variants(run),
            sections.provenance(run),
            sections.glossary(),
        ],
    )
    data = {
        "schema": 1,
        "run": str(run.folder),
        "machine": machine_record(),
        "baseline": baseline,
        "rows": table,
        "differences": gaps,
    }
    return write_document(run.folder / where, document, data)


def _baseline(run: RunInputs, table: list[Row]) -> str:
    named = run.recipe.get("ablation", {}).get("baseline")
    return str(named or table[0]["variant"])


def _ablation_section(table: list[Row], gaps: list[Row], baseline: str, protocol: str) -> Section:
    rows = pick(table, protocol=protocol)
    mine = [row for row in gaps if fits_protocol(row, protocol)]
    name = protocol.replace(":", "-")
    tasks = sorted({row["task"] for row in rows} - {ALL})
    caption = f"Percentage points against `{baseline}`. Bold: the interval excludes 0. "
    blocks: list[Block] = [
        Paragraph(
            "Each line is one policy, fine-tuned with its own distribution of simulated delays "
            "from the same base checkpoint, and evaluated at every delay."
        ),
        Picture(
            f"ablation-{name}",
            "Success by evaluation delay, one line per training distribution",
            figures.success_figure(rows, protocol, series="variant"),
            "Bands: 95% intervals for these checkpoints.",
        ),
        sections.as_table(
            success_grid(rows, series="variant"), f"Episodes solved (%). {SUMMARY_INTERVAL}"
        ),
        sections.as_table(
            differences_grid(mine, protocol), caption + difference_interval_text(mine)
        ),
    ]
    if len(tasks) > 1:
        tables = [
            sections.as_table(success_grid(rows, series="variant", task=task), f"Task: {task}")
            for task in tasks
        ]
        blocks.append(Fold("The same for each task", tables))
    title = f"Success by training distribution, {protocol_text(protocol).split(':')[0]}"
    return Section(f"ablation-{name}", title.replace("`", ""), blocks)


def _variants(run: RunInputs) -> Section:
    lines = [f"{name}: {values}" for name, values in _variant_settings(run).items()]
    text = "\n".join(lines) or "The recipe lists no variants."
    return Section("variants", "The training distributions", [Code(text)])


def _variant_settings(run: RunInputs) -> dict[str, Any]:
    return dict(run.recipe.get("ablation", {}).get("variants", {}))
