"""`rtc eval --charge`: every method at the delay that its own measured latency makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.evaluated import evaluated_episodes, select_episodes
from rtc_cli.cli.evaluating import Asked
from rtc_cli.cli.live import run_jobs
from rtc_cli.cli.output import document, plain
from rtc_cli.levels import short_name
from rtc_cli.recipe import EvalConfig
from rtc_cli.runs import Run

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType

    from rtc_cli.pipeline.charging import Charged


def evaluate_charged(asked: Asked, workers: int | None) -> dict[str, Any]:
    """Evaluate what `[eval.charge]` asks for, and return the JSON document's content."""
    from rtc_cli.pipeline.charging import charged_by
    from rtc_cli.pipeline.plan import charged_plan

    run = asked.run
    charged = charged_by(asked.config, run.recipe.horizon)
    with run.lock():
        run_jobs(run, charged_plan(run, charged, asked.tasks, asked.seeds), workers)
    return charged_content(asked, charged)


def charged_content(asked: Asked, charged: Sequence[Charged]) -> dict[str, Any]:
    """Return the content of charges that have been evaluated."""
    from rtc_cli.report.charge.rows import ChargedEpisodes, charge_differences, charge_rows

    run, charge = asked.run, asked.config.charge
    assert charge is not None
    possible = any(each.config is not None for each in charged)
    rows = evaluated_episodes(run) if possible else None

    def episodes(config: EvalConfig | None) -> pd.DataFrame | None:
        if config is None or rows is None:
            return None
        return select_episodes(rows, run, config, asked.tasks, asked.seeds)

    evaluated = [
        ChargedEpisodes(
            method=each.charge.method,
            flow_steps=each.charge.flow_steps,
            latency_ms=each.charge.latency_ms,
            delay=each.charge.delay,
            episodes=episodes(each.config),
            reason=each.reason,
        )
        for each in charged
    ]
    return {
        "profile": charge.profile,
        "tasks": ", ".join(short_name(task) for task in asked.tasks),
        "horizon": run.recipe.horizon,
        "hz": charge.hz,
        "rounding": charge.rounding,
        "fixed_ms": dict(charge.fixed_ms),
        "rows": charge_rows(evaluated),
        "differences": charge_differences(evaluated),
    }


def save_charged(run: Run) -> dict[str, Any] | None:
    """Keep in a run what its recipe's `[eval.charge]` asked for; None without it."""
    from rtc_cli.files import write_json
    from rtc_cli.pipeline.charging import charged_by
    from rtc_cli.results import machine_record

    recipe = run.recipe
    if recipe.eval.charge is None:
        return None
    asked = Asked(run, recipe.eval, recipe.tasks, recipe.train.seeds)
    content = charged_content(asked, charged_by(recipe.eval, recipe.horizon))
    shown = plain(document(str(run.folder), machine_record(), **content))
    write_json(run.results / "charge.json", shown)
    return content


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
