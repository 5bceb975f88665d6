"""The rows of a grid ablation: success, differences, and what changes them.

A *factor* is what differs between the settings: a key of the recipe's grid, or the worlds' noise
during evaluation. A *setting* is one value of each factor. Every setting was evaluated on the same
episodes, so settings are compared pair by pair, like methods.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from rtc_cli.errors import StateError
from rtc_cli.files import os_error
from rtc_cli.recipe import Recipe, load_recipe
from rtc_cli.report.inputs import load_diversity, load_episodes
from rtc_cli.report.selection import fits_protocol, prepare
from rtc_cli.report.tables import ALL, Row, differences, estimate_gap, summarise

FOLDER = "variants"
NOISE = "action_noise"
PAIRS = (("prefix", "naive"), ("prefix", "pinv"), ("pinv", "naive"))
_EPISODE = ["task", "train_seed", "episode"]


@dataclass(frozen=True)
class GridEpisodes:
    """The episodes of a grid ablation, setting by setting.

    `factors` holds the values of each factor that has at least two, in the recipe's order; `parts`
    the episodes of each setting that was evaluated; `mixtures` the settings of each combination
    and how differently its experts act in its data (one record per task).
    """

    factors: Mapping[str, Sequence[Any]]
    parts: Sequence[tuple[Mapping[str, Any], pd.DataFrame]] = field(default_factory=tuple)
    mixtures: Sequence[tuple[Mapping[str, Any], Sequence[dict[str, Any]]]] = ()

    @property
    def count(self) -> int:
        """How many settings the recipe asks for."""
        count = 1
        for values in self.factors.values():
            count *= len(values)
        return count


def grid_of(recipe: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the grid of a resolved recipe; empty where it has none."""
    return dict(recipe.get("ablation", {}).get("grid", {}))


def load_grid(folder: Path, recipe: Mapping[str, Any]) -> GridEpisodes:
    """Read the episodes of all combinations of a grid that lie below a run's folder."""
    grid = grid_of(recipe)
    noises = list(recipe.get("eval", {}).get(NOISE, []))
    factors = {key: values for key, values in grid.items() if len(values) > 1}
    if len(noises) > 1:
        factors[NOISE] = noises
    parts: list[tuple[Mapping[str, Any], pd.DataFrame]] = []
    mixtures: list[tuple[Mapping[str, Any], Sequence[dict[str, Any]]]] = []
    for place, own in _runs(folder):
        rows = load_episodes(place)
        values = {key: _value(own, key) for key in grid}
        asked = all(value in grid[key] for key, value in values.items())
        if asked and not rows.empty:
            settings = {key: value for key, value in values.items() if key in factors}
            parts.extend(_by_noise(settings, rows, noises))
            mixtures.append((settings, load_diversity(place)))
    parts.sort(key=lambda part: _place(part[0], factors))
    return GridEpisodes(factors, tuple(parts), tuple(mixtures))


def _runs(folder: Path) -> Iterator[tuple[Path, Recipe]]:
    try:
        recipes = sorted((folder / FOLDER).glob("[!.]*/recipe.toml"))
    except OSError as error:
        raise os_error(error, folder / FOLDER) from error
    for path in recipes:
        yield path.parent, load_recipe(path)


def _value(recipe: Recipe, key: str) -> Any:
    found: Any = recipe
    for part in key.split("."):
        found = getattr(found, part)
    return found


def _by_noise(
    settings: Mapping[str, Any], rows: pd.DataFrame, noises: Sequence[float]
) -> Iterator[tuple[Mapping[str, Any], pd.DataFrame]]:
    if not noises:
        yield settings, rows
    for noise in noises:
        mine = rows[rows[NOISE] == noise]
        if not mine.empty:
            yield ({**settings, NOISE: noise} if len(noises) > 1 else settings), mine


def _place(settings: Mapping[str, Any], factors: Mapping[str, Sequence[Any]]) -> list[int]:
    return [list(values).index(settings[key]) for key, values in factors.items()]


# -- success and differences -----------------------------------------------------------------


def grid_summary(grid: GridEpisodes) -> list[Row]:
    """Return success rows of every setting, as `summarise` does, with the factors as keys."""
    return [{**settings, **row} for settings, rows in grid.parts for row in summarise(rows)]


def grid_differences(grid: GridEpisodes) -> list[Row]:
    """Return the paired differences of methods in every setting, with the factors as keys."""
    return [
        {**settings, **row} for settings, rows in grid.parts for row in differences(rows, PAIRS)
    ]


