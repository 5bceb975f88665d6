"""`rtc profile`: the time of one chunk per sampler."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtc_cli.cli.options import (
    HzOption,
    JsonOption,
    RoundingOption,
    check_names,
    complete_samplers,
)
from rtc_cli.errors import UsageError
from rtc_cli.units import Rounding

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from rtc_cli.core.policy import Policy
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
        int | None,
        typer.Option(
            "--flow-steps",
            min=1,
            metavar="K",
            help="Euler steps of the flow per chunk.  [default: 5, or the run's]",
        ),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option(
            "--horizon", min=1, max=1000, metavar="H", help="Actions in a chunk.  [default: 8]"
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            "--network",
            metavar="NAME",
            help="Random weights of this size: quickstart or paper, or a registered network.  "
            "[default: paper]",
        ),
    ] = None,
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
    as_json: JsonOption = False,
) -> None:
    """Time one chunk per sampler, side by side.

    Times plain, the named samplers and prefix-per-token (the straightforward implementation),
    alternated round by round in one process, warm, each waited for. Compilation is timed apart.
    Works without a run, on random weights.

    \b
    Examples:
      rtc profile --sampler pinv
      rtc profile --sampler pinv --sampler prefix --batch 1,64 --hz 50
      rtc profile --network paper --horizon 50 --json > profile.json
      rtc profile --run runs/quickstart-20260101T120000Z
    """
    from rtc_cli.cli.output import document, output

    sizes = _read_batch(batch)
    if run is not None and (network is not None or horizon is not None):
        raise UsageError(
            "--run comes with its own network and horizon",
            "leave --network and --horizon away, or leave --run away",
        )
    with output(as_json) as out:
        opened = _open(run)
        rows = _measure(
            opened, sampler or [], sizes, flow_steps, horizon, network, rounds, hz, rounding
        )
        from rtc_cli.results import machine_record

        machine = machine_record()
        if opened is not None:
            _save(opened, rows, machine)
        name = None if opened is None else str(opened.folder)
        out.result(document(name, machine, rows), *_render(rows, machine))


def _read_batch(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() and 0 < int(part) <= 65_536 for part in parts):
        raise UsageError(
            f'cannot read the batch sizes "{text}"',
            'write comma-separated integers from 1 to 65536, as in "1,64"',
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


def _measure(
    run: "Run | None",
    samplers: Sequence[str],
    batch: Sequence[int],
    flow_steps: int | None,
    horizon: int | None,
    network: str | None,
    rounds: int,
    hz: float,
    rounding: Rounding,
) -> list[dict[str, Any]]:
    from rtc_cli.cli.output import progress
    from rtc_cli.samplers import list_samplers

    names = check_names(samplers or _DEFAULT_SAMPLERS, list_samplers(), "sampler")
    from rtc_cli.analysis.profile import profile_samplers

    steps = flow_steps or (5 if run is None else run.recipe.eval.flow_steps)
    with progress() as bars:
        bar = bars.add_task("profile", total=None, note="")
        return profile_samplers(
            network or "paper" if run is None else _policy_of(run),
            names,
            batch=batch,
            horizon=horizon,
            flow_steps=steps,
            rounds=rounds,
            hz=hz,
            rounding=rounding,
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
    for size in dict.fromkeys(row["batch"] for row in rows):
        group = [row for row in rows if row["batch"] == size]
        tables += [_times_table(group), _programs_table(group)]
    notes = [
        *_warnings(rows),
        f"d: the delay in control steps that the 95th percentile means ({first['rounding']}).",
        f"x plain: {first['ratio_method']}.",
        "MFLOP, MB: the compiler's count for one call with its loops written out.",
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
    table = _table(
        f"Milliseconds per call: {first['network']}, batch {first['batch']}, "
        f"horizon {first['horizon']}, {first['flow_steps']} flow steps",
        ("p50", "p95", "p99", "/step", "x plain (95%)", f"d at {first['hz']:g} Hz"),
    )
    for row in rows:
        ratio = f"{row['ratio_to_plain']:.2f} [{row['ratio_low']:.2f}, {row['ratio_high']:.2f}]"
        table.add_row(
            row["sampler"],
            *(f"{row[key]:.3g}" for key in ("p50_ms", "p95_ms", "p99_ms", "per_step_ms")),
            "1" if row["sampler"] == "plain" else ratio,
            str(row["delay_at_hz"]),
        )
    return table


def _programs_table(rows: Sequence[Mapping[str, Any]]) -> "RenderableType":
    table = _table("Programs", ("compile s", "MFLOP", "MB"))
    for row in rows:
        costs = (_mega(row[key]) for key in ("flops", "bytes"))
        table.add_row(row["sampler"], f"{row['compile_s']:.2f}", *costs)
    return table


def _table(title: str, columns: Sequence[str]) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1))
    table.add_column("sampler", no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _mega(value: float | None) -> str:
    return "?" if value is None else f"{value / 1e6:.3g}"
