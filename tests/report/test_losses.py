"""The loss decomposition against a world whose costs, classes and recovered fractions are known."""

import io
import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from rtc_cli.report.losses.costs import (
    class_rows,
    control_rows,
    decomposition_rows,
    loss_cells,
    recovered_rows,
)
from rtc_cli.report.losses.figures import losses_figure, main_figure, seam_rows, segments
from rtc_cli.report.losses.grids import classes_of, costs_grid, render_losses
from rtc_cli.report.losses.text import control_alarms, loss_answer, trend_sentences
from rtc_cli.report.page import build_report
from rtc_cli.report.sections import compute
from rtc_cli.report.style import png
from rtc_cli.report.tables import pick, summarise

T_2 = 4.302652729911275  # Student's t, 97.5%, 2 degrees of freedom


@pytest.fixture(scope="module")
def episodes(synthetic: ModuleType) -> pd.DataFrame:
    """Five tasks, three seeds, no noise: 50 episodes, solved as often as the truth says."""
    frames = synthetic.loss_episodes(small(synthetic), delays=(0, 2, 4), n=50)
    return pd.concat(frames, ignore_index=True)


def only(episodes: pd.DataFrame, *tasks: str) -> pd.DataFrame:
    return episodes[episodes["task"].isin(tasks)]


def small(synthetic: ModuleType) -> dict[str, Any]:
    """One task or two of each class."""
    names = ("catapult", "catcher", "grasp", "trampoline", "unicycle")
    return {name: synthetic.WORLD[name] for name in names}


@pytest.fixture(scope="module")
def costs(episodes: pd.DataFrame) -> list[dict[str, Any]]:
    return decomposition_rows(loss_cells(episodes))


def test_costs_are_those_of_the_world(synthetic: ModuleType, costs: list[dict[str, Any]]) -> None:
    for task, truth in small(synthetic).items():
        for delay in (2, 4):
            row = pick(costs, task=task, protocol="fixed:4", delay=delay)[0]
            assert row["open_loop_cost"] == pytest.approx(truth.open_loop_cost, abs=0.011)
            assert row["irreducible"] == pytest.approx(truth.irreducible * delay / 4, abs=0.021)
            assert row["avoidable"] == pytest.approx(truth.avoidable * delay / 4, abs=0.021)
    mean = pick(costs, task="all", protocol="fixed:4", delay=4)[0]
    world = small(synthetic).values()
    assert mean["avoidable"] == pytest.approx(np.mean([t.avoidable for t in world]), abs=0.01)
    # All seeds agree here, so the intervals have no width.
    assert mean["avoidable_low"] == pytest.approx(mean["avoidable"])


def test_costs_add_up_exactly(costs: list[dict[str, Any]]) -> None:
    assert {(row["protocol"], row["delay"], row["exec_horizon"]) for row in costs} == {
        ("paper", 2, 2), ("paper", 4, 4), ("fixed:4", 2, 4), ("fixed:4", 4, 4),
    }  # fmt: skip
    for row in costs:
        parts = row["open_loop_cost"] + row["irreducible"] + row["avoidable"]
        assert row["success_closed_loop"] - parts == pytest.approx(row["success_naive"])
        assert row["delay_cost"] == pytest.approx(row["irreducible"] + row["avoidable"])
        assert row["balance"] == pytest.approx(row["avoidable"] - row["irreducible"])


def counted(synthetic: ModuleType, counts: dict[str, list[int]], n: int = 100) -> pd.DataFrame:
    """Cells of one task at d = s = 4 with given numbers of solved episodes per training seed."""
    frames = []
    for name, (protocol, delay, s, method) in {
        "closed": ("open-loop", 0, 1, "naive"),
        "open": ("open-loop", 0, 4, "naive"),
        "oracle": ("fixed:4", 4, 4, "oracle"),
        "naive": ("fixed:4", 4, 4, "naive"),
        "prefix": ("fixed:4", 4, 4, "prefix"),
    }.items():
        for seed, count in enumerate(counts[name]):
            solved = [episode < count for episode in range(n)]
            triple = synthetic.LOSS_METHODS[method]
            frames.append(
                synthetic.cell(method, "catcher", seed, protocol, delay, s, solved, triple=triple)
            )
    return pd.concat(frames, ignore_index=True)


