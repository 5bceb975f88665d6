"""Checks of a recipe against what exists: tasks, methods, samplers, networks, legal cells."""

from __future__ import annotations

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.pipeline.charging import charged_by
from rtc_cli.pipeline.evaluation import TUNED, cells_of, methods_of, tuning_cells
from rtc_cli.pipeline.grid import combinations
from rtc_cli.recipe import EvalConfig, Recipe
from rtc_cli.tasks import get_task


def check_recipe(recipe: Recipe) -> None:
    """Raise UsageError for the first name or cell that the installed parts do not know."""
    from rtc_cli.core.policy import check_network
    from rtc_cli.samplers import list_samplers

    for task in recipe.tasks:
        get_task(task).prepare()
    check_network(recipe.network.kind, recipe.network.options(), recipe.horizon)
    for sampler in recipe.profile.samplers:
        if sampler not in list_samplers():
            raise UsageError(
                f'unknown sampler "{sampler}".{did_you_mean(sampler, list_samplers())}'
            )
    check_evaluation(recipe.eval, recipe.horizon)
    evaluations = (recipe.eval, *recipe.eval.further)
    if recipe.eval.tune is None and any(TUNED in each.methods for each in evaluations):
        raise UsageError(
            f'method "{TUNED}" is evaluated, but nothing tunes it',
            "give the recipe an [eval.tune] section",
        )
    for combination in combinations(recipe):
        check_recipe(combination.recipe)


def check_evaluation(config: EvalConfig, horizon: int) -> None:
    """Raise UsageError for an unknown method or a cell that is not legal at this horizon."""
    methods = methods_of(config)
    if not methods and TUNED not in config.methods:
        raise UsageError("no method is named", "name at least one, naive say")
    cells_of(config, horizon, methods)
    if config.tune is not None:
        tuning_cells(config.tune, horizon)
    charged_by(config, horizon)
    for further in config.further:
        check_evaluation(further, horizon)
