"""Options that several commands share: one name, one help text, one way to read each."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.units import Rounding

if TYPE_CHECKING:
    from rtc_cli.fixed_costs import Cost


def complete_recipe(incomplete: str) -> list[str]:
    """Return the shipped recipes whose names begin so, for the shell's completion."""
    from rtc_cli.recipe import list_recipes

    return [name for name in list_recipes() if name.startswith(incomplete)]


def complete_list(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a completion of the last name of a comma-separated list."""

    def complete(incomplete: str) -> list[str]:
        done, comma, last = incomplete.rpartition(",")
        return [f"{done}{comma}{name}" for name in names() if name.startswith(last)]

    return complete


def complete_first(texts: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a completion of one of some texts."""

    def complete(incomplete: str) -> list[str]:
        return [text for text in texts if text.startswith(incomplete)]

    return complete


def _tasks() -> Iterable[str]:
    from rtc_cli.tasks import list_tasks

    return list_tasks()


def complete_samplers(incomplete: str) -> list[str]:
    """Return the samplers whose names begin so, for the shell's completion."""
    from rtc_cli.samplers import list_samplers

    return [name for name in list_samplers() if name.startswith(incomplete)]


def _methods() -> Iterable[str]:
    from rtc_cli.execution.methods import METHODS

    return METHODS


RecipeArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="RECIPE",
        help="A shipped recipe's name or the path of a .toml file.",
        autocompletion=complete_recipe,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a recipe's value. Repeatable."),
]
RunOption = Annotated[
    Path | None,
    typer.Option("--run", metavar="DIR", help="Run folder.  [default: the newest in ./runs]"),
]
NewRunOption = Annotated[
    Path | None,
    typer.Option("--run", metavar="DIR", help="Run folder.  [default: ./runs/<recipe>-<UTC time>]"),
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Go on with the newest run of this recipe.")
]
NewSeedsOption = Annotated[
    str | None,
    typer.Option(
        "--seeds",
        metavar="LIST",
        help="Training seeds, as in 0-2. The newest run of the recipe (or --run) keeps those it "
        "has and gets the others too.  [default: the recipe's]",
    ),
]
SeedsOption = Annotated[
    str | None,
    typer.Option(
        "--seeds", metavar="LIST", help="Training seeds, as in 0,2-4.  [default: the recipe's]"
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout instead of tables.")
]
TasksOption = Annotated[
    str | None,
    typer.Option(
        "--tasks",
        metavar="NAMES",
        help="Tasks, comma-separated; kinetix:PATH_OR_FOLDER for Kinetix level files.  "
        "[default: the recipe's]",
        autocompletion=complete_list(_tasks),
    ),
]
LevelsOption = Annotated[
    str | None,
    typer.Option(
        "--levels",
        metavar="FOLDER",
        help="Folder of the Kinetix level files that a recipe's tasks name.",
    ),
]
DelaysOption = Annotated[
    str | None,
    typer.Option(
        "--delays",
        metavar="LIST",
        help="Delays in control steps: integers and inclusive ranges, as in 0,2-4.  "
        "[default: the recipe's]",
    ),
]
DelayModelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--delay-model",
        metavar="MODEL",
        help="Delays that vary, instead of --delays: constant:2, uniform:0-4, poisson:1.5, "
        "mixture:0.9*constant:1+0.1*uniform:3-6, trace:FILE@HZ (,skip=ROWS, ,rounding=HOW). "
        "Repeatable.",
        autocompletion=complete_first(("constant:", "uniform:", "poisson:", "mixture:", "trace:")),
    ),
]
DelayCapOption = Annotated[
    int | None,
    typer.Option(
        "--delay-cap",
        min=0,
        metavar="N",
        help="No delay of a model is longer.  [default: horizon - 1]",
    ),
]
EstimatorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        metavar="ESTIMATOR",
        help="Which delay the sampler is told: exact, max-of-last:10, percentile:0.95, constant:3. "
        "Repeatable.  [default: the recipe's]",
        autocompletion=complete_first(("exact", "max-of-last:", "percentile:", "constant:")),
    ),
]
OnLateOption = Annotated[
    str | None,
    typer.Option(
        "--on-late",
        metavar="play|discard",
        help="A chunk later than the sampler was told: play its rest, or drop it.  "
        "[default: the recipe's]",
        autocompletion=complete_first(("play", "discard")),
    ),
]
OnExceedOption = Annotated[
    str | None,
    typer.Option(
        "--on-exceed",
        metavar="play|clamp|fail",
        help="A told delay beyond the trained ones: tell and flag it, clamp it, or stop.  "
        "[default: the recipe's]",
        autocompletion=complete_first(("play", "clamp", "fail")),
    ),
]
ObservationLagOption = Annotated[
    int | None,
    typer.Option(
        "--observation-lag",
        min=0,
        metavar="TICKS",
        help="The observation at tick t shows t - TICKS.  [default: the recipe's]",
    ),
]
ChargeOption = Annotated[
    str | None,
    typer.Option(
        "--charge",
        metavar="PROFILE",
        help="Each method, with each number of flow steps of this profile (JSON), at the delay of "
        "its own latency; or with published latencies: rtx-4090.",
    ),
]
SaveOption = Annotated[
    Path | None,
    typer.Option("--save", metavar="DIR", help="Keep a page with tables and figures there."),
]
MethodsOption = Annotated[
    str | None,
    typer.Option(
        "--methods",
        metavar="NAMES",
        help="Methods, comma-separated.  [default: the recipe's]",
        autocompletion=complete_list(_methods),
    ),
]
ProtocolOption = Annotated[
    str | None,
    typer.Option(
        "--protocol",
        metavar="paper|fixed:S|grid",
        help="Execution horizon per delay: max(delay, 1), one S, or every legal one; "
        "comma-separated for several.  [default: the recipe's]",
    ),
]
EpisodesOption = Annotated[
    int | None,
    typer.Option(
        "--episodes",
        min=1,
        metavar="N",
        help="Episodes per training seed and cell.  [default: the recipe's]",
    ),
]
FlowStepsOption = Annotated[
    int | None,
    typer.Option(
        "--flow-steps",
        min=1,
        metavar="K",
        help="Euler steps of the flow per chunk.  [default: the recipe's]",
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        metavar="N",
        help="Processes to use.  [default: one per core, at most 4 with a GPU]",
    ),
]
FixedMsOption = Annotated[
    str,
    typer.Option(
        "--fixed-ms",
        metavar="LIST",
        help="Milliseconds of what is around the network, added to the total: 62, or "
        "vision=18,prefill=44, or a trace of measured ones, network=FILE.",
    ),
]
HzOption = Annotated[
    float, typer.Option("--hz", min=1e-3, metavar="RATE", help="Control rate in Hz.")
]
RoundingOption = Annotated[
    Rounding, typer.Option("--rounding", help="How a latency becomes whole control steps.")
]


