"""The rows of the report against plain loops and numbers worked out by hand."""

import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from rtc_cli.errors import StateError
from rtc_cli.report.inputs import load_episodes
from rtc_cli.report.render import d90_text, differences_grid, success_grid
from rtc_cli.report.tables import (
    ablation_differences,
    ablation_table,
    d90_rows,
    differences,
    matrix_rows,
    naive_fall_rows,
    pick,
    summarise,
)

ROW_KEYS = [
    "task", "method", "checkpoint", "sampler", "schedule", "train_seed", "protocol", "delay",
    "exec_horizon", "flow_steps", "episodes", "solved", "success", "success_low", "success_high",
    "beyond_trained",
]  # fmt: skip
DIFFERENCE_KEYS = [
    "task", "delay", "exec_horizon", "method", "baseline", "difference", "low", "high",
]  # fmt: skip
T, F = True, False
PREFIX = ("prefix", "prefix", "async")


@pytest.fixture(scope="module")
def episodes(run_folder: Path) -> pd.DataFrame:
    return load_episodes(run_folder)


def test_the_keys_are_those_of_the_format(episodes: pd.DataFrame) -> None:
    for row in summarise(episodes):
        assert list(row)[: len(ROW_KEYS)] == ROW_KEYS
    for row in differences(episodes):
        assert list(row)[: len(DIFFERENCE_KEYS)] == DIFFERENCE_KEYS


def test_success_is_what_a_loop_counts(episodes: pd.DataFrame) -> None:
    rows = pick(summarise(episodes), protocol="fixed:4", method="prefix", train_seed="all")
    for row in rows:
        rates = []
        for task in ("catcher", "lunar_lander"):
            mine = [
                bool(e.solved)
                for e in episodes.itertuples()
                if e.task == task
                and e.method == "prefix"
                and (e.delay, e.exec_horizon, e.protocol) == (row["delay"], 4, "fixed:4")
            ]
            rates.append(sum(mine) / len(mine))
            if row["task"] == task:
                assert row["episodes"] == len(mine) == 32
                assert row["solved"] == sum(mine)
                assert row["success"] == pytest.approx(rates[-1])
        if row["task"] == "all":
            assert row["success"] == pytest.approx(np.mean(rates))
    assert len(rows) == 3 * 3


def test_tasks_weigh_the_same_whatever_their_episodes(synthetic: ModuleType) -> None:
    frames = [
        synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [T] * 30),
        synthetic.cell("naive", "lunar_lander", 0, "paper", 0, 1, [F] * 10),
    ]
    mean = pick(summarise(pd.concat(frames)), task="all", train_seed="all")
    assert [row["success"] for row in mean] == [0.5]
    assert mean[0]["episodes"] == 40
    # Square-and-add of the two Wilson intervals: 1 - 30/(30+z²) and z²/(10+z²), halved.
    z2 = 1.959963984540054**2
    assert mean[0]["success_low"] == pytest.approx(0.5 - z2 / (30 + z2) / 2)
    assert mean[0]["success_high"] == pytest.approx(0.5 + z2 / (10 + z2) / 2)


def test_the_mean_waits_until_every_task_has_the_cell(synthetic: ModuleType) -> None:
    frames = [
        synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [T, F]),
        synthetic.cell("naive", "lunar_lander", 0, "paper", 0, 1, [T, F]),
        synthetic.cell("naive", "catcher", 0, "paper", 1, 1, [T, F]),
    ]
    means = pick(summarise(pd.concat(frames)), task="all", train_seed="all")
    assert [row["delay"] for row in means] == [0]


def test_a_wilson_interval_worked_out_by_hand(synthetic: ModuleType) -> None:
    frame = synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [T] * 8 + [F] * 2)
    row = pick(summarise(frame), task="catcher", train_seed=0)[0]
    assert row["success_low"] == pytest.approx(0.4902, abs=5e-5)
    assert row["success_high"] == pytest.approx(0.9433, abs=5e-5)


def test_a_cell_of_two_protocols_counts_once_in_each(synthetic: ModuleType) -> None:
    outcome = [T, F, T, T]
    both = [
        synthetic.cell("naive", "catcher", 0, protocol, 4, 4, outcome)
        for protocol in ("paper", "fixed:4")
    ]
    one = [both[0], synthetic.cell("naive", "catcher", 0, "fixed:4", 0, 4, [T] * 4)]
    for frames in (both, one):
        rows = pick(summarise(pd.concat(frames)), task="catcher", train_seed=0, delay=4)
        assert {row["protocol"] for row in rows} == {"paper", "fixed:4"}
        assert all((row["solved"], row["episodes"]) == (3, 4) for row in rows)


