"""`rtc eval --charge`: every method at the delay that its own measured latency makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.evaluated import evaluated_episodes, select_episodes
from rtc_cli.cli.evaluating import Asked
from rtc_cli.cli.live import run_jobs
from rtc_cli.levels import short_name
from rtc_cli.units import Rounding

if TYPE_CHECKING:
    from rich.console import RenderableType


def evaluate_charged(
    asked: Asked,
    profile: Path,
    *,
    fixed_ms: Mapping[str, float],
    hz: float,
    rounding: Rounding,
    workers: int | None,
) -> dict[str, Any]:
    """Evaluate, and return the JSON document's content."""
    from rtc_cli.analysis.charge import read_charges
    from rtc_cli.pipeline.charging import charged_evaluations, charged_plan
    from rtc_cli.pipeline.evaluation import methods_of
    from rtc_cli.report.charge.rows import ChargedEpisodes, charge_differences, charge_rows

    run, config, tasks, seeds = asked.run, asked.config, asked.tasks, asked.seeds
    samplers = {m.name: m.sampler for m in methods_of(config) if m.schedule != "oracle"}
    charges = read_charges(profile, samplers, fixed_ms=fixed_ms, hz=hz, rounding=rounding)
    charged = charged_evaluations(config, run.recipe.horizon, charges)
    with run.lock():
        run_jobs(run, charged_plan(run, charged, tasks, seeds), workers)
    rows = evaluated_episodes(run) if any(each.config for each in charged) else None
    evaluated = [
        ChargedEpisodes(
            method=each.charge.method,
            flow_steps=each.charge.flow_steps,
            latency_ms=each.charge.latency_ms,
            delay=each.charge.delay,
            episodes=None
            if each.config is None or rows is None
            else select_episodes(rows, run, each.config, tasks, seeds),
            reason=each.reason,
        )
        for each in charged
    ]
    return {
        "profile": str(profile),
        "tasks": ", ".join(short_name(task) for task in tasks),
        "horizon": run.recipe.horizon,
        "hz": hz,
        "rounding": rounding,
        "fixed_ms": dict(fixed_ms),
        "rows": charge_rows(evaluated),
        "differences": charge_differences(evaluated),
    }


def render_charged(content: Mapping[str, Any]) -> Sequence[RenderableType]:
    """The tables for people."""
    from rich.text import Text

    from rtc_cli.report.charge.page import charge_grid, difference_grid, findings
    from rtc_cli.report.render import rich_table

    title = f"Success at {content['hz']:g} Hz, each method at its own latency"
    tables: list[RenderableType] = [rich_table(charge_grid(content["rows"]), title=title)]
    if content["differences"]:
        grid = difference_grid(content["differences"])
        tables.append(rich_table(grid, title="Differences with the same K"))
    return [*tables, *(Text(line) for line in findings(content))]
