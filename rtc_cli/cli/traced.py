"""`rtc latency --run`: a run's policies under the latencies that were analysed."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.evaluating import Asked, ask, evaluate_asked, read_methods, read_protocols
from rtc_cli.errors import UsageError
from rtc_cli.levels import short_name
from rtc_cli.runs import Run

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rtc_cli.analysis.latency import LatencyAnalysis


def horizon_of(run: Run, horizon: int | None) -> int:
    """Return H of a run's policies; UsageError where another one was asked for."""
    if horizon not in (None, run.recipe.horizon):
        raise UsageError(
            f"--horizon {horizon}, but the policies of {run.folder} have horizon "
            f"{run.recipe.horizon}",
            "leave --horizon away, or analyse without --run",
        )
    return run.recipe.horizon


def evaluate_traced(
    run: Run,
    analysis: LatencyAnalysis,
    name: str,
    *,
    methods: str | None,
    tasks: str | None,
    episodes: int | None,
    seeds: str | None,
    protocol: str | None,
    estimator: Sequence[str] | None,
    on_late: str | None,
    on_exceed: str | None,
    observation_lag: int | None,
    workers: int | None,
) -> dict[str, Any]:
    """Evaluate under the trace, and return what that adds to the JSON document.

    `name` is the trace's; the others are options, which take the place of the run's recipe and of
    what the analysis advises.
    """
    from rtc_cli.pipeline.tracing import advised, keep_latencies
    from rtc_cli.report.tables import differences, summarise
    from rtc_cli.results import machine_record

    if protocol is None:
        _check_fits(analysis)
    with run.lock():
        latencies = keep_latencies(run, analysis, name)
    advice = advised(analysis, latencies)
    changes = advice | {
        "methods": read_methods(methods),
        "matrix": None if methods is None else False,
        "episodes": episodes,
        "protocols": read_protocols(protocol) or advice["protocols"],
        "estimators": estimator or advice["estimators"],
        "on_late": on_late,
        "on_exceed": on_exceed,
        "observation_lag": observation_lag,
    }
    asked = ask(run, changes, tasks=tasks, seeds=seeds)
    rows = evaluate_asked(asked, workers)
    return {
        "run": str(run.folder),
        "evaluated": _settings(asked, analysis)
        | {"machine": machine_record(), "latencies": str(latencies)},
        "evaluation": summarise(rows),
        "differences": differences(rows),
    }


def _check_fits(analysis: LatencyAnalysis) -> None:
    """Refuse latencies whose mean delay is beyond what any s allows at this H."""
    from rtc_cli.analysis.findings import advice

    mean, limit = float(analysis.measured.mean()), analysis.recommendation.limit
    if round(mean, 2) >= limit + 0.5:
        raise UsageError(
            f"the mean delay at {analysis.hz:g} Hz is {mean:.1f} control steps; at most {limit} "
            f"can be evaluated. {advice(analysis)[0]}"
        )


def _settings(asked: Asked, analysis: LatencyAnalysis) -> dict[str, Any]:
    """Return how the policies were evaluated, and the command that does it again."""
    from rtc_cli.pipeline.evaluation import timings_of
    from rtc_cli.traces import default_block

    config = asked.config
    kept = analysis.trace.after(analysis.warm_up.rows)
    return {
        "delay_model": timings_of(config, asked.run.recipe.horizon)[0].model.text,
        "rows": len(kept),
        "mean_block": default_block(kept),
        "hz": analysis.hz,
        "drifts": analysis.drift.found,
        "horizon": asked.run.recipe.horizon,
        "flow_steps": config.flow_steps,
        "protocols": list(config.protocols),
        "estimators": list(config.estimators),
        "command": _command(asked),
    }


def _command(asked: Asked) -> str:
    """The same evaluation with `rtc eval`."""
    from rtc_cli.pipeline.evaluation import TUNED

    config = asked.config
    methods = (*config.methods, *((TUNED,) if config.tune is not None else ()))
    options = [
        ("--run", [str(asked.run.folder)]),
        ("--tasks", [",".join(map(short_name, asked.tasks))]),
        ("--seeds", [",".join(map(str, asked.seeds))]),
        ("--delay-model", config.delay_models),
        ("--delay-cap", [str(config.delay_cap)]),
        ("--estimator", config.estimators),
        ("--protocol", [",".join(config.protocols)]),
        ("--methods", [",".join(methods)]),
        ("--episodes", [str(config.episodes)]),
        ("--flow-steps", [str(config.flow_steps)]),
        ("--on-late", [config.on_late]),
        ("--on-exceed", [config.on_exceed]),
        ("--observation-lag", [str(config.observation_lag)]),
    ]
    words = [word for option, values in options for value in values for word in (option, value)]
    return shlex.join(["rtc", "eval", *words])


def render_traced(result: Mapping[str, Any]) -> Sequence[RenderableType]:
    """The evaluation for people."""
    from rich.text import Text

    from rtc_cli.report.latency.evaluation import difference_grid, evaluation_grid, sentences
    from rtc_cli.report.render import rich_table

    found = "\n".join(f"- {sentence}" for sentence in sentences(result))
    title = "Episodes solved under these latencies (per episode: chunks, ticks, requests)"
    caption = "below: 95% Wilson interval, for these checkpoints"
    shown: list[RenderableType] = [
        Text("\nEvaluated:", style="bold"),
        Text(found + "\n"),
        rich_table(evaluation_grid(result), title, caption),
    ]
    if result["differences"]:
        title = "Paired differences (percentage points)"
        shown.append(rich_table(difference_grid(result), title))
    return shown
