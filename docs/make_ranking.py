"""Do two suites of tasks rank methods alike? python docs/make_ranking.py RUN RUN [--delay 4]

A method here is a method with a number of flow steps. Each run gives every method a success rate
per task (over its episodes and training seeds, at one delay with s = max(d, 1), which at d = 4 is
the cell of fixed:4 too), and ranks methods by their mean over tasks. Printed: both means, and
Kendall's τ-b of the two rankings with a 95% interval from drawing the tasks of each suite anew,
with replacement: it says how far the agreement depends on which tasks the suites happen to hold.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import kendalltau

from rtc_cli.report.inputs import load_episodes
from rtc_cli.report.selection import prepare

DRAWS = 4000


def rates(episodes: pd.DataFrame, delay: int) -> pd.DataFrame:
    """Success by task (rows) and by (method, flow steps) (columns); only whole columns."""
    rows = prepare(episodes)
    mine = rows[(rows["delay"] == delay) & (rows["exec_horizon"] == max(delay, 1))]
    table = mine.groupby(["task", "method", "flow_steps"])["solved"].mean()
    return table.unstack(["method", "flow_steps"]).dropna(axis=1)


def agreement(
    first: pd.DataFrame, second: pd.DataFrame, draws: int = DRAWS, seed: int = 0
) -> tuple[float, float, float]:
    """Kendall's τ-b of the methods' rankings that two suites have in common, and 95% interval."""
    common = [column for column in first.columns if column in set(second.columns)]
    suites = [suite[common].to_numpy(float) for suite in (first, second)]
    random = np.random.default_rng(seed)
    tau = _tau(*(suite.mean(axis=0) for suite in suites))
    drawn = [
        _tau(
            *(suite[random.integers(len(suite), size=len(suite))].mean(axis=0) for suite in suites)
        )
        for _ in range(draws)
    ]
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return tau, float(low), float(high)


def _tau(one: np.ndarray, other: np.ndarray) -> float:
    return float(kendalltau(one, other).statistic)


def main() -> None:
    """Read two runs, print the table and τ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs=2)
    parser.add_argument("--delay", type=int, default=4)
    options = parser.parse_args()
    first, second = (rates(load_episodes(run), options.delay) for run in options.runs)
    print(f"| method | K | {options.runs[0].name} | {options.runs[1].name} |")
    print("| --- | ---: | ---: | ---: |")
    for method, steps in (column for column in first.columns if column in set(second.columns)):
        means = (100 * suite[method, steps].mean() for suite in (first, second))
        print(f"| `{method}` | {steps} | " + " | ".join(f"{mean:.1f}" for mean in means) + " |")
    tau, low, high = agreement(first, second)
    print(f"\nKendall's τ {tau:.2f} ({low:.2f} to {high:.2f}); tasks: {len(first)}, {len(second)}")


if __name__ == "__main__":
    main()