COUNTS = {
    "closed": [96, 95, 97],
    "open": [90, 91, 92],
    "oracle": [81, 80, 85],
    "naive": [50, 52, 51],
    "prefix": [74, 75, 76],
}


@pytest.mark.usefixtures("two_degrees_will_do")
def test_intervals_over_seeds_by_hand(synthetic: ModuleType) -> None:
    row = pick(decomposition_rows(loss_cells(counted(synthetic, COUNTS))), task="catcher")[0]
    for cost, (above, below) in {
        "open_loop_cost": ("closed", "open"),
        "irreducible": ("open", "oracle"),
        "avoidable": ("oracle", "naive"),
        "delay_cost": ("open", "naive"),
    }.items():
        gaps = (np.array(COUNTS[above]) - COUNTS[below]) / 100
        half = T_2 * gaps.std(ddof=1) / math.sqrt(3)
        assert row[cost] == pytest.approx(gaps.mean())
        assert row[f"{cost}_low"] == pytest.approx(gaps.mean() - half)
        assert row[f"{cost}_high"] == pytest.approx(gaps.mean() + half)
    assert (row["seeds"], row["interval"], row["episodes"]) == (3, "seeds", 300)


def test_one_seed_describes_the_checkpoints(synthetic: ModuleType) -> None:
    one = {name: values[:1] for name, values in COUNTS.items()}
    cells = list(loss_cells(counted(synthetic, one)))
    row = pick(decomposition_rows(cells), task="catcher")[0]
    # 31 of 100 nested episodes differ: variance of the gaps .31 (1 - .31) 100/99.
    half = 1.959963984540054 * math.sqrt(0.31 * 0.69 / 99)
    assert row["interval"] == "checkpoints"
    assert row["avoidable_low"] == pytest.approx(0.31 - half)
    share = pick(recovered_rows(cells), task="catcher", method="prefix")[0]
    assert share["recovered"] == pytest.approx(24 / 31)
    assert share["recovered_low"] < 24 / 31 < share["recovered_high"]


def test_recovered_fractions_are_those_of_the_world(
    synthetic: ModuleType, episodes: pd.DataFrame
) -> None:
    rows = recovered_rows(loss_cells(episodes))
    assert {row["method"] for row in rows} == {"pinv", "pinv-tuned", "prefix"}
    for row in pick(rows, protocol="fixed:4", delay=4):
        truth = synthetic.RECOVERED[row["method"]]
        if row["task"] != "all" and synthetic.WORLD[row["task"]].avoidable == 0:
            assert row["recovered"] is row["recovered_low"] is None
        elif row["avoidable"] > 0.25:
            assert row["recovered"] == pytest.approx(truth, abs=0.08)
        if row["task"] == "all":
            assert row["recovered"] == pytest.approx(truth, abs=0.03)


@pytest.mark.usefixtures("two_degrees_will_do")
def test_no_fraction_of_a_cost_that_may_be_zero_or_negative(synthetic: ModuleType) -> None:
    for oracle in ([52, 50, 60], [40, 41, 40]):
        cells = loss_cells(counted(synthetic, COUNTS | {"oracle": oracle}))
        row = pick(recovered_rows(cells), task="catcher", method="prefix")[0]
        assert row["avoidable_low"] <= 0
        assert row["recovered"] is None
        assert row["gain"] == pytest.approx(0.24)


@pytest.mark.usefixtures("two_degrees_will_do")
@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({}, "control-limited"),
        ({"oracle": [55, 57, 56]}, "information-limited"),
        ({name: [3, 3, 3] for name in ("closed", "open", "oracle", "naive")}, "undecided"),
        ({"oracle": [71, 70, 73]}, "undecided"),
        ({"naive": [89, 90, 91], "oracle": [90, 90, 92]}, "insensitive"),
        # A loss of 1 to 9 points, with an interval from below 0 to above the margin.
        ({"naive": [89, 82, 87], "oracle": [90, 90, 91]}, "undecided"),
        # No loss beyond the margin, though the oracle and naive differ from each other.
        ({"naive": [90, 91, 92], "oracle": [99, 99, 99]}, "insensitive"),
    ],
)
def test_classes_by_hand(synthetic: ModuleType, changed: dict[str, list[int]], kind: str) -> None:
    rows = class_rows(decomposition_rows(loss_cells(counted(synthetic, COUNTS | changed))))
    assert [(row["task"], row["class"]) for row in rows] == [("catcher", kind)]


