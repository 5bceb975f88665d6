"""Tables of delays that vary: labels, differences under the same delays, counts."""

from __future__ import annotations

import io
import re

import pandas as pd
import pytest
from rich.console import Console

from rtc_cli.report.render import pair_text
from rtc_cli.report.sections import compute
from rtc_cli.report.selection import condition_label, delay_label, method_order, timing_label
from rtc_cli.report.tables import differences, pick, summarise
from rtc_cli.report.varying import (
    cases_grid,
    constant,
    delay_differences_grid,
    delays_grid,
    render_varying,
    varying,
)


@pytest.mark.parametrize(
    ("timing", "label"),
    [
        (("constant:2", "exact", "play", "play", 0), ""),
        (("constant:2", "exact", "play", "play", 1), " (delays constant, lag 1)"),
        (("constant:2", "constant:1", "play", "clamp", 0), " (delays constant, constant:1, clamp)"),
        (("constant:9 cap 7", "exact", "play", "play", 0), " (delays constant:9 cap 7)"),
        (("uniform:0-4", "exact", "play", "play", 0), " (delays uniform:0-4)"),
        (
            ("poisson:2 cap 7", "percentile:0.95", "discard", "play", 2),
            " (delays poisson:2 cap 7, percentile:0.95, discard, lag 2)",
        ),
        (("trace:a (1).csv@50", "exact", "play", "play", 0), " (delays trace:a (1).csv@50)"),
    ],
)
def test_labels(timing, label):
    assert timing_label(*timing) == label
    assert condition_label("naive" + label) == delay_label("naive" + label) == label
    assert delay_label("naive (noise 0.2)" + label) == label
    assert condition_label("naive (noise 0.2)" + label) == " (noise 0.2)" + label
    assert condition_label("pinv (mask=exp)" + label) == label


@pytest.fixture
def episodes(synthetic) -> pd.DataFrame:
    """Under uniform delays naive solves half and prefix all; under a constant one both all."""
    frames = []
    for method, triple in (
        ("naive", ("base", "plain", "async")),
        ("prefix", ("prefix", "prefix", "async")),
    ):
        for model in ("constant:2", "uniform:0-4"):
            lost = method == "naive" and model == "uniform:0-4"
            solved = [not (lost and i % 2) for i in range(40)]
            frames.append(
                synthetic.cell(
                    method,
                    "catcher",
                    0,
                    "fixed:4",
                    2,
                    4,
                    solved,
                    triple=triple,
                    delay_model=model,
                    starved_ticks=3 * lost,
                    late_chunks=5 * lost,
                )
            )
    return pd.concat(frames, ignore_index=True)


def test_models_are_never_pooled(episodes):
    rows = pick(summarise(episodes), task="catcher", train_seed="all")
    success = {row["method"]: row["success"] for row in rows}
    assert success == {
        "naive": 1.0,
        "prefix": 1.0,
        "naive (delays uniform:0-4)": 0.5,
        "prefix (delays uniform:0-4)": 1.0,
    }
    (row,) = pick(rows, method="naive (delays uniform:0-4)")
    assert (row["delay_model"], row["estimator"], row["late_chunks"]) == ("uniform:0-4", "exact", 5)
    assert method_order(list(success))[:2] == ["naive", "naive (delays uniform:0-4)"]


def test_methods_are_compared_under_the_same_delays(episodes):
    found = {
        (row["method"], row["baseline"]): row["difference"]
        for row in pick(differences(episodes), task="catcher")
    }
    label = " (delays uniform:0-4)"
    assert found == {("prefix", "naive"): 0.0, ("prefix" + label, "naive" + label): 0.5}


def test_a_difference_says_its_delays_once():
    label = " (delays uniform:0-4)"
    assert pair_text("prefix" + label, "naive" + label) == "prefix − naive (delays uniform:0-4)"
    assert pair_text("prefix" + label, "naive") == "prefix (delays uniform:0-4) − naive"