def test_the_difference_with_one_seed_is_paired_by_episode(synthetic: ModuleType) -> None:
    frames = [
        synthetic.cell("prefix", "catcher", 0, "paper", 2, 2, [T, T, T, F], triple=PREFIX),
        synthetic.cell("pinv", "catcher", 0, "paper", 2, 2, [T, F, F, F]),
    ]
    row = pick(differences(pd.concat(frames)), task="catcher")[0]
    # gaps 0, 1, 1, 0: mean 1/2, sample variance 1/3, standard error sqrt(1/12)
    half = 1.959963984540054 * math.sqrt(1 / 12)
    assert (row["method"], row["baseline"]) == ("prefix", "pinv")
    assert row["difference"] == pytest.approx(0.5)
    assert row["low"] == pytest.approx(0.5 - half)
    assert row["high"] == pytest.approx(0.5 + half)
    assert (row["seeds"], row["interval"]) == (1, "checkpoints")


@pytest.mark.usefixtures("two_degrees_will_do")
def test_the_difference_over_seeds_follows_the_formula(episodes: pd.DataFrame) -> None:
    row = pick(differences(episodes), task="all", method="prefix", baseline="pinv", delay=2)
    row = pick(row, exec_horizon=4)[0]
    mine = episodes.query('delay == 2 and exec_horizon == 4 and protocol == "fixed:4"')
    rates = mine.groupby(["method", "task", "train_seed"]).solved.mean()
    table = (rates["prefix"] - rates["pinv"]).unstack("train_seed").to_numpy()
    error = math.sqrt(sum(np.var(line, ddof=1) / 2 for line in table)) / 2
    t_2 = 4.302652729911275  # two tasks, two seeds: two degrees of freedom
    assert row["difference"] == pytest.approx(table.mean())
    assert row["low"] == pytest.approx(table.mean() - t_2 * error)
    assert row["high"] == pytest.approx(table.mean() + t_2 * error)
    assert row["interval"] == "seeds"


def test_too_few_seeds_describe_the_checkpoints(synthetic: ModuleType) -> None:
    """One task, R seeds: t with R - 1 degrees of freedom from five seeds on."""
    outcomes = {0: [T, T, T, F], 1: [T, F, T, T], 2: [T, T, F, F], 3: [F, T, T, T], 4: [T] * 4}
    for count in (2, 3, 4, 5):
        frames = []
        for seed in range(count):
            frames += [
                synthetic.cell(
                    "prefix", "catcher", seed, "paper", 2, 2, outcomes[seed], triple=PREFIX
                ),
                synthetic.cell("pinv", "catcher", seed, "paper", 2, 2, [T, F, F, F]),
            ]
        row = pick(differences(pd.concat(frames)), task="catcher")[0]
        assert (row["seeds"], row["interval"]) == (count, "seeds" if count == 5 else "checkpoints")
        gaps = np.concatenate([np.array(outcomes[s], int) - [1, 0, 0, 0] for s in range(count)])
        if count < 5:  # over the episodes of all seeds
            half = 1.959963984540054 * gaps.std(ddof=1) / math.sqrt(len(gaps))
            assert row["low"] == pytest.approx(gaps.mean() - half)
            assert row["high"] == pytest.approx(gaps.mean() + half)


def test_only_common_episodes_and_seeds_are_compared(synthetic: ModuleType) -> None:
    frames = [
        synthetic.cell("prefix", "catcher", 0, "paper", 1, 1, [T, T, F, F], triple=PREFIX),
        synthetic.cell("pinv", "catcher", 0, "paper", 1, 1, [F, T]),
        synthetic.cell("pinv", "catcher", 1, "paper", 1, 1, [F, F]),
    ]
    row = pick(differences(pd.concat(frames)), task="catcher")[0]
    assert row["difference"] == pytest.approx(0.5)
    assert row["seeds"] == 1


def test_other_baselines_can_be_asked_for(episodes: pd.DataFrame) -> None:
    rows = differences(episodes, [("sync", "naive"), ("sync", "unknown")])
    assert {(row["method"], row["baseline"]) for row in rows} == {("sync", "naive")}


@pytest.mark.parametrize(
    ("solved", "text"), [((20, 20, 20), "> 4"), ((20, 17, 10), "1.3"), ((10, 5, 5), "< 0")]
)
def test_d90_by_hand_and_censored(
    synthetic: ModuleType, solved: tuple[int, int, int], text: str
) -> None:
    frames = [synthetic.cell("naive", "catcher", 0, "fixed:4", 0, 4, [T] * 20)]
    for delay, count in zip((0, 2, 4), solved, strict=True):
        outcome = [T] * count + [F] * (20 - count)
        frames.append(
            synthetic.cell("prefix", "catcher", 0, "fixed:4", delay, 4, outcome, triple=PREFIX)
        )
    # Needed: 18 of 20. From 20 to 17 within two steps: 18 is reached at 4/3.
    row = pick(d90_rows(summarise(pd.concat(frames))), task="catcher", method="prefix")[0]
    assert d90_text(row) == text
    assert row["threshold"] == pytest.approx(0.9)
    assert row["d90_ms"] == pytest.approx(row["d90"] * 1000 / 30)


