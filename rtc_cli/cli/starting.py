"""What `run`, `train` and `ablate` do first: read the recipe, check it, open or make the run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtc_cli.errors import UsageError
from rtc_cli.recipe import Recipe, load_recipe
from rtc_cli.runs import MANIFEST_NAME, Run, has_run, newest_run, open_or_create_run, open_run
from rtc_cli.units import parse_delays

DEFAULT_RECIPE = "quickstart"


def start(
    recipe: str | None,
    overrides: Sequence[str] | None,
    folder: Path | None,
    *,
    resume: bool,
    seeds: str | None = None,
    default: str = DEFAULT_RECIPE,
) -> Run:
    """Return the run to work on; nothing is written before the whole recipe has been checked.

    Without a recipe, an existing `folder` says what it is; else the `default` recipe is taken,
    which is an ablation where the command needs one. `seeds` replaces the recipe's training seeds;
    they are added to those of the newest run of the recipe, if there is one.
    """
    wanted = None if seeds is None else parse_delays(seeds, what="seeds")
    if recipe is None and folder is not None and (folder / MANIFEST_NAME).is_file():
        if overrides:
            raise UsageError(
                f"--set, --tasks and --levels would change the recipe of the existing run {folder}",
                "leave them away to go on with it, or name a recipe and another --run folder",
            )
        return open_run(folder).with_seeds(wanted or ())
    changes = [*(overrides or ())]
    if wanted is not None:
        changes.append(f"train.seeds={','.join(map(str, wanted))}")
    loaded = load_recipe(default if recipe is None else recipe, changes)
    _check(loaded, ablation=default != DEFAULT_RECIPE)
    if folder is None and (resume or (wanted is not None and has_run(loaded))):
        return newest_run(loaded).with_seeds(loaded.train.seeds)
    return open_or_create_run(loaded, folder)


def all_overrides(
    overrides: Sequence[str] | None, tasks: str | None, levels: str | None
) -> list[str]:
    """Return the overrides of --set, with --tasks and --levels as further ones."""
    named = {"tasks": tasks, "levels": levels}
    return [*(overrides or ()), *(f"{key}={text}" for key, text in named.items() if text)]


def _check(recipe: Recipe, *, ablation: bool) -> None:
    from rtc_cli.pipeline.checks import check_recipe

    check_recipe(recipe)
    if ablation and recipe.ablation is None:
        raise UsageError(
            f'recipe "{recipe.name}" has no [ablation] section',
            'use "rtc run" for it, or give an ablation recipe such as ablations/delay_distribution',
        )
