"""Agreement of the rankings of two suites (docs/make_ranking.py)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).parents[2] / "docs" / "make_ranking.py"
    spec = importlib.util.spec_from_file_location("make_ranking", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def suite(*columns: list[float]) -> pd.DataFrame:
    methods = [("naive", 5), ("pinv", 5), ("prefix", 5), ("naive", 1)]
    return pd.DataFrame(dict(zip(methods, columns, strict=False)))


def test_equal_and_reversed_rankings_are_1_and_minus_1_whatever_tasks_are_drawn(
    script: ModuleType,
) -> None:
    up = suite([0.1, 0.2], [0.3, 0.4], [0.5, 0.6])
    down = suite([0.6, 0.9], [0.5, 0.4], [0.1, 0.2])
    assert script.agreement(up, up * 0.5, draws=50) == (1.0, 1.0, 1.0)
    assert script.agreement(up, down, draws=50) == (-1.0, -1.0, -1.0)


def test_tau_counts_pairs_and_the_interval_widens_where_tasks_disagree(script: ModuleType) -> None:
    # Means 1 < 2 < 3 < 4 against 1 < 3 < 2 < 4: five of six pairs alike.
    first = suite([0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.4, 0.4])
    second = suite([0.1, 0.1], [0.3, 0.3], [0.2, 0.2], [0.4, 0.4])
    tau, low, high = script.agreement(first, second, draws=50)
    assert tau == pytest.approx((5 - 1) / 6)
    assert (low, high) == (tau, tau)  # every task says the same
    mixed = suite([0.1, 0.4], [0.2, 0.3], [0.3, 0.2], [0.4, 0.2])
    _, low, high = script.agreement(first, mixed, draws=200)
    assert low < 0 < high


def test_rates_are_per_task_and_only_of_methods_that_all_tasks_have(
    script: ModuleType, synthetic: ModuleType
) -> None:
    pinv = ("base", "pinv", "async")
    cells = [
        synthetic.cell("naive", "catcher", 0, "fixed:4", 4, 4, [True, False]),
        synthetic.cell("naive", "catcher", 1, "fixed:4", 4, 4, [True, True]),
        synthetic.cell("naive", "walker", 0, "fixed:4", 4, 4, [False, False]),
        synthetic.cell("naive", "walker", 0, "fixed:4", 2, 4, [True, True]),
        synthetic.cell("pinv", "catcher", 0, "fixed:4", 4, 4, [True], triple=pinv),
    ]  # fmt: skip
    table = script.rates(pd.concat(cells, ignore_index=True), 4)
    assert list(table.columns) == [("naive", 5)]
    np.testing.assert_allclose(table[("naive", 5)], [0.75, 0.0])
