"""Runs whose policies were never trained: what commands need, without the time to train."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path

from random_weights import random_policy

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Policy, PolicyConfig
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import Run, create_run
from rtc_cli.tasks import get_task
from rtc_cli.training.checkpoints import CheckpointMeta, save_checkpoint
from rtc_cli.training.loop import initial_state

OPTIONS = (("channel_hidden", 8), ("channels", 8), ("layers", 1), ("token_hidden", 8))


@functools.cache
def untrained_policy(task: str, horizon: int = 8) -> Policy:
    """A small network with random weights, normalised actions and observations left as they are."""
    scene = get_task(task)
    config = PolicyConfig("mixer", OPTIONS, horizon, scene.obs_dim, scene.action_dim)
    return random_policy(config)


def untrained_run(folder: Path, recipe: str, overrides: Iterable[str], kinds: Iterable[str]) -> Run:
    """A run of a recipe's first task that holds checkpoints of some kinds, for every seed.

    A prefix checkpoint says that its delays were 0 to 2.
    """
    loaded = load_recipe(recipe, list(overrides))
    run, task = create_run(loaded, folder), get_task(loaded.tasks[0])
    for seed in loaded.train.seeds:
        for kind in kinds:
            save_untrained(run, task.name, kind, seed)
    return run


def save_untrained(run: Run, task: str, kind: str, seed: int) -> None:
    """Put an untrained checkpoint into a run."""
    recipe, policy = run.recipe, untrained_policy(task, run.recipe.horizon)
    meta = CheckpointMeta(
        task=task,
        kind=kind,  # type: ignore[arg-type]
        train_seed=seed,
        epoch=0,
        epochs=1,
        config=policy.config,
        normaliser=policy.normaliser,
        delays=DelayDistribution.exponential((0, 1, 2)) if kind == "prefix" else None,
        recipe_hash=recipe.content_hash,
        scene_digest=get_task(task).digest,
    )
    state = initial_state(policy.params, recipe.train, seed)
    save_checkpoint(run.checkpoint(task, seed, kind), state, meta)
