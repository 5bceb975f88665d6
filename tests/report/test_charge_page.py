"""Rows, figure and page of an evaluation at equal hardware, on made-up episodes."""

import io
from types import ModuleType

import pandas as pd
import pytest
from rich.console import Console

from rtc_cli.report.charge.page import charge_grid, save_charge_page
from rtc_cli.report.charge.rows import (
    ChargedEpisodes,
    best_by_method,
    charge_differences,
    charge_rows,
)
from rtc_cli.report.render import rich_table


def charged(every: pd.DataFrame, method: str, delay: int, latency: float) -> ChargedEpisodes:
    mine = every[(every["method"] == method) & (every["delay"] == delay)]
    mine = mine[mine["protocol"] == "paper"]
    return ChargedEpisodes(method, 5, latency, delay, mine)


@pytest.fixture(scope="module")
def all_charged(synthetic: ModuleType) -> list[ChargedEpisodes]:
    every = pd.concat(synthetic.episodes(), ignore_index=True)
    late = ChargedEpisodes("pinv", 10, 300.0, 9, None, "delay 9 is too long")
    asked = (("naive", 2, 76.0), ("pinv", 4, 97.0), ("prefix", 2, 76.0))
    return [*(charged(every, *each) for each in asked), late]


def solved(each: ChargedEpisodes) -> pd.Series:
    assert each.episodes is not None
    return each.episodes.groupby("task")["solved"].mean()


def test_success_is_the_mean_of_the_tasks_at_the_own_delay(all_charged):
    rows = charge_rows(all_charged)
    assert [row["delay"] for row in rows] == [2, 4, 2, 9]
    for row, each in zip(rows[:3], all_charged[:3], strict=True):
        assert row["success"] == pytest.approx(solved(each).mean())
        assert row["success_low"] < row["success"] < row["success_high"]
    assert rows[3]["success"] is None
    assert rows[3]["reason"] == "delay 9 is too long"


def test_differences_match_episodes_across_delays(all_charged):
    found = {(row["method"], row["baseline"]): row for row in charge_differences(all_charged)}
    row = found["prefix", "pinv"]
    assert (row["delay"], row["baseline_delay"]) == (2, 4)
    expected = (solved(all_charged[2]) - solved(all_charged[1])).mean()
    assert row["difference"] == pytest.approx(expected)
    assert row["low"] < expected < row["high"]


def test_the_page(all_charged, tmp_path):
    content = {
        "profile": "rtx-4090.json",
        "tasks": "three",
        "horizon": 8,
        "hz": 30.0,
        "rounding": "ceil",
        "fixed_ms": {"vlm": 62.0},
        "rows": charge_rows(all_charged),
        "differences": charge_differences(all_charged),
    }
    paths = save_charge_page(tmp_path, content)
    page = paths.markdown.read_text("utf-8")
    assert "Too slow for chunks of 8 actions at this rate: pinv with K = 10." in page
    assert "not possible" in page
    assert "prefix does best with K = 5" in page
    assert [path.name for path in paths.figures] == ["charge.png"]


def test_the_best_of_equals_has_fewer_steps():
    rows = [
        {"method": "pinv", "flow_steps": 10, "success": 0.9},
        {"method": "pinv", "flow_steps": 5, "success": 0.9},
        {"method": "pinv", "flow_steps": 2, "success": None},
        {"method": "naive", "flow_steps": 5, "success": 0.5},
    ]
    best = {row["method"]: row["flow_steps"] for row in best_by_method(rows)}
    assert best == {"pinv": 5, "naive": 5}


def test_intervals_in_the_terminal_have_both_brackets_or_none(all_charged):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(rich_table(charge_grid(charge_rows(all_charged))))
    shown = console.export_text()
    assert shown.count("(") == shown.count(")")
    assert "…" in shown
