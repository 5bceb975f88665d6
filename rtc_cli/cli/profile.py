"""`rtc profile`: the time of one chunk per sampler."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtc_cli.cli.options import (
    FixedMsOption,
    HzOption,
    JsonOption,
    RoundingOption,
    SaveOption,
    check_names,
    complete_samplers,
    read_fixed_ms,
)
from rtc_cli.cli.output import number_table
from rtc_cli.errors import UsageError
from rtc_cli.units import Rounding, three_digits

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rtc_cli.core.policy import Policy
    from rtc_cli.fixed_costs import Cost
    from rtc_cli.runs import Run

app = typer.Typer(rich_markup_mode=None)

_DEFAULT_SAMPLERS = ("pinv", "prefix")


@app.command()
def profile(
    sampler: Annotated[
        list[str] | None,
        typer.Option(
            "--sampler",
            metavar="NAME",
            help="A sampler to time beside plain and prefix-per-token. Repeatable.  "
            "[default: pinv, prefix]",
            autocompletion=complete_samplers,
        ),
    ] = None,
    batch: Annotated[
        str, typer.Option("--batch", metavar="LIST", help="Batch sizes, comma-separated.")
    ] = "1",
    flow_steps: Annotated[
        str | None,
        typer.Option(
            "--flow-steps",
            metavar="LIST",
            help="Euler steps of the flow per chunk, comma-separated.  [default: 5, or the run's]",
        ),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option(
            "--horizon",
            min=1,
            max=1000,
            metavar="H",
            help="Actions in a chunk.  [default: 8; 50 for the experts]",
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            "--network",
            metavar="NAME",
            help="Random weights of this size: quickstart, paper, expert-300m, expert-860m, or a "
            "registered network.  [default: paper]",
        ),
    ] = None,
    dtype: Annotated[
        str,
        typer.Option("--dtype", metavar="TYPE", help="float32, or bfloat16 (experts)."),
    ] = "float32",
    fixed_ms: FixedMsOption = "",
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            metavar="DIR",
            help="Time this run's policy instead, and keep the result in the run.",
        ),
    ] = None,
    rounds: Annotated[
        int, typer.Option("--rounds", min=2, metavar="N", help="Chunks timed per sampler.")
    ] = 50,
    hz: HzOption = 30.0,
    rounding: RoundingOption = "ceil",
    save: SaveOption = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Instead of timing: what guidance does in every step of a run's policy.",
        ),
    ] = False,
    task: Annotated[
        str | None,
        typer.Option(
            "--task", metavar="NAME", help="With --explain: of this task.  [default: the first]"
        ),
    ] = None,
    exec_horizon: Annotated[
        int | None,
        typer.Option(
            "--exec-horizon", min=1, metavar="s", help="With --explain.  [default: H / 2]"
        ),
    ] = None,
    delay: Annotated[
        int | None,
        typer.Option("--delay", min=1, metavar="d", help="With --explain.  [default: H - s]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Time one chunk per sampler, side by side, and say what follows from it.

    Times plain, the named samplers and prefix-per-token (the straightforward implementation),
    alternated round by round in one process, warm, each waited for. Compilation is timed apart.
    Works without a run, on random weights. The floor is the least time for what a chunk has to
    read and compute, at a memory bandwidth and a rate measured in the same run.

    \b
    Examples:
      rtc profile --sampler pinv
      rtc profile --sampler pinv --sampler prefix --batch 1,64 --hz 50
      rtc profile --network paper --horizon 50 --json > profile.json
      rtc profile --network expert-300m --rounds 5 --fixed-ms vision=18,prefill=44 --hz 50
      rtc profile --run runs/quickstart-20260101T120000Z
      rtc profile --explain --delay 4
    """
    from rtc_cli.cli.output import document, output

    if run is not None and (network is not None or horizon is not None or dtype != "float32"):
        raise UsageError(
            "--run comes with its own network, horizon and dtype",
            "leave --network, --horizon and --dtype away, or leave --run away",
        )
    if explain:
        steps = _read_integers(flow_steps, "flow steps", 1000)[0] if flow_steps else None
        _explain(run, sampler, task, exec_horizon, delay, steps, save, as_json)
        return
    settings = _Settings(
        samplers=tuple(sampler or ()),
        batch=_read_integers(batch, "batch sizes", 65_536),
        flow_steps=_read_integers(flow_steps, "flow steps", 1000) if flow_steps else None,
        horizon=horizon,
        network=network,
        dtype=dtype,
        rounds=rounds,
        hz=hz,
        rounding=rounding,
        fixed_ms=read_fixed_ms(fixed_ms),
    )
    with output(as_json) as out:
        opened = _open(run)
        rows = _measure(opened, settings)
        from rtc_cli.results import machine_record

        machine = machine_record()
        if opened is not None:
            _save(opened, rows, machine)
        name = None if opened is None else str(opened.folder)
        content = document(name, machine, rows)
        if save is not None:
            from rtc_cli.report.profile.page import save_profile_page

            save_profile_page(save, content)
        out.result(content, *_render(rows, machine))


