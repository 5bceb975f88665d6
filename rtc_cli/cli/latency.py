"""`rtc latency`: from measured latencies to H, s, the conditioned delay and what to train on."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtc_cli.cli.options import (
    EpisodesOption,
    EstimatorOption,
    FixedMsOption,
    HzOption,
    JsonOption,
    MethodsOption,
    ObservationLagOption,
    OnExceedOption,
    OnLateOption,
    ProtocolOption,
    RoundingOption,
    SaveOption,
    SeedsOption,
    TasksOption,
    WorkersOption,
    complete_samplers,
    read_fixed_ms,
)
from rtc_cli.cli.output import number_table
from rtc_cli.errors import UsageError
from rtc_cli.traces import Unit

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from rtc_cli.analysis.latency import LatencyAnalysis

app = typer.Typer(rich_markup_mode=None)


@app.command()
def latency(
    trace: Annotated[
        Path,
        typer.Argument(
            metavar="TRACE",
            help="Measured latencies, one row per chunk (.csv, .tsv, .txt, .json, .parquet), or a "
            "saved profile (.json).",
        ),
    ],
    hz: HzOption = 50.0,
    unit: Annotated[
        Unit | None,
        typer.Option("--unit", help="Unit of the trace.  [default: the ending of a column's name]"),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            metavar="NAME",
            help="A column of the trace; several add up. Repeatable.  [default: the only one]",
        ),
    ] = None,
    fixed_ms: FixedMsOption = "",
    sampler: Annotated[
        str | None,
        typer.Option(
            "--sampler",
            metavar="NAME",
            help="Which sampler of a profile.  [default: the only one]",
            autocompletion=complete_samplers,
        ),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(
            "--batch",
            min=1,
            metavar="N",
            help="Which batch size of a profile.  [default: the only one]",
        ),
    ] = None,
    flow_steps: Annotated[
        int | None,
        typer.Option(
            "--flow-steps",
            min=1,
            metavar="K",
            help="Which number of Euler steps of a profile.  [default: the only one]",
        ),
    ] = None,
    rounding: RoundingOption = "ceil",
    horizon: Annotated[
        int | None,
        typer.Option(
            "--horizon",
            min=1,
            metavar="H",
            help="Actions in a chunk, where the policy fixes them.  [default: the fewest that do]",
        ),
    ] = None,
    percentile: Annotated[
        float,
        typer.Option(
            "--percentile",
            min=0.5,
            max=0.999,
            metavar="SHARE",
            help="Share of cycles in which d <= s <= H - d has to hold.",
        ),
    ] = 0.99,
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            metavar="DIR",
            help="Evaluate this run's policies under the trace, at the recommended s and told as "
            "recommended; --methods to --workers belong to it.",
        ),
    ] = None,
    methods: MethodsOption = None,
    tasks: TasksOption = None,
    episodes: EpisodesOption = None,
    seeds: SeedsOption = None,
    protocol: ProtocolOption = None,
    estimator: EstimatorOption = None,
    on_late: OnLateOption = None,
    on_exceed: OnExceedOption = None,
    observation_lag: ObservationLagOption = None,
    workers: WorkersOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Analyse measured latencies: which delay, H and s, and what to train on.

    Finds warm-up, drift, outliers and bursts; gives percentiles with 95% intervals for the
    stationary part, the delays they mean at the control rate, the smallest H and s that hold them,
    the delay to tell the sampler, and training delays as keys of a recipe. A latency runs from the
    observation's time stamp to "chunk usable". With --run it also measures how a trained run's
    policies do under these latencies, drawn in blocks so that bursts stay: not under a constant
    delay.

    \b
    Examples:
      rtc latency robot.csv --unit ms --hz 50
      rtc latency robot.csv --column vision_ms --column expert_ms --column network_ms
      rtc latency profile.json --sampler prefix --fixed-ms 62 --horizon 50
      rtc latency robot.parquet --hz 30 --save latency --json
      rtc latency robot.csv --hz 50 --run runs/mine --methods naive,prefix --episodes 256
    """
    from rtc_cli.analysis.latency import analyse
    from rtc_cli.cli.output import output, plain
    from rtc_cli.traces import read_trace

    options: dict[str, Any] = {
        "methods": methods,
        "tasks": tasks,
        "episodes": episodes,
        "seeds": seeds,
        "protocol": protocol,
        "estimator": estimator or None,
        "on_late": on_late,
        "on_exceed": on_exceed,
        "observation_lag": observation_lag,
        "workers": workers,
    }
    if run is None:
        _refuse(options)
    with output(as_json) as out:
        opened = None
        if run is not None:
            from rtc_cli.cli.traced import evaluate_traced, horizon_of
            from rtc_cli.runs import open_run

            opened = open_run(run)
            horizon = horizon_of(opened, horizon)
        measured = read_trace(
            trace,
            columns=column or (),
            unit=unit,
            fixed_ms=read_fixed_ms(fixed_ms),
            sampler=sampler,
            batch=batch,
            flow_steps=flow_steps,
        )
        analysis = analyse(
            measured, hz=hz, rounding=rounding, horizon=horizon, percentile=percentile
        )
        content = _document(analysis)
        if opened is not None:
            content |= evaluate_traced(opened, analysis, trace.stem, **options)
        result = plain(content)
        page: list[RenderableType] = []
        where = {}
        if save is not None:
            from rtc_cli.report.latency.page import build_latency_page

            built = build_latency_page(save, result)
            where = {"page": str(built.html), "markdown": str(built.markdown)}
            page.append(f"page: {built.html}\n      {built.markdown}")
        out.result(result | where, *_render(result), *page)


