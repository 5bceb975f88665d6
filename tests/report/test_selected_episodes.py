"""Which of a run's stored episodes an evaluation shows."""

from __future__ import annotations

import pytest

from rtc_cli.cli.evaluated import selected_episodes
from rtc_cli.recipe import load_recipe
from rtc_cli.results import ResultStore
from rtc_cli.runs import create_run


@pytest.mark.parametrize(
    ("overrides", "noises"),
    [
        ([], {0.1}),
        (["eval.methods=naive,oracle"], {0.1}),
        (["eval.action_noise=0.0,0.1,0.2"], {0.0, 0.1, 0.2}),
    ],
)
def test_an_evaluation_shows_the_noises_that_it_asked_for(synthetic, overrides, noises, tmp_path):
    run = create_run(load_recipe("quickstart", ["eval.episodes=8", *overrides]), tmp_path / "run")
    store = ResultStore(run.results / "episodes")
    for noise in (0.0, 0.1, 0.2, 0.3):
        frame = synthetic.cell(
            "naive", "cartpole_thrust", 0, "paper", 2, 2, [True] * 8, action_noise=noise
        )
        store.append(frame["cell"].iloc[0], frame)
    rows = selected_episodes(run, run.recipe.eval, run.recipe.tasks, (0,))
    assert set(rows["action_noise"]) == noises
    assert len(rows) == 8 * len(noises)


@pytest.mark.parametrize(
    ("overrides", "models"),
    [
        ([], {"constant:2"}),
        (['eval.delay_models=["uniform:0-4"]'], {"uniform:0-4"}),
        (['eval.delay_models=["uniform:0-4", "constant:2"]'], {"uniform:0-4", "constant:2"}),
        (['eval.delay_models=["poisson:2"]'], set()),
        (["eval.observation_lag=1"], set()),
    ],
)
def test_an_evaluation_shows_the_delays_that_it_asked_for(synthetic, overrides, models, tmp_path):
    run = create_run(load_recipe("quickstart", ["eval.episodes=8", *overrides]), tmp_path / "run")
    store = ResultStore(run.results / "episodes")
    for model in ("constant:2", "uniform:0-4"):
        for estimator in ("exact", "max-of-last:3"):
            frame = synthetic.cell(
                "naive", "cartpole_thrust", 0, "paper", 2, 2, [True] * 8,
                delay_model=model, estimator=estimator,
            )  # fmt: skip
            store.append(frame["cell"].iloc[0], frame)
    rows = selected_episodes(run, run.recipe.eval, run.recipe.tasks, (0,))
    assert set(rows["delay_model"]) == models
    assert set(rows["estimator"]) <= {"exact"}
    assert len(rows) == 8 * len(models)


def test_an_evaluation_that_the_run_does_not_hold_has_no_rows(synthetic, tmp_path):
    run = create_run(load_recipe("quickstart", ["eval.episodes=8"]), tmp_path / "run")
    frame = synthetic.cell("naive", "cartpole_thrust", 0, "paper", 2, 2, [True] * 8)
    ResultStore(run.results / "episodes").append(frame["cell"].iloc[0], frame)
    rows = selected_episodes(run, run.recipe.eval, run.recipe.tasks, (7,))
    assert rows.empty
    assert {"task", "delay", "solved"} <= set(rows.columns)
