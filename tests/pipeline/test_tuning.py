"""Tuning tries every setting; one that overflows is ruled out, the others are ranked."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import pytest

from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.errors import DivergedError
from rtc_cli.pipeline.evaluation import (
    choose_tuned,
    evaluate,
    try_settings,
    tuned_method,
    tuning_cells,
    tuning_target,
)
from rtc_cli.recipe import TuneConfig, load_recipe
from rtc_cli.results import ResultStore
from rtc_cli.runs import Run, create_run
from rtc_cli.tasks import get_task
from rtc_cli.training.checkpoints import CheckpointMeta, save_checkpoint
from rtc_cli.training.loop import initial_state

TASK = "cartpole_thrust"
OPTIONS = (("channel_hidden", 8), ("channels", 8), ("layers", 1), ("token_hidden", 8))
OVERRIDES = [
    f"tasks={TASK}",
    "eval.tune.max_guidance_weight=1.0,1e38",  # the second overflows in float32
    "eval.tune.prior_std=1.0",
    "eval.tune.mask=ones",
    "eval.tune.delays=2",
    "eval.tune.episodes=8",
    "eval.flow_steps=2",
]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run that holds an untrained base policy of the tuning seed."""
    recipe, scene = load_recipe("standard", OVERRIDES), get_task(TASK)
    run = create_run(recipe, tmp_path / "run")
    config = PolicyConfig("mixer", OPTIONS, recipe.horizon, scene.obs_dim, scene.action_dim)
    normaliser = Normaliser.identity(scene.obs_dim, scene.action_dim)
    policy = Policy.init(config, normaliser, jax.random.key(0), adaln_zero=False)
    meta = CheckpointMeta(
        task=TASK,
        kind="base",
        train_seed=90,
        epoch=0,
        epochs=1,
        config=config,
        normaliser=normaliser,
        delays=None,
        recipe_hash=recipe.content_hash,
        scene_digest=scene.digest,
    )
    folder = run.checkpoint(TASK, 90, "base")
    save_checkpoint(folder, initial_state(policy.params, recipe.train, 90), meta)
    return run


def tune(run: Run) -> TuneConfig:
    assert run.recipe.eval.tune is not None
    return run.recipe.eval.tune


def test_a_setting_that_overflows_is_ruled_out(run: Run) -> None:
    cells = tuning_cells(tune(run), run.recipe.horizon)
    target = tuning_target(run, tune(run), TASK)
    try_settings(target, cells, lambda *_: None)
    assert set(ResultStore(target.store).load().method) == {"pinv[ones,1,1]"}
    before = sorted(target.store.rglob("*"))
    try_settings(target, cells, lambda *_: pytest.fail("nothing is left to try"))
    assert sorted(target.store.rglob("*")) == before
    choose_tuned(run.folder, lambda *_: None)
    assert dict(tuned_method(run).settings)["max_guidance_weight"] == 1.0
    grid = json.loads((run.results / "tuned.json").read_text())["grid"]
    assert [entry["success"] is None for entry in grid] == [False, True]


def test_elsewhere_a_cell_that_overflows_ends_the_evaluation(run: Run) -> None:
    cells = tuning_cells(tune(run), run.recipe.horizon)
    with pytest.raises(DivergedError, match="NaN or infinity"):
        evaluate(tuning_target(run, tune(run), TASK), cells, lambda *_: None)