def _refuse(options: Mapping[str, Any]) -> None:
    """Refuse what belongs to an evaluation where none was asked for."""
    for name, value in options.items():
        if value is not None:
            option = name.replace("_", "-")
            raise UsageError(f"--{option} belongs to --run", "give the run that is to be evaluated")


def _document(analysis: "LatencyAnalysis") -> dict[str, Any]:
    from rtc_cli.analysis.findings import advice, findings
    from rtc_cli.analysis.latency import analysis_document
    from rtc_cli.cli.output import document

    more = analysis_document(analysis)
    more |= {"findings": findings(analysis), "advice": advice(analysis)}
    return document(None, analysis.trace.machine or {}, more.pop("rows"), **more)


def _render(result: Mapping[str, Any]) -> list["RenderableType"]:
    from rich.text import Text

    lines = [f"{result['trace']['rows']} chunks: {result['trace']['source']}.", ""]
    lines += [f"- {sentence}" for sentence in result["findings"]]
    lines += ["", *(f"- {sentence}" for sentence in result["advice"])]
    shown: list[RenderableType] = [
        Text("\n".join(lines)),
        Text(),
        _percentiles(result),
        _delays(result),
        _choices(result),
        _estimators(result),
    ]
    if result["recipe"] is not None:
        shown += [Text("Keys for a recipe:", style="bold"), Text(result["recipe"])]
    if "evaluation" in result:
        from rtc_cli.cli.traced import render_traced

        shown += render_traced(result)
    return shown


def _percentiles(result: Mapping[str, Any]) -> "Table":
    rounding = f"{result['hz']:g} Hz, {result['rounding']}"
    table = number_table(
        "Latency of the stationary part", ("", "ms", "95% interval", f"d at {rounding}")
    )
    for row in result["rows"]:
        ends = [_number(row["low_ms"]), _number(row["high_ms"])]
        interval = "" if row["percentile"] == 1 else " to ".join(ends)
        table.add_row(_name(row), _number(row["latency_ms"]), interval, str(row["delay"]))
    return table


def _delays(result: Mapping[str, Any]) -> "Table":
    table = number_table("Distribution of d", ("d", "chunks", "share"))
    for row in result["delays"]:
        table.add_row(str(row["delay"]), str(row["count"]), f"{row['share']:.1%}")
    return table


def _choices(result: Mapping[str, Any]) -> "Table":
    columns = ("share held", "d", "s", "H", "violated", "age of observation")
    table = number_table(
        "The smallest H and s, by the share of cycles that they are to hold", columns
    )
    for row in result["choices"]:
        age = f"{1000 * row['age'] / result['hz']:.0f} ms"
        violated = f"{row['cycles']['violated']:.1%}"
        numbers = (str(row[key]) for key in ("delay", "exec_horizon", "horizon"))
        table.add_row(_name(row), *numbers, violated, age)
    return table


def _estimators(result: Mapping[str, Any]) -> "Table":
    table = number_table(
        "What to tell the sampler", ("estimator", "mean d_cond", "range", "late chunks")
    )
    for row in result["estimators"]:
        low, high = row["low"], row["high"]
        span = str(low) if low == high else f"{low} to {high}"
        table.add_row(row["estimator"], f"{row['mean']:.2f}", span, f"{row['late']:.1%}")
    return table


def _name(row: Mapping[str, Any]) -> str:
    return "max" if row["percentile"] == 1 else f"p{100 * row['percentile']:g}"


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.4g}"