def test_classes_do_not_depend_on_the_methods(
    episodes: pd.DataFrame, costs: list[dict[str, Any]]
) -> None:
    classes = class_rows(costs)
    fewer = episodes[episodes["method"].isin(["naive", "oracle"])]
    assert class_rows(decomposition_rows(loss_cells(fewer))) == classes
    by_task = classes_of(classes, "fixed:4")
    assert by_task["catcher"] == "control-limited"
    assert by_task["trampoline"] == "information-limited"
    assert by_task["grasp"] == by_task["catapult"] == "insensitive"
    assert not class_rows(pick(costs, protocol="paper"))  # s changes with d there


def test_the_negative_control_is_loud_when_it_breaks(
    episodes: pd.DataFrame, costs: list[dict[str, Any]]
) -> None:
    classes = class_rows(costs)
    rows = control_rows(episodes, classes)
    assert {row["task"] for row in rows} == {"grasp", "catapult"}
    assert {row["method"] for row in rows} == {"pinv", "pinv-tuned", "prefix", "oracle"}
    assert control_alarms(rows) == []
    assert {row["delay"] for row in rows} == {2, 4}
    broken = episodes.copy()
    hit = broken.eval('task == "grasp" and method == "pinv" and delay == 2 and episode < 10')
    broken.loc[hit, "solved"] = False
    alarms = control_alarms(control_rows(broken, classes))
    assert len(alarms) == 1
    assert "grasp, pinv differs from naive by -20.0 points" in alarms[0]


def test_reference_cells_are_in_no_other_table(episodes: pd.DataFrame) -> None:
    two = only(episodes, "catcher", "grasp")
    results = compute(two)
    assert results.protocols == ["paper", "fixed:4"]
    assert all(row["protocol"] != "open-loop" for row in results.summary)
    without = compute(two[two["protocol"] != "open-loop"])
    assert without.summary == results.summary
    assert without.differences == results.differences
    late = compute(two[(two["delay"] > 0) | (two["protocol"] == "open-loop")])
    assert {row["delay"] for row in late.summary} == {2, 4}
    assert late.decomposition == results.decomposition


def test_costs_without_the_oracle_or_without_s_1(episodes: pd.DataFrame) -> None:
    catcher = only(episodes, "catcher")
    assert compute(catcher[catcher["method"] != "oracle"]).decomposition == []
    fixed = episodes[(episodes["protocol"] == "fixed:4")]
    row = decomposition_rows(loss_cells(fixed))[0]
    assert row["success_closed_loop"] is row["open_loop_cost"] is row["open_loop_cost_low"] is None
    assert row["avoidable"] is not None
    assert len(costs_grid([row], {}, row["delay"]).rows) == 1
    assert segments(row)[-1].stop == 100


def test_seeds_that_a_task_lacks_do_not_count(synthetic: ModuleType) -> None:
    both = pd.concat(
        synthetic.loss_episodes(small(synthetic), seeds=(0, 1), delays=(0, 4), n=20, noise=True),
        ignore_index=True,
    )
    part = both[~((both["task"] == "catcher") & (both["train_seed"] == 1))]
    first = both[both["train_seed"] == 0]
    wanted, got = (decomposition_rows(loss_cells(frame)) for frame in (first, part))
    assert pick(got, task="all") == pick(wanted, task="all")
    assert pick(got, task="all")[0]["interval"] == "checkpoints"
    assert pick(got, task="grasp")[0]["seeds"] == 2


def test_a_missing_task_leaves_no_mean(episodes: pd.DataFrame) -> None:
    part = episodes[~((episodes["task"] == "grasp") & (episodes["method"] == "oracle"))]
    assert not pick(decomposition_rows(loss_cells(part)), task="all")


