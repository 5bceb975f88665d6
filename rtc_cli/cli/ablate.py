"""`rtc ablate`: training delays, or a grid of settings, compared."""

from __future__ import annotations

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
from rtc_cli.cli.output import output
from rtc_cli.cli.starting import all_overrides, start

app = typer.Typer()

DEFAULT_ABLATION = "ablations/delay_distribution"


@app.command(
    epilog="Examples:  rtc ablate ablations/delay_distribution   |   "
    "rtc ablate ablations/multimodality --seeds 0-2"
)
def ablate(
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
    """Compare training delays, or the settings of a grid.

    Distributions of simulated delays go on from one base policy. The combinations of a grid are
    runs of their own, below this one in variants/, on shared experts. Without RECIPE: the run's
    own, or ablations/delay_distribution.
    """
    from rtc_cli.pipeline.grid import grid_plan, locked, open_runs
    from rtc_cli.pipeline.plan import ablation_plan
    from rtc_cli.report.page import build_ablation_report
    from rtc_cli.report.terminal import render_report

    with output(as_json) as out:
        changes = all_overrides(set_, tasks, levels)
        opened = start(recipe, changes, run, resume=resume, seeds=seeds, default=DEFAULT_ABLATION)
        own = open_runs(opened)
        with locked([*own, opened]):
            jobs = grid_plan(opened, own) if own else ablation_plan(opened)
            run_jobs(opened, jobs, workers)
            built = build_ablation_report(opened.folder)
        out.result(
            built.data | {"report": str(built.html)},
            *render_report(built.data),
            *built.data.get("answer", ()),
            f"report: {built.html}",
        )
