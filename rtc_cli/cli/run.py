"""`rtc run`: the whole job, from experts to the report."""

from __future__ import annotations

import typer

from rtc_cli.cli.live import run_alone, run_jobs
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


@app.command(
    epilog="Examples:  rtc run   |   rtc run standard --seeds 0-2   |   rtc run standard --resume"
)
def run(
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
    """Do the whole job: train, evaluate under delay, profile, report.

    Everything that the run already holds is kept: call it again with --resume, or with the same
    --run folder, to go on after an interruption. Without RECIPE: the run's own, or quickstart.
    """
    from rtc_cli.cli.charged import render_charged, save_charged
    from rtc_cli.cli.evaluated import evaluation_document, evaluation_tables, selected_episodes
    from rtc_cli.pipeline.plan import profile_plan, run_plan
    from rtc_cli.report.page import build_report
    from rtc_cli.report.sections import compute

    with output(as_json) as out:
        changes = all_overrides(set_, tasks, levels)
        opened = start(recipe, changes, run, resume=resume, seeds=seeds)
        with opened.lock():
            run_jobs(opened, run_plan(opened), workers)
            run_alone(profile_plan(opened))
            charged = save_charged(opened)
            page = build_report(opened.folder).html
        recipe_ = opened.recipe
        results = compute(
            selected_episodes(opened, recipe_.eval, recipe_.tasks, recipe_.train.seeds)
        )
        out.result(
            evaluation_document(opened, results) | {"charge": charged, "report": str(page)},
            *evaluation_tables(results),
            *([] if charged is None else render_charged(charged)),
            f"report: {page}",
        )
