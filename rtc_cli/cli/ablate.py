"""`rtc ablate`: which delays should be simulated in training?"""

from __future__ import annotations

import typer

from rtc_cli.cli.live import run_jobs
from rtc_cli.cli.options import (
    JsonOption,
    NewRunOption,
    NewSeedsOption,
    RecipeArgument,
    ResumeOption,
    SetOption,
    TasksOption,
    WorkersOption,
)
from rtc_cli.cli.output import output
from rtc_cli.cli.starting import set_with_tasks, start

app = typer.Typer()

DEFAULT_ABLATION = "ablations/delay_distribution"


@app.command(
    epilog="Examples:  rtc ablate ablations/delay_distribution   |   "
    "rtc ablate --set train.seeds=0,1 --set eval.episodes=256"
)
def ablate(
    recipe: RecipeArgument = None,
    tasks: TasksOption = None,
    set_: SetOption = None,
    run: NewRunOption = None,
    resume: ResumeOption = False,
    seeds: NewSeedsOption = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare distributions of delays simulated in training.

    Experts, data and the base policy up to the fork are computed once; each variant goes on from
    there. Without RECIPE: the run's own, or ablations/delay_distribution.
    """
    from rtc_cli.pipeline.plan import ablation_plan
    from rtc_cli.report.page import build_ablation_report
    from rtc_cli.report.render import render_ablation

    with output(as_json) as out:
        changes = set_with_tasks(set_, tasks)
        opened = start(recipe, changes, run, resume=resume, seeds=seeds, default=DEFAULT_ABLATION)
        with opened.lock():
            run_jobs(opened, ablation_plan(opened), workers)
            built = build_ablation_report(opened.folder)
        out.result(
            built.data | {"report": str(built.html)},
            *render_ablation(built.data),
            f"report: {built.html}",
        )
