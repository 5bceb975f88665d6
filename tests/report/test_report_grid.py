"""The report of a grid ablation, on made-up runs whose effects are known."""

import itertools
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rtc_cli.errors import StateError
from rtc_cli.pipeline.grid import open_runs
from rtc_cli.recipe import load_recipe
from rtc_cli.report.grid.rows import GridEpisodes, effect_rows, grid_differences, load_grid
from rtc_cli.report.grid.text import grid_answer
from rtc_cli.report.page import build_report
from rtc_cli.report.tables import ALL, pick
from rtc_cli.results import ResultStore
from rtc_cli.runs import Run, create_run

TASKS = ("cartpole_thrust", "catcher")
N = 100


def made_up(experts: int, std: float, noise: float, method: str, delay: int) -> int:
    """How many of the N episodes are solved: naive falls with noise, prefix wins with experts."""
    lost = delay * (5 + (40 * noise if method == "naive" else 0))
    won = {"naive": 0, "pinv": 2, "prefix": 2 * experts + 4 * std}[method] * delay / 4
    return round(N * 0.9 - lost + won)


def grid_run(
    synthetic: ModuleType,
    folder: Path,
    *,
    seeds: tuple[int, ...] = (0,),
    tasks: tuple[str, ...] = TASKS,
    methods: tuple[str, ...] = ("naive", "pinv", "prefix"),
) -> Run:
    overrides = [f"tasks={','.join(tasks)}", f"train.seeds={','.join(map(str, seeds))}"]
    run = create_run(load_recipe("ablations/multimodality", overrides), folder)
    for own in open_runs(run):
        data, store = own.recipe.data, ResultStore(own.results / "episodes")
        assert data.experts is not None
        for task, seed, noise, method, delay in itertools.product(
            tasks, seeds, own.recipe.eval.action_noise, methods, (0, 4)
        ):
            solved = made_up(data.experts, data.policy_std, noise, method, delay)
            outcome = np.random.default_rng([seed, len(task)]).permutation(N) < solved
            frame = synthetic.cell(
                method,
                task,
                seed,
                "fixed:4",
                delay,
                4,
                outcome,
                triple=synthetic.METHODS[method],
                action_noise=noise,
            )
            store.append(frame["cell"].iloc[0], frame)
    return run