# -- figures and text ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("levels", "negative"),
    [
        ((0.5, 0.8, 0.9, 0.95), []),
        ((0.5, 0.8, 0.7, 0.9), ["irreducible"]),
        ((0.9, 0.8, 0.95, 0.7), ["avoidable", "open_loop_cost"]),
        ((0.9, 0.8, 0.7, 0.6), ["avoidable", "irreducible", "open_loop_cost"]),
    ],
)
def test_bars_end_at_100_and_show_negative_parts(
    levels: tuple[float, float, float, float], negative: list[str]
) -> None:
    naive, oracle, start, closed = levels
    row = {
        "success_naive": naive,
        "avoidable": oracle - naive,
        "irreducible": start - oracle,
        "open_loop_cost": closed - start,
    }
    parts = segments(row)
    assert [part.part for part in parts if part.negative] == negative
    solid = [part for part in parts if not part.negative]
    edges = [0.0, *(part.stop for part in solid)]
    assert edges == sorted(edges)
    assert [part.start for part in solid[1:]] == pytest.approx([part.stop for part in solid[:-1]])
    assert solid[-1].stop == 100
    assert solid[-1].start == pytest.approx(100 * max(levels))
    for part in parts:
        if part.negative:
            assert part.stop - part.start == pytest.approx(-part.value)


def test_figures_draw(episodes: pd.DataFrame, costs: list[dict[str, Any]]) -> None:
    classes = classes_of(class_rows(costs), "fixed:4")
    rows = pick(costs, protocol="fixed:4")
    axes = losses_figure(rows, classes, 4).axes[0]
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert len(labels) == 6
    assert labels[-1] == "mean"
    summary = summarise(episodes)
    assert len(seam_rows(summary, "fixed:4")) == 15
    whole = main_figure(summary, costs, classes, "fixed:4")
    assert png(whole).startswith(b"\x89PNG")
    unpushed = [row | {"measured_reaction_ticks": None} for row in summary]
    assert len(main_figure(unpushed, costs, classes, "fixed:4").axes) == len(whole.axes) - 1


def test_sentences_name_the_tasks_against_the_trend(episodes: pd.DataFrame) -> None:
    changed = episodes.copy()
    hit = changed.eval(
        'task == "trampoline" and method == "prefix" and delay == 4 and episode < 12'
    )
    changed.loc[hit, "solved"] = False
    results = compute(changed)
    text = trend_sentences(results.differences, results.classes, "fixed:4")[0]
    assert text.startswith("Against the sign of prefix − pinv at s = 4, d = 4")
    assert "clearly: trampoline (" in text
    assert ", information-limited)" in text
    answer = loss_answer(results.decomposition, results.recovered, results.classes)
    # prefix wins .8 of .48 + .40 on two tasks and gives back 12 of 50 episodes on a third.
    assert "pinv 41%" in answer[0]
    assert "prefix 54%" in answer[0]
    assert "2 insensitive (catapult, grasp)" in answer[1]


def test_terminal_tables_fit_80_columns(episodes: pd.DataFrame) -> None:
    some = only(episodes, "grasp", "catcher", "trampoline")
    results = compute(some.assign(task=some["task"].replace("grasp", "kinetix-h17_unicycle")))
    console = Console(width=400, record=True, file=io.StringIO())
    for table in render_losses(results.losses):
        console.print(table)
    text = console.export_text()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "kinetix-h17_unicycle" in text


def test_the_report_of_a_world_with_levels(synthetic: ModuleType, tmp_path: Path) -> None:
    names = {"catcher": "catcher", "grasp": "kinetix-grasp", "trampoline": "trampoline"}
    world = {name: synthetic.WORLD[task] for task, name in names.items()}
    frames = synthetic.loss_episodes(world, seeds=(0,), protocols=("fixed:4",), n=30)
    report = build_report(synthetic.write_run(tmp_path, frames, extras=False))
    text = report.markdown.read_text()
    assert "kinetix-grasp" in text
    assert {"main.png", "losses-fixed-4.png", "seam-reaction.png"} <= {
        path.name for path in report.figures
    }
    data = json.loads(report.rows.read_text())
    for key in ("decomposition", "recovered", "classes"):
        table = pd.read_csv(tmp_path / "report" / "tables" / f"{key}.csv")
        assert list(table.columns) == list(data[key][0])
        assert len(table) == len(data[key])
    assert {row["task"] for row in data["classes"]} == set(names.values())
