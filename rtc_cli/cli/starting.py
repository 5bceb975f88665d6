"""What `run`, `train` and `ablate` do first: read the recipe, check it, open or make the run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rtc_cli.errors import UsageError
from rtc_cli.recipe import Recipe, load_recipe
from rtc_cli.runs import MANIFEST_NAME, Run, newest_run, open_or_create_run, open_run

DEFAULT_RECIPE = "quickstart"


def start(
    recipe: str | None,
    overrides: Sequence[str] | None,
    folder: Path | None,
    *,
    resume: bool,
    default: str = DEFAULT_RECIPE,
) -> Run:
    """Return the run to work on; nothing is written before the whole recipe has been checked.

    Without a recipe, an existing `folder` says what it is; else the `default` recipe is taken,
    which is an ablation where the command needs one.
    """
    if recipe is None and folder is not None and (folder / MANIFEST_NAME).is_file():
        if overrides:
            raise UsageError(
                f"--set would change the recipe of the existing run {folder}",
                "leave --set away to go on with it, or name a recipe and another --run folder",
            )
        return open_run(folder)
    loaded = load_recipe(default if recipe is None else recipe, overrides or ())
    _check(loaded, ablation=default != DEFAULT_RECIPE)
    if resume and folder is None:
        return newest_run(loaded)
    return open_or_create_run(loaded, folder)


def worker_count(workers: int | None) -> int:
    """Return the processes to use: by default one per core that this process may use."""
    if workers is not None:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def _check(recipe: Recipe, *, ablation: bool) -> None:
    from rtc_cli.pipeline.checks import check_recipe

    check_recipe(recipe)
    if ablation and recipe.ablation is None:
        raise UsageError(
            f'recipe "{recipe.name}" has no [ablation] section',
            'use "rtc run" for it, or give an ablation recipe such as ablations/delay_distribution',
        )
