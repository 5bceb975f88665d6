"""What commands that evaluate a run's policies share: reading what is asked, and evaluating it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.evaluated import selected_episodes
from rtc_cli.cli.live import run_jobs
from rtc_cli.cli.options import check_names, read_names, split_names
from rtc_cli.errors import UsageError
from rtc_cli.levels import expand, short_name
from rtc_cli.recipe import EvalConfig, Recipe
from rtc_cli.runs import Run
from rtc_cli.units import parse_delays

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Asked:
    """An evaluation that was asked for: of which run, which cells, on which checkpoints."""

    run: Run
    config: EvalConfig
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]


def open_asked(folder: Path | None) -> Run:
    """Open the run of --run, or the newest."""
    from rtc_cli.runs import newest_run, open_run

    return open_run(folder) if folder is not None else newest_run()


def ask(
    run: Run,
    changes: Mapping[str, Any],
    *,
    tasks: str | None,
    seeds: str | None,
    guidance: Mapping[str, str | float | None] | None = None,
) -> Asked:
    """Return a run's own evaluation with changes of `[eval]`, checked; None changes nothing.

    `tasks` and `seeds` are the texts of --tasks and --seeds; `guidance` changes `[eval.pinv]`.
    """
    config = _changed(run.recipe, changes, guidance or {})
    return Asked(run, config, _tasks(tasks, run.recipe), _seeds(seeds, run.recipe))


def evaluate_asked(asked: Asked, workers: int | None) -> pd.DataFrame:
    """Evaluate the cells that the run does not hold yet; return the rows of all that were asked."""
    from rtc_cli.pipeline.checks import check_evaluation
    from rtc_cli.pipeline.plan import eval_plan

    run, config = asked.run, asked.config
    check_evaluation(config, run.recipe.horizon)
    with run.lock():
        run_jobs(run, eval_plan(run, config, asked.tasks, asked.seeds), workers)
    return selected_episodes(run, config, asked.tasks, asked.seeds)


def read_methods(text: str | None) -> tuple[str, ...] | None:
    """Read --methods; None where it was not given."""
    from rtc_cli.execution.methods import list_methods
    from rtc_cli.pipeline.evaluation import TUNED

    return None if text is None else read_names(text, (*list_methods(), TUNED), "method")


def read_protocols(text: str | None) -> tuple[str, ...] | None:
    """Read --protocol; None where it was not given."""
    return None if text is None else split_names(text)


def _changed(
    recipe: Recipe, changes: Mapping[str, Any], guidance: Mapping[str, str | float | None]
) -> EvalConfig:
    """Return the recipe's evaluation with the options in place, validated like a recipe."""
    from rtc_cli.recipe import recipe_from_dict

    content = recipe.model_dump(mode="json", exclude_none=True)
    content["eval"] |= {name: value for name, value in changes.items() if value is not None}
    pushed, episodes = content["eval"]["reaction_episodes"], content["eval"]["episodes"]
    content["eval"]["reaction_episodes"] = min(pushed, episodes)
    content["eval"]["pinv"] |= {n: value for n, value in guidance.items() if value is not None}
    if changes.get("methods") is not None:
        content["eval"].pop("tune", None)
    if changes.get("charge") is None:
        content["eval"].pop("charge", None)  # belongs to `rtc run`
    if not content["eval"]["delay_models"] and changes.get("delay_cap") is None:
        content["eval"].pop("delay_cap", None)
    return recipe_from_dict(content, "options", fix="change that option").eval


def _tasks(text: str | None, recipe: Recipe) -> tuple[str, ...]:
    """Names as the recipe has them, from full or short names; a folder stands for its levels."""
    if text is None:
        return recipe.tasks
    known = {short_name(task): task for task in recipe.tasks}
    asked = dict.fromkeys(short_name(task) for task in expand(split_names(text)))
    return tuple(known[name] for name in check_names(asked, known, "task of this run"))


def _seeds(text: str | None, recipe: Recipe) -> tuple[int, ...]:
    if text is None:
        return recipe.train.seeds
    wanted = parse_delays(text, what="seeds")
    for seed in wanted:
        if seed not in recipe.train.seeds:
            raise UsageError(
                f"training seed {seed} is not in this run",
                f"its training seeds are {', '.join(map(str, recipe.train.seeds))}; "
                'add seeds to it with "rtc run --seeds"',
            )
    return wanted