def test_a_line_per_law_and_a_column_per_method(episodes):
    results = compute(episodes)
    grid = delays_grid(results.summary, task="catcher")
    assert grid.columns == ["delays", "told", "naive", "prefix"]
    assert [row[:2] for row in grid.rows] == [["constant:2", "exact"], ["uniform:0-4", "exact"]]
    assert [row[2].split(" ")[0] for row in grid.rows] == ["100.0", "50.0"]
    assert [row[3].split(" ")[0] for row in grid.rows] == ["100.0", "100.0"]
    gaps = delay_differences_grid(results.differences, results.summary, task="catcher")
    assert gaps.columns == ["delays", "told", "prefix − naive"]
    assert [row[2].split(" ")[0] for row in gaps.rows] == ["0.0", "**+50.0**"]


def test_other_settings_are_said_with_what_is_told(episodes):
    late = episodes[episodes.delay_model == "uniform:0-4"]
    told = {"estimator": "max-of-last:10", "on_late": "discard", "observation_lag": 1}
    grid = delays_grid(compute(pd.concat([episodes, late.assign(**told)])).summary, task="catcher")
    assert [row[1] for row in grid.rows] == ["exact", "exact", "max-of-last:10, discard, lag 1"]


def test_constant_delays_have_a_column_per_delay_unless_they_are_shown_beside_the_others(
    episodes, synthetic
):
    rows = compute(episodes).summary
    assert constant(rows) == []
    assert varying(rows) == rows
    more = synthetic.cell("naive", "catcher", 0, "fixed:4", 3, 4, [True] * 40)
    rows = compute(pd.concat([episodes, more], ignore_index=True)).summary
    assert {(row["method"], row["delay"]) for row in constant(rows)} == {
        ("naive", 2),
        ("prefix", 2),
        ("naive", 3),
    }
    assert {row["delay"] for row in varying(rows)} == {2}
    only = compute(episodes[episodes.delay_model == "constant:2"]).summary
    assert constant(only) == only
    assert varying(only) == []


def test_cases_are_shown_where_delays_vary(episodes):
    results = compute(episodes)
    grid = cases_grid(results.summary)
    assert grid.columns == ["delays", "told", "method", "s", "late", "starved"]  # others: 0
    assert grid.rows == [["uniform:0-4", "exact", "naive", "4", "5", "3"]]
    console = Console(file=io.StringIO(), width=80)
    console.print(*render_varying(results.summary, results.differences))
    shown = console.file.getvalue()
    assert "Per episode, protocol fixed:4" in shown
    assert "Paired differences" in shown
    only = compute(episodes[episodes.delay_model == "constant:2"])
    assert render_varying(only.summary, only.differences) == []


def test_long_laws_are_shown_whole(episodes):
    law = "mixture:0.8*constant:1+0.2*uniform:5-7"
    late = episodes[episodes.delay_model == "uniform:0-4"].assign(delay_model=law)
    results = compute(pd.concat([episodes, late], ignore_index=True))
    console = Console(file=io.StringIO(), width=80)
    console.print(*render_varying(results.summary, results.differences))
    shown = console.file.getvalue()
    assert "…" in shown  # of intervals
    assert not re.search(r"[^\d]…|…[^\d+-]", shown)


def test_numbers_of_flow_steps_have_tables_of_their_own(episodes):
    """Also where constant delays, which were evaluated with another number, come first."""
    alone = episodes[episodes.delay_model == "constant:2"].assign(flow_steps=1)
    results = compute(pd.concat([alone, episodes], ignore_index=True))
    titles = [str(table.title) for table in render_varying(results.every_summary, [])]
    assert [title for title in titles if "solved" in title] == [
        "Episodes solved (%), catcher, protocol fixed:4, 5 flow steps"
    ]
    both = [episodes.assign(flow_steps=steps) for steps in (1, 5)]
    results = compute(pd.concat(both, ignore_index=True))
    titles = [str(table.title) for table in render_varying(results.every_summary, [])]
    assert sum("1 flow steps" in title for title in titles) == 1
    assert sum("5 flow steps" in title for title in titles) == 1