def settings_of(grid: GridEpisodes) -> list[dict[str, Any]]:
    """Return the settings that were evaluated, in the order of the grid."""
    return [dict(settings) for settings, _ in grid.parts]


def last_cell(rows: Sequence[Row], protocol: str) -> dict[str, int]:
    """Return delay and exec horizon of a protocol's largest delay."""
    mine = [row for row in rows if fits_protocol(row, protocol)]
    last = max(mine, key=lambda row: (row["delay"], row["exec_horizon"]))
    return {"delay": last["delay"], "exec_horizon": last["exec_horizon"]}


# -- what changes them -----------------------------------------------------------------------


def effect_rows(grid: GridEpisodes) -> list[Row]:
    """Return how success and differences change from the first to the last value of each factor.

    The other factors are averaged with equal weights over the combinations that both values have.
    Keys: factor, start, end, method, baseline (None: the method's own success), delay,
    exec_horizon, task, difference, low, high, seeds, interval. The interval is paired by training
    seed, or with one seed by episode, as for differences of methods.
    """
    frame = _solved(grid)
    tasks = set(frame["task"])
    found: list[Row] = []
    for (delay, s), cell in frame.groupby(["delay", "exec_horizon"]):
        for method, baseline in [("naive", None), *PAIRS]:
            values = _quantity(cell, method, baseline, list(grid.factors))
            for factor, levels in grid.factors.items():
                ends = {"factor": factor, "start": levels[0], "end": levels[-1]}
                what = {"method": method, "baseline": baseline}
                where = {"delay": int(delay), "exec_horizon": int(s)}
                contrast = _contrast(values, factor, levels, list(grid.factors))
                estimates = _estimates(contrast, tasks)
                found.extend({**ends, **what, **where, **row} for row in estimates)
    return found


def _solved(grid: GridEpisodes) -> pd.DataFrame:
    """Return all episodes with their factors, one row per setting, method, cell and episode."""
    keys = ["method", "delay", "exec_horizon", "flow_steps", *_EPISODE, "solved"]
    frames = []
    for settings, rows in grid.parts:
        prepared = prepare(rows)[keys]
        frames.append(prepared.assign(solved=prepared["solved"].astype(float), **settings))
    whole = pd.concat(frames, ignore_index=True)
    return whole[whole["flow_steps"] == whole["flow_steps"].mode().iloc[0]]


def _quantity(
    cell: pd.DataFrame, method: str, baseline: str | None, factors: list[str]
) -> pd.DataFrame:
    """Return `value` per setting and episode: solved, or solved minus the baseline's."""
    keys = [*factors, *_EPISODE]
    mine = cell.loc[cell["method"] == method, [*keys, "solved"]]
    if baseline is None:
        return mine.rename(columns={"solved": "value"})
    other = cell.loc[cell["method"] == baseline, [*keys, "solved"]]
    both = mine.merge(other, on=keys, suffixes=("", "_baseline"))
    return both.assign(value=both["solved"] - both["solved_baseline"])[[*keys, "value"]]


def _contrast(
    values: pd.DataFrame, factor: str, levels: Sequence[Any], factors: list[str]
) -> pd.DataFrame:
    """Return `gap` per episode: the value at the last level minus that at the first."""
    keys = [*(name for name in factors if name != factor), *_EPISODE]
    start, end = (
        values.loc[values[factor] == level, [*keys, "value"]] for level in (levels[0], levels[-1])
    )
    both = start.merge(end, on=keys, suffixes=("_start", "_end"))
    both = both.assign(gap=both["value_end"] - both["value_start"])
    per_episode = both.groupby(_EPISODE)["gap"].agg(["mean", "size"]).reset_index()
    # An episode that lacks some settings would compare other settings than its neighbours do.
    whole = per_episode[per_episode["size"] == per_episode["size"].max()]
    return whole.rename(columns={"mean": "gap"})


def _estimates(contrast: pd.DataFrame, every_task: set[str]) -> Iterator[Row]:
    """Return one estimate per task, and one for all where no task is missing."""
    tasks = sorted(contrast["task"].unique())
    groups = [(task, [task]) for task in tasks]
    if set(tasks) == every_task:
        groups.append((ALL, tasks))
    for name, members in groups:
        estimate = estimate_gap(contrast, members)
        if estimate is not None:
            yield {"task": name, **estimate}


def require(grid: GridEpisodes, folder: Path) -> None:
    """Raise StateError where no setting was evaluated yet."""
    if not grid.parts:
        raise StateError(
            f"run {folder} holds no evaluated settings of its grid, so there is nothing to report",
            f'run "rtc ablate --run {folder}" first',
        )
