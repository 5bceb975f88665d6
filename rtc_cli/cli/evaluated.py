"""How evaluated episodes are shown: the tables of `eval` and `run`, and their JSON document."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.output import document
from rtc_cli.errors import StateError
from rtc_cli.levels import short_name
from rtc_cli.recipe import EvalConfig
from rtc_cli.runs import Run

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType

    from rtc_cli.execution.timing import Timing
    from rtc_cli.report.sections import Results

SINGLY = 4
"""More tasks than this share one table in the terminal."""


def selected_episodes(
    run: Run, config: EvalConfig, tasks: tuple[str, ...], seeds: tuple[int, ...]
) -> pd.DataFrame:
    """Return the rows of a run that an evaluation with these settings asked for."""
    return select_episodes(evaluated_episodes(run), run, config, tasks, seeds)


def evaluated_episodes(run: Run) -> pd.DataFrame:
    """Read all rows of a run; StateError where it has none."""
    from rtc_cli.report.inputs import load_episodes

    rows = load_episodes(run.folder)
    if rows.empty:
        raise StateError(f"run {run.folder} holds no evaluated episodes", 'run "rtc eval" first')
    return rows


def select_episodes(
    rows: pd.DataFrame,
    run: Run,
    config: EvalConfig,
    tasks: tuple[str, ...],
    seeds: tuple[int, ...],
) -> pd.DataFrame:
    """Return those of a run's rows that an evaluation with these settings asked for."""
    import numpy as np

    from rtc_cli.execution.protocols import OPEN_LOOP
    from rtc_cli.pipeline.evaluation import TUNED, methods_of, timings_of

    names = {method.name for method in methods_of(config)}
    if TUNED in config.methods or config.tune is not None:
        names.add(TUNED)
    first, timings = config.first_episode, timings_of(config, run.recipe.horizon)
    wanted = {
        "task": [short_name(task) for task in tasks],
        "train_seed": seeds,
        "method": names,
        "protocol": config.protocols,
        "delay": [timing.delay for timing in timings],
        "flow_steps": (config.flow_steps,),
        "episode": range(first, first + config.episodes),
    }
    asked = {column: rows[column].isin(list(values)) for column, values in wanted.items()}
    # Without delay, whatever the delays asked for: the oracle's losses are measured from there.
    reference = (rows["protocol"] == OPEN_LOOP) & ("oracle" in config.methods)
    for free in ("protocol", "delay"):
        asked[free] |= reference
    near = rows[np.logical_and.reduce([*asked.values(), _noise_asked(rows, run, config, tasks)])]
    # Row by row, so only of the rows that are left.
    return near[_timing_asked(near, timings) | reference[near.index]]


def _timing_asked(rows: pd.DataFrame, timings: Sequence[Timing]) -> pd.Series[bool]:
    """Say which rows have the delays, estimators and the like that were asked for."""
    import pandas as pd

    names = list(timings[0].columns)
    asked = {tuple(timing.columns.values()) for timing in timings}
    found = zip(*(rows[name] for name in names), strict=True)
    return pd.Series([row in asked for row in found], rows.index, dtype=bool)


def _noise_asked(
    rows: pd.DataFrame, run: Run, config: EvalConfig, tasks: tuple[str, ...]
) -> pd.Series[bool]:
    """Say which rows were evaluated under a noise that was asked for: without one, the task's."""
    from rtc_cli.tasks import get_task

    if config.action_noise:
        return rows["action_noise"].isin(config.action_noise)
    own = {short_name(task): get_task(run.source(task)).action_noise for task in tasks}
    return rows["action_noise"] == rows["task"].map(own)


def evaluation_document(run: Run, results: Results) -> dict[str, Any]:
    """Return the JSON document: rows, differences, the decomposition, D90 and the matrix."""
    from rtc_cli.results import machine_record

    return document(
        str(run.folder),
        machine_record(),
        results.summary,
        differences=results.differences,
        **results.losses,
        d90=results.d90,
        matrix=results.matrix,
    )


def evaluation_tables(results: Results) -> list[RenderableType]:
    """Return the tables for people: success, differences, losses, D90, the matrix."""
    from rtc_cli.report import render
    from rtc_cli.report.losses.grids import render_losses
    from rtc_cli.report.losses.text import main_protocol
    from rtc_cli.report.tables import ALL
    from rtc_cli.report.varying import constant, render_varying

    tables: list[RenderableType] = []
    summary, gaps = constant(results.summary), constant(results.differences)
    several, many = len(results.tasks) > 1, len(results.tasks) > SINGLY
    singly = [] if many else results.tasks
    for task in [*singly, ALL] if several else singly:
        tables.extend(render.render_summary(summary, task=task))
    if many and summary:
        tables.append(render.render_by_task(summary, main_protocol(summary)))
    for protocol in results.protocols:
        if gaps and protocol != "grid":
            task = ALL if several else results.tasks[0]
            tables.append(render.render_differences(gaps, protocol, task=task))
        if results.matrix and protocol != "grid":
            tables.append(render.render_matrix(results.matrix, protocol))
    tables.extend(render_varying(results.summary, results.differences))
    tables.extend(render_losses(results.losses))
    return [*tables, *render.render_d90(results.d90)]