def _explain(
    run: Path | None,
    samplers: list[str] | None,
    task: str | None,
    exec_horizon: int | None,
    delay: int | None,
    flow_steps: int | None,
    save: Path | None,
    as_json: bool,
) -> None:
    from rtc_cli.cli.explain import explain_run, render_explanation
    from rtc_cli.cli.output import output
    from rtc_cli.samplers import list_samplers

    names = check_names(samplers or _DEFAULT_SAMPLERS, list_samplers(), "sampler")
    with output(as_json) as out:
        content = explain_run(run, list(names), task, exec_horizon, delay, flow_steps)
        if save is not None:
            from rtc_cli.report.profile.explain import save_explain_page

            save_explain_page(save, content)
        out.result(content, *render_explanation(content))


@dataclass(frozen=True)
class _Settings:
    """What is to be measured, as it was asked for; None is the default."""

    samplers: tuple[str, ...]
    batch: list[int]
    flow_steps: list[int] | None
    horizon: int | None
    network: str | None
    dtype: str
    rounds: int
    hz: float
    rounding: Rounding
    fixed_ms: dict[str, "Cost"]


def _read_integers(text: str, what: str, largest: int) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() and 0 < int(part) <= largest for part in parts):
        raise UsageError(
            f'cannot read the {what} "{text}"',
            f'write comma-separated integers from 1 to {largest}, as in "1,64"',
        )
    return list(dict.fromkeys(int(part) for part in parts))


def _open(folder: Path | None) -> "Run | None":
    if folder is None:
        return None
    from rtc_cli.runs import open_run

    return open_run(folder)


def _policy_of(run: "Run") -> "Policy":
    """Return the base policy of the run's first task and training seed."""
    from rtc_cli.training.checkpoints import load_policy

    recipe = run.recipe
    return load_policy(run.checkpoint(recipe.tasks[0], recipe.train.seeds[0], "base"))


def _measure(run: "Run | None", settings: _Settings) -> list[dict[str, Any]]:
    from rtc_cli.cli.output import progress
    from rtc_cli.samplers import list_samplers

    names = check_names(settings.samplers or _DEFAULT_SAMPLERS, list_samplers(), "sampler")
    from rtc_cli.analysis.profile import Clock, profile_samplers

    default_steps = 5 if run is None else run.recipe.eval.flow_steps
    with progress() as bars:
        bar = bars.add_task("profile", total=None, note="")
        return profile_samplers(
            settings.network or "paper" if run is None else _policy_of(run),
            names,
            batch=settings.batch,
            horizon=settings.horizon,
            flow_steps=settings.flow_steps or [default_steps],
            rounds=settings.rounds,
            clock=Clock(settings.hz, settings.rounding, settings.fixed_ms),
            dtype=settings.dtype,
            label=None if run is None else run.recipe.name,
            progress=lambda done, total: bars.update(bar, completed=done, total=total),
        )


def _save(run: "Run", rows: Sequence[Mapping[str, Any]], machine: Mapping[str, Any]) -> None:
    from rtc_cli.analysis.profile import save_profile

    with run.lock():
        save_profile(run.results / "profile.json", rows, machine)


