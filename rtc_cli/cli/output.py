"""What a command prints: tables for people, or with --json one document on stdout.

In JSON mode everything else, stray prints of libraries included, goes to stderr.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress
    from rich.table import Table

SCHEMA = 1


@dataclass(frozen=True)
class Output:
    """Where a command's words and its one result go."""

    as_json: bool
    console: "Console"  # for people: stdout, or stderr in JSON mode
    _stdout: TextIO

    def say(self, *renderables: "RenderableType") -> None:
        """Print for people; in JSON mode on stderr."""
        for renderable in renderables:
            self.console.print(renderable, highlight=False)

    def result(self, document: Mapping[str, Any], *renderables: "RenderableType") -> None:
        """Print the command's result: the document in JSON mode, else the renderables."""
        if self.as_json:
            text = json.dumps(plain(document), ensure_ascii=False, allow_nan=False)
            print(text, file=self._stdout, flush=True)
        else:
            self.say(*renderables)


@contextmanager
def output(as_json: bool) -> Iterator[Output]:
    """Open a command's output; use it around everything that the command does."""
    from rich.console import Console

    stdout = sys.stdout
    if as_json:
        with redirect_stdout(sys.stderr):
            yield Output(True, Console(stderr=True), stdout)
    else:
        yield Output(False, Console(), stdout)


def document(
    run: str | None,
    machine: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    **more: Any,
) -> dict[str, Any]:
    """Return the JSON document that every reporting command prints."""
    return {"schema": SCHEMA, "run": run, "machine": machine, "rows": rows, **more}


def number_table(title: str, columns: Sequence[str]) -> "Table":
    """Return an empty table: names in the first column, numbers in the others."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1))
    for place, name in enumerate(columns):
        table.add_column(name, justify="right" if place else "left", no_wrap=True)
    return table


def plain(value: Any) -> Any:
    """Return a value that JSON can hold: NumPy numbers become Python's, NaN and infinity null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, str) or value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Sequence | set | frozenset):
        return [plain(item) for item in value]
    return str(value)


@contextmanager
def progress() -> Iterator["Progress"]:
    """Show progress bars on stderr, or nothing where stderr is not a terminal.

    Tasks may carry a field `note`, free text behind the bar:
    `bar = bars.add_task("train", total=n, note="")`, `bars.update(bar, advance=1, note="...")`.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.fields[note]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty()) as bars:
        yield bars