def test_naive_falls_from_the_first_delay_to_the_last(episodes: pd.DataFrame) -> None:
    row = pick(naive_fall_rows(episodes), task="all", protocol="paper")[0]
    rows = pick(summarise(episodes), task="all", train_seed="all", method="naive")
    ends = [pick(rows, protocol="paper", delay=d)[0]["success"] for d in (0, 4)]
    assert row["fall"] == pytest.approx(ends[0] - ends[1])
    assert row["success_at_zero"] == pytest.approx(ends[0])
    assert row["low"] < row["fall"] < row["high"]


def test_the_matrix_has_six_combinations_and_marks_the_untrained_one(
    episodes: pd.DataFrame,
) -> None:
    rows = pick(matrix_rows(summarise(episodes)), protocol="paper", delay=4)
    assert len(rows) == 6
    assert [(r["checkpoint"], r["sampler"]) for r in rows if r["untrained"]] == [("base", "prefix")]


def test_the_matrix_is_empty_without_its_own_cells(synthetic: ModuleType) -> None:
    frames = synthetic.episodes(tasks=("catcher",), seeds=(0,), n=4, protocols=("paper",))
    assert matrix_rows(summarise(pd.concat(frames))) == []


def test_two_settings_of_one_method_are_told_apart(synthetic: ModuleType) -> None:
    frames = [
        synthetic.cell("pinv", "catcher", 0, "paper", 0, 1, [T], settings=f'{{"prior_std": {std}}}')
        for std in (0.5, 1.0)
    ]
    names = {row["method"] for row in summarise(pd.concat(frames))}
    assert names == {"pinv (prior_std=0.5)", "pinv (prior_std=1.0)"}


def test_results_that_must_not_be_mixed_are_refused(synthetic: ModuleType) -> None:
    first = synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [T, T])
    other_seed = synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [T, F])
    other_policy = synthetic.cell("naive", "catcher", 0, "paper", 1, 1, [T, T], policy="other")
    for second in (other_seed, other_policy):
        with pytest.raises(StateError, match='task "catcher", method "naive", training seed 0'):
            summarise(pd.concat([first, second]))


def test_missing_columns_are_named() -> None:
    with pytest.raises(StateError, match="solved"):
        summarise(pd.DataFrame({"task": ["catcher"]}))


def test_undefined_metrics_are_null_not_nan(episodes: pd.DataFrame) -> None:
    row = pick(summarise(episodes), task="all", method="prefix", delay=2, train_seed="all")[0]
    assert row["prefix_error"] is None
    assert row["action_delta"] == pytest.approx(0.21)


def test_ablation_rows_and_differences(synthetic: ModuleType) -> None:
    outcomes = {"exponential": [T, F, F, F], "uniform": [T, T, T, F]}
    rows = pd.concat(
        synthetic.cell("prefix", "catcher", 0, "paper", 4, 4, solved, triple=PREFIX).assign(
            variant=name, policy=name
        )
        for name, solved in outcomes.items()
    )
    table = pick(ablation_table(rows), task="catcher", train_seed="all")
    assert {row["variant"]: row["success"] for row in table} == {
        "exponential": 0.25,
        "uniform": 0.75,
    }
    gap = pick(ablation_differences(rows, "exponential"), task="catcher")
    assert [(row["method"], row["baseline"]) for row in gap] == [("uniform", "exponential")]
    assert gap[0]["difference"] == pytest.approx(0.5)
    with pytest.raises(StateError, match="exponential"):
        ablation_differences(rows, "exponentail")


def test_grids_have_one_cell_per_column(episodes: pd.DataFrame) -> None:
    for grid in (
        success_grid(pick(summarise(episodes), protocol="paper")),
        differences_grid(differences(episodes), "fixed:4"),
    ):
        assert grid.rows
        assert {len(row) for row in grid.rows} == {len(grid.columns)} == {4}


# -- world noise -----------------------------------------------------------------------------


def test_noises_are_shown_apart_and_compared_within(synthetic: ModuleType) -> None:
    outcomes = {("naive", 0.0): 6, ("prefix", 0.0): 7, ("naive", 0.2): 1, ("prefix", 0.2): 5}
    frames = [
        synthetic.cell(
            method,
            "catcher",
            0,
            "paper",
            2,
            2,
            [True] * solved + [False] * (8 - solved),
            triple=synthetic.METHODS[method],
            action_noise=noise,
        )
        for (method, noise), solved in outcomes.items()
    ]
    rows = pd.concat(frames, ignore_index=True)
    found = {row["method"]: row["solved"] for row in pick(summarise(rows), task="catcher")}
    assert found == {f"{method} (noise {noise})": n for (method, noise), n in outcomes.items()}
    gaps = {row["method"]: row["difference"] for row in pick(differences(rows), task="catcher")}
    assert gaps == pytest.approx({"prefix (noise 0.0)": 1 / 8, "prefix (noise 0.2)": 4 / 8})
    # One noise needs no label.
    calm = rows[rows["action_noise"] == 0.0]
    assert {row["method"] for row in summarise(calm)} == {"naive", "prefix"}