@pytest.fixture(scope="module")
def run(synthetic: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return grid_run(synthetic, tmp_path_factory.mktemp("grid") / "run")


def grid_of(run: Run) -> GridEpisodes:
    return load_grid(run.folder, run.recipe.model_dump(mode="json", exclude_none=True))


@pytest.fixture(scope="module")
def grid(run: Run) -> GridEpisodes:
    return grid_of(run)


@pytest.fixture(scope="module")
def gaps(grid: GridEpisodes) -> list[dict[str, Any]]:
    return grid_differences(grid)


@pytest.fixture(scope="module")
def effects(grid: GridEpisodes) -> list[dict[str, Any]]:
    return effect_rows(grid)


def test_every_setting_is_read_with_its_factors(
    grid: GridEpisodes, gaps: list[dict[str, Any]]
) -> None:
    assert list(grid.factors) == ["data.experts", "data.policy_std", "action_noise"]
    assert len(grid.parts) == grid.count == 18
    for settings, rows in grid.parts:
        assert set(rows["action_noise"]) == {settings["action_noise"]}
    for row in pick(gaps, task="catcher", delay=4, method="prefix", baseline="naive"):
        values = row["data.experts"], row["data.policy_std"], row["action_noise"]
        expected = made_up(*values, "prefix", 4) - made_up(*values, "naive", 4)
        assert row["difference"] == pytest.approx(expected / N)


def test_effects_average_over_the_other_factors(effects: list[dict[str, Any]]) -> None:
    stds, noises = (0.0, 0.5, 1.0), (0.0, 0.1, 0.2)

    def gap(experts: int, std: float, noise: float) -> float:
        return made_up(experts, std, noise, "prefix", 4) - made_up(experts, std, noise, "naive", 4)

    wanted = {
        "data.experts": np.mean([gap(4, s, z) - gap(1, s, z) for s in stds for z in noises]),
        "data.policy_std": np.mean(
            [gap(e, 1.0, z) - gap(e, 0.0, z) for e in (1, 4) for z in noises]
        ),
        "action_noise": np.mean([gap(e, s, 0.2) - gap(e, s, 0.0) for e in (1, 4) for s in stds]),
    }
    for task in (*TASKS, ALL):
        rows = pick(effects, task=task, method="prefix", baseline="naive", delay=4)
        found = {row["factor"]: row["difference"] for row in rows}
        assert found == pytest.approx({key: value / N for key, value in wanted.items()})
    naive = pick(effects, task=ALL, method="naive", baseline=None, delay=4, factor="action_noise")
    assert naive[0]["difference"] == pytest.approx(-4 * 40 * 0.2 / N)
    assert naive[0]["interval"] == "checkpoints"
    assert naive[0]["low"] < naive[0]["difference"] < naive[0]["high"] < 0


def test_intervals_of_one_seed_are_those_of_paired_episodes(
    grid: GridEpisodes, effects: list[dict[str, Any]]
) -> None:
    row = pick(
        effects, task="catcher", method="naive", baseline=None, delay=4, factor="action_noise"
    )[0]
    frames = [
        rows.assign(**settings) for settings, rows in grid.parts if settings["action_noise"] != 0.1
    ]
    rows = pd.concat(frames)
    rows = rows[(rows.task == "catcher") & (rows.method == "naive") & (rows.delay == 4)]
    mean = rows.groupby(["action_noise", "episode"])["solved"].mean()
    gap = mean[0.2] - mean[0.0]
    half = 1.959964 * gap.std() / np.sqrt(len(gap))
    assert (row["low"], row["high"]) == pytest.approx((gap.mean() - half, gap.mean() + half))


@pytest.mark.usefixtures("two_degrees_will_do")
def test_several_seeds_are_paired_by_seed(synthetic: ModuleType, tmp_path: Path) -> None:
    grid = grid_of(
        grid_run(
            synthetic,
            tmp_path / "run",
            seeds=(0, 1, 2),
            tasks=("catcher",),
            methods=("naive", "prefix"),
        )
    )
    rows = [*effect_rows(grid), *grid_differences(grid)]
    assert {row["interval"] for row in rows} == {"seeds"}
    assert {row["seeds"] for row in rows} == {3}


def test_sentences_follow_from_the_numbers(
    grid: GridEpisodes, gaps: list[dict[str, Any]], effects: list[dict[str, Any]]
) -> None:
    factors = list(grid.factors)
    text = grid_answer(gaps, effects, "fixed:4", factors)
    assert "at d = 0 better in 0 and worse in 0 of 18; at d = 4 better in 18" in text[0]
    assert "from +2.0 points" in text[1]
    assert (
        "experts in the data = 1, policy std of the experts = 0, execution noise = 0 to" in text[1]
    )
    assert "to +44.0 points" in text[1]
    order = [text[2].index(word) for word in ("execution noise", "experts in", "policy std")]
    assert order == sorted(order)
    assert "One training seed only" in text[-1]
    still = [row | {"delay": 4, "exec_horizon": 4} for row in pick(effects, delay=0)]
    assert "No factor clearly changes naive's success" in " ".join(
        grid_answer(gaps, still, "fixed:4", factors)
    )


def test_the_report_is_built_from_any_side(run: Run) -> None:
    built = build_report(run.folder)
    names = {path.name for path in built.figures}
    assert names == {f"grid-fixed-4-{task}.png" for task in (ALL, *TASKS)}
    text = built.markdown.read_text()
    assert "18 settings" in text
    assert "| experts | policy std | noise |" in text
    data = json.loads(built.rows.read_text())
    assert data["answer"] == built.data["answer"]
    flat = (str, int, float, bool, type(None))
    assert all(isinstance(v, flat) for row in data["rows"] for v in row.values())
    # A combination is a run like any other; its noises are shown apart.
    own = build_report(run.folder / "variants" / "experts-4_policy_std-0.5")
    assert "naive (noise 0.2)" in own.markdown.read_text()


def test_a_grid_that_is_not_whole_says_so(synthetic: ModuleType, tmp_path: Path) -> None:
    run = grid_run(synthetic, tmp_path / "run", tasks=("catcher",), methods=("naive", "prefix"))
    for path in (run.folder / "variants" / "experts-4_policy_std-0.5").rglob("*.parquet"):
        path.unlink()
    assert "Only 15 of 18 settings" in build_report(run.folder).markdown.read_text()


def test_a_grid_without_results_is_refused(tmp_path: Path) -> None:
    run = create_run(load_recipe("ablations/multimodality"), tmp_path / "run")
    with pytest.raises(StateError, match="nothing to report"):
        build_report(run.folder)
