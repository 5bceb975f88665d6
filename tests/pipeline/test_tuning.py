"""Tuning tries every setting; one that overflows is ruled out, the others are ranked."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from untrained_runs import save_untrained

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

TASK = "cartpole_thrust"
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
    run = create_run(load_recipe("standard", OVERRIDES), tmp_path / "run")
    save_untrained(run, TASK, "base", 90)
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
