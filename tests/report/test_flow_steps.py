"""The section of a report that compares numbers of flow steps."""

from __future__ import annotations

from types import ModuleType

import pandas as pd
import pytest

from rtc_cli.report.document import Picture, Table
from rtc_cli.report.sections import Results, compute
from rtc_cli.report.steps import flow_steps_grid, flow_steps_sections, shared_protocol

# Solved of ten, by (method, flow steps, delay): rates that no two cells share.
SOLVED = {
    ("naive", 5, 0): 10, ("naive", 5, 4): 1, ("naive", 1, 0): 9, ("naive", 1, 4): 2,
    ("pinv", 5, 0): 8, ("pinv", 5, 4): 3, ("pinv", 1, 0): 6, ("pinv", 1, 4): 4,
    ("prefix", 5, 0): 7, ("prefix", 5, 4): 5, ("prefix", 1, 0): 5, ("prefix", 1, 4): 8,
}  # fmt: skip
TRIPLES = {
    "naive": ("base", "plain", "async"),
    "pinv": ("base", "pinv", "async"),
    "prefix": ("prefix", "prefix", "async"),
}


def results(synthetic: ModuleType, steps: tuple[int, ...] = (1, 5)) -> Results:
    frames = []
    for (method, k, delay), solved in SOLVED.items():
        if k not in steps:
            continue
        outcome = [i < solved for i in range(10)]
        for task in ("catcher", "walker"):
            rows = synthetic.cell(
                method, task, 0, "paper", delay, max(delay, 1), outcome, triple=TRIPLES[method]
            )
            frames.append(rows.assign(flow_steps=k))
    return compute(pd.concat(frames, ignore_index=True))


def test_the_table_has_every_rate_where_it_belongs(synthetic: ModuleType) -> None:
    found = results(synthetic)
    mean = [row for row in found.every_summary if row["task"] == "all"]
    grid = flow_steps_grid([row for row in mean if row["train_seed"] == "all"])
    assert grid.columns == ["method", "K", "d=0", "d=4"]
    wanted = [
        [method, str(k), *(f"{10 * SOLVED[method, k, d]:.1f}" for d in (0, 4))]
        for method in ("naive", "pinv", "prefix")
        for k in (1, 5)
    ]
    assert grid.rows == wanted


def test_the_section_draws_a_panel_per_number_and_compares_prefix_with_pinv(
    synthetic: ModuleType,
) -> None:
    (section,) = flow_steps_sections(results(synthetic))
    (picture,) = [block for block in section.blocks if isinstance(block, Picture)]
    titles = [axes.get_title(loc="left") for axes in picture.figure.axes]
    assert titles == ["K = 5", "K = 1"]
    gaps = [block for block in section.blocks if isinstance(block, Table)][1]
    cells = [[str(cell).split(" ")[0] for cell in row] for row in gaps.rows]
    assert cells == [["1", "-10.0", "+40.0"], ["5", "-10.0", "+20.0"]]


def test_one_number_of_flow_steps_needs_no_section(synthetic: ModuleType) -> None:
    assert flow_steps_sections(results(synthetic, steps=(5,))) == []


@pytest.mark.parametrize(
    ("rows", "wanted"),
    [
        ([], ("", [])),
        ([("paper", 5), ("paper", 1), ("fixed:4", 5)], ("paper", [1, 5])),
        ([("fixed:4", 5), ("paper", 5)], ("fixed:4", [5])),
    ],
)
def test_the_protocol_with_most_numbers_is_shown(
    rows: list[tuple[str, int]], wanted: tuple[str, list[int]]
) -> None:
    summary = [{"protocol": protocol, "flow_steps": steps} for protocol, steps in rows]
    assert shared_protocol(summary) == wanted
