"""The profile of a run: its own checkpoint's samplers, timed on an otherwise idle machine."""

from __future__ import annotations

from pathlib import Path

from rtc_cli.pipeline.executors import Progress
from rtc_cli.runs import open_run


def profile(folder: Path, progress: Progress) -> None:
    """Time the recipe's samplers on the first checkpoint; kept in `results/profile.json`."""
    run = open_run(folder)
    path = run.results / "profile.json"
    if path.is_file():
        return
    from rtc_cli.analysis.profile import Clock, profile_samplers, save_profile
    from rtc_cli.results import machine_record
    from rtc_cli.training.checkpoints import load_policy

    recipe, config = run.recipe, run.recipe.profile
    progress(0, 1, "compiling")
    rows = profile_samplers(
        load_policy(run.checkpoint(recipe.tasks[0], recipe.train.seeds[0], "base")),
        config.samplers,
        batch=config.batch,
        flow_steps=(recipe.eval.flow_steps,),
        rounds=config.rounds,
        clock=Clock(config.hz, config.rounding),
        label=recipe.name,
    )
    save_profile(path, rows, machine_record())