def split_names(text: str) -> tuple[str, ...]:
    """Split a comma-separated list; empty parts are left out, repeated names kept once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def check_names(names: Iterable[str], allowed: Iterable[str], what: str) -> tuple[str, ...]:
    """Return the names; UsageError with the nearest allowed name for the first unknown one.

    `what` is the singular in the message, as in "task".
    """
    names, allowed = tuple(names), tuple(allowed)
    if not names:
        raise UsageError(f"no {what} is named", f"name at least one of: {', '.join(allowed)}")
    for name in names:
        if name not in allowed:
            raise UsageError(f'unknown {what} "{name}".{did_you_mean(name, allowed)}')
    return names


def read_names(text: str, allowed: Iterable[str], what: str) -> tuple[str, ...]:
    """Read a comma-separated list of allowed names, as --tasks and --methods take it."""
    return check_names(split_names(text), allowed, what)


def read_fixed_ms(text: str) -> dict[str, "Cost"]:
    """Read "62", "vision=18,prefill=44" or "network=trace.csv" into milliseconds by name."""
    fixed: dict[str, Cost] = {}
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        name, _, value = part.rpartition("=")
        label = name.strip() or "fixed"
        if label in fixed:
            raise UsageError(
                f'the fixed cost "{label}" is given twice', "add the two up, or name them apart"
            )
        fixed[label] = _read_cost(part, value.strip())
    return fixed


def _read_cost(part: str, value: str) -> "Cost":
    from rtc_cli.traces import ENDINGS

    if Path(value).suffix.lower() in ENDINGS:
        return _read_measured(Path(value))
    try:
        milliseconds = float(value)
    except ValueError:
        milliseconds = math.nan
    if not (math.isfinite(milliseconds) and milliseconds >= 0):
        raise UsageError(
            f'cannot read the fixed cost "{part}"',
            'write milliseconds >= 0, as in "62" or "vision=18,prefill=44", or the file of a '
            'trace, as in "network=trace.csv"',
        )
    return milliseconds


def _read_measured(path: Path) -> "Cost":
    """Read a trace of one column, in ms or s by the column's name."""
    from rtc_cli.traces import read_trace

    try:
        return tuple(read_trace(path).total_ms.tolist())
    except UsageError as error:
        hint = f"give a file of one column whose name ends in _ms or _s ({error.hint})"
        raise UsageError(error.message, hint) from None