def _render(
    rows: Sequence[Mapping[str, Any]], machine: Mapping[str, Any]
) -> list["RenderableType"]:
    from rich.text import Text

    first = rows[0]
    tables: list[RenderableType] = []
    for cell in dict.fromkeys((row["batch"], row["flow_steps"]) for row in rows):
        group = [row for row in rows if (row["batch"], row["flow_steps"]) == cell]
        tables += [_times_table(group), _programs_table(group), _meaning_table(group)]
    notes = [
        *_warnings(rows),
        f"d: the delay in control steps that the 95th percentile, fixed costs added, means "
        f"({first['rounding']}).",
        f"x plain: {first['ratio_method']}.",
        "FLOP, B: the compiler's count for one call with its loops written out; held: the "
        "most that it has in memory. Hz: the highest control rate at which the delay is still d.",
        f"floor: what has to be read at {first['ceiling_bytes_per_s'] / 1e9:.3g} GB/s, computed at "
        f"{first['ceiling_flops_per_s'] / 1e9:.4g} GFLOP/s ({first['dtype']}), both measured now.",
        f"{machine['cpu']}, {machine['cores']} cores, jax {machine['jax']}.",
    ]
    return [*tables, Text("\n".join(notes), style="dim")]


def _warnings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return advice where the samples are too few or too restless to trust."""
    rounds = rows[0]["rounds"]
    found = []
    if rounds < 20:
        found.append(f"Only {rounds} rounds: p95 and p99 are rough; use --rounds 50.")
    if any(row["p95_ms"] > 2 * row["p50_ms"] for row in rows):
        found.append("p95 is over twice the median: the machine is busy; close other programs.")
    return found


def _times_table(rows: Sequence[Mapping[str, Any]]) -> "RenderableType":
    first = rows[0]
    # A minute in milliseconds would not fit beside the rest on 80 columns.
    slow = max(row["p99_ms"] for row in rows) >= 1e4
    unit, size = ("Seconds", 1000) if slow else ("Milliseconds", 1)
    table = number_table(
        f"{unit} per call: {first['network']}, batch {first['batch']}, horizon "
        f"{first['horizon']}, {first['flow_steps']} flow steps; d at {first['hz']:g} Hz",
        ("sampler", "p50", "p95", "p99", "step", "x plain (95%)", "d"),
    )
    for row in rows:
        ratio = f"{row['ratio_to_plain']:.2f} [{row['ratio_low']:.2f}, {row['ratio_high']:.2f}]"
        times = (row[key] / size for key in ("p50_ms", "p95_ms", "p99_ms", "per_step_ms"))
        table.add_row(
            row["sampler"],
            *map(three_digits, times),
            "1" if row["sampler"] == "plain" else ratio,
            str(row["delay_at_hz"]),
        )
    return table


def _programs_table(rows: Sequence[Mapping[str, Any]]) -> "RenderableType":
    unit, size = ("G", 1e9) if (rows[0]["flops"] or 0) > 1e10 else ("M", 1e6)
    columns = (
        "sampler",
        "compile s",
        f"{unit}FLOP",
        f"{unit}B",
        f"held {unit}B",
        "floor ms",
        "p50/floor",
    )
    table = number_table("Programs", columns)
    for row in rows:
        values = (row[key] for key in ("flops", "bytes", "memory_bytes"))
        counts = ("?" if value is None else three_digits(value / size) for value in values)
        floor = (three_digits(row["floor_ms"]), three_digits(row["over_floor"]))
        table.add_row(row["sampler"], f"{row['compile_s']:.2f}", *counts, *floor)
    return table


def _meaning_table(rows: Sequence[Mapping[str, Any]]) -> "RenderableType":
    from rtc_cli.fixed_costs import say_costs

    first = rows[0]
    fixed = say_costs(first["fixed_ms"]) or "none"
    title = f"What it means at {first['hz']:g} Hz; fixed costs: {fixed}"
    rates = [d for d in ("1", "2", "4") if d in first["highest_hz"]]
    table = number_table(
        title, ("sampler", "p95 ms", "d", "of chunk", *(f"Hz, d={d}" for d in rates))
    )
    for row in rows:
        table.add_row(
            row["sampler"],
            three_digits(row["total_p95_ms"]),
            str(row["delay_at_hz"]),
            f"{row['chunk_share']:.0%}",
            *(f"{row['highest_hz'][d]:.3g}" for d in rates),
        )
    return table
