"""`rtc train`: experts, data, base policy, prefix policy."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from rtc_cli.cli.live import run_jobs
from rtc_cli.cli.options import (
    JsonOption,
    LevelsOption,
    NewRunOption,
    NewSeedsOption,
    RecipeArgument,
    ResumeOption,
    SetOption,
    TasksOption,
    WorkersOption,
)
from rtc_cli.cli.output import document, output
from rtc_cli.cli.starting import all_overrides, start

if TYPE_CHECKING:
    from rich.table import Table

    from rtc_cli.runs import Run

app = typer.Typer()


@app.command(
    epilog="Examples:  rtc train   |   rtc train standard --set train.epochs=8   |   "
    "rtc train --run runs/mine"
)
def train(
    recipe: RecipeArgument = None,
    tasks: TasksOption = None,
    levels: LevelsOption = None,
    set_: SetOption = None,
    run: NewRunOption = None,
    resume: ResumeOption = False,
    seeds: NewSeedsOption = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train experts, then the base and the prefix policy.

    Stages that the run already holds are skipped; a training that was interrupted goes on from its
    last whole epoch and ends with the same bits. Without RECIPE: the run's own, or quickstart.
    """
    from rtc_cli.pipeline.plan import train_plan
    from rtc_cli.results import machine_record

    with output(as_json) as out:
        changes = all_overrides(set_, tasks, levels)
        opened = start(recipe, changes, run, resume=resume, seeds=seeds)
        with opened.lock():
            run_jobs(opened, train_plan(opened), workers)
        rows = _rows(opened)
        out.result(
            document(str(opened.folder), machine_record(), rows),
            _table(rows),
            f"run: {opened.folder}",
        )


def _rows(run: Run) -> list[dict[str, Any]]:
    """Return one row per checkpoint: what it is, its last loss, its epochs and seconds."""
    from rtc_cli.report.inputs import load_run

    return [
        {
            "task": curve["task"],
            "train_seed": curve["train_seed"],
            "checkpoint": curve["checkpoint"],
            "epochs": curve["epochs"][-1],
            "loss": curve["loss"][-1],
            "samples_per_s": statistics.median(curve["samples_per_s"]),
            "seconds": sum(curve["seconds"]),
        }
        for curve in load_run(run.folder).training
        if curve["epochs"]
    ]


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    from rtc_cli.report.render import Grid, rich_table

    lines = [
        [
            row["task"],
            str(row["train_seed"]),
            row["checkpoint"],
            str(row["epochs"]),
            f"{row['loss']:.4f}",
            f"{row['samples_per_s']:,.0f}",
            f"{row['seconds']:.0f}",
        ]
        for row in rows
    ]
    columns = ["task", "seed", "checkpoint", "epochs", "last loss", "samples/s", "seconds"]
    return rich_table(Grid(columns, lines, left=3), "Training")
