"""Traces of measured latencies: one row per chunk, in the order in which they were measured.

A trace is a CSV, JSON or parquet file with one column or with components that add up, or a saved
profile. `resample_blocks` draws from one without breaking its bursts. Imports nothing heavy.
"""

import bisect
import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtc_cli.autocorrelation import block_length, ranks
from rtc_cli.errors import StateError, UsageError, did_you_mean
from rtc_cli.files import os_error
from rtc_cli.fixed_costs import Cost, FixedCosts, check_costs, say_costs
from rtc_cli.units import Rounding, latency_to_delay

Unit = Literal["ms", "s"]
UNITS: tuple[str, ...] = get_args(Unit)
ENDINGS = (".csv", ".tsv", ".txt", ".json", ".parquet")
"""Of the files that a trace is read from."""

_MS_PER = {"ms": 1.0, "s": 1000.0}
_NAMELESS = "latency"  # the column of a JSON list of numbers
_LATE_PERCENTILE = 95
_TOO_SHORT_MS, _TOO_LONG_S = 1.0, 10.0
_COST_SEED = 0x636F7374  # "cost"
_CHOICES = ("sampler", "batch", "flow_steps")  # what tells the rows of a profile apart

Cells = dict[str, list[Any]]
"""A file's columns by name, as they stand there."""


@dataclass(frozen=True, eq=False)
class LatencyTrace:
    """Latencies of N chunks, from the observation's time stamp to "chunk usable".

    `total_ms` (N,) is the sum of `components_ms`, name -> (N,), all finite and >= 0. `unit` is the
    file's ("ms", "s" or "ms and s"); here everything is ms. `kind` is "profile" where chunks were
    timed one by one by `rtc profile`; `machine` is that profile's record and `flow_steps` the K of
    its chunks, where it says so. `warnings` are sentences.
    """

    total_ms: NDArray[np.float64]
    components_ms: Mapping[str, NDArray[np.float64]]
    source: str
    unit: str
    kind: Literal["trace", "profile"] = "trace"
    machine: Mapping[str, Any] | None = None
    flow_steps: int | None = None
    warnings: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return int(self.total_ms.size)

    def delays(self, hz: float, rounding: Rounding = "ceil") -> NDArray[np.int64]:
        """(N,) delays in control steps at a control rate."""
        return to_delays(self.total_ms, hz, rounding)

    def after(self, first: int) -> "LatencyTrace":
        """Return the trace without its first rows, a warm-up for example."""
        components = {name: values[first:] for name, values in self.components_ms.items()}
        return replace(self, total_ms=self.total_ms[first:], components_ms=components)


def to_delays(latencies_ms: ArrayLike, hz: float, rounding: Rounding = "ceil") -> NDArray[np.int64]:
    """Return the delay in control steps of each latency; any shape. See `latency_to_delay`."""
    latency_to_delay(0.0, hz, rounding)  # refuses a bad rate also where there is no latency
    values = np.asarray(latencies_ms, np.float64)
    order = np.argsort(values, axis=None)
    ordered = values.ravel()[order]
    delays = np.empty(values.size, dtype=np.int64)
    start = 0
    # A delay never falls with the latency, so that each is looked for once, not once per row.
    while start < ordered.size:
        delay = latency_to_delay(float(ordered[start]), hz, rounding)
        stop = bisect.bisect_right(
            ordered, delay, lo=start, key=lambda value: latency_to_delay(value, hz, rounding)
        )
        delays[order[start:stop]] = delay
        start = stop
    return delays.reshape(values.shape)


def read_trace(
    path: Path | str,
    *,
    columns: Sequence[str] = (),
    unit: Unit | None = None,
    fixed_ms: FixedCosts | None = None,
    sampler: str | None = None,
    batch: int | None = None,
    flow_steps: int | None = None,
) -> LatencyTrace:
    """Read a trace from .csv, .tsv, .txt, .json or .parquet, or from a saved profile (.json).

    `columns` that add up; may be left out where the file has one. Units come from the ends of the
    columns' names (`_ms`, `_s`) or from `unit`. JSON: a list of numbers, a list of objects, or an
    object of lists. `fixed_ms` are added to every row, as are those that a profile was made with;
    measured ones are drawn in blocks, always alike. `sampler`, `batch` and `flow_steps` choose a
    row of a profile. Rows are numbered from 1, below the header. Raises UsageError for what was
    asked, StateError for what the file holds.
    """
    path = Path(path)
    fixed = check_costs(fixed_ms or {})
    content = _read(path)
    chosen = {"sampler": sampler, "batch": batch, "flow_steps": flow_steps}
    wanted = {key: value for key, value in chosen.items() if value is not None}
    if _is_profile(content):
        if columns:
            raise UsageError(f"{path} is a profile, which has no columns", "choose with --sampler")
        trace = _from_profile(path, content, wanted, unit)
    elif wanted:
        raise UsageError(
            f"{path} is a trace, not a profile: there is no {next(iter(wanted))} to choose",
            "name its columns with --column",
        )
    else:
        trace = _from_columns(path, content, columns, unit)
    return _add_fixed(trace, fixed)


def resample_blocks(
    trace: LatencyTrace,
    count: int,
    generator: np.random.Generator,
    block: float | None = None,
) -> NDArray[np.float64]:
    """(count,) latencies in ms, drawn from a trace in blocks, so that its bursts stay.

    Stationary bootstrap (Politis and Romano, J. Amer. Statist. Assoc. 89 (1994) 1303-1313): from a
    row drawn at random on, rows follow in order, the last one by the first; after each row a new
    block begins with probability 1 / `block`. `block` is a mean length in rows; by default
    `default_block`. 1 draws every row for itself. A function of the generator's state only.
    """
    if count < 0:
        raise UsageError(f"{count} latencies cannot be drawn", "give a number >= 0")
    length = default_block(trace) if block is None else block
    if not math.isfinite(length) or length < 1:
        raise UsageError(f"block length {length} is not possible", "give a number >= 1")
    begins = generator.random(count) < 1 / length
    starts = generator.integers(0, len(trace), size=count)
    begins[:1] = True
    place = np.arange(count)
    first = np.maximum.accumulate(np.where(begins, place, 0))
    return trace.total_ms[(starts[first] + place - first) % len(trace)]


def default_block(trace: LatencyTrace) -> float:
    """Mean block length for a trace, in rows: 1 where rows are independent.

    The longer of two: for the latencies' ranks, and for being among the slowest 5%.
    """
    late = trace.total_ms > np.percentile(trace.total_ms, _LATE_PERCENTILE)
    return max(block_length(ranks(trace.total_ms)), block_length(late))


# -- files -----------------------------------------------------------------------------------


def _read(path: Path) -> Any:
    """Return a file's columns, or what a JSON file holds."""
    suffix = path.suffix.lower()
    if suffix not in ENDINGS:
        shown = f'"{suffix}" is no ending' if suffix else "there is no ending"
        raise UsageError(
            f"{path}: {shown} of a trace", f"give a file that ends in {', '.join(ENDINGS)}"
        )
    readers = {".json": _read_json, ".parquet": _read_parquet}
    try:
        return readers.get(suffix, _read_text)(path)
    except OSError as error:
        raise os_error(error, path) from error
    except UnicodeDecodeError as error:
        raise StateError(
            f"{path}: byte {error.start} is not UTF-8", "save the file as UTF-8"
        ) from None


def _read_text(path: Path) -> Cells:
    """Read comma- or tab-separated values; a first row of numbers is data, not a header.

    Columns without a header are called 1, 2, ... Blank lines and lines with "#" are left out.
    """
    delimiter = "\t" if path.suffix.lower() == ".tsv" else ","
    with open(path, encoding="utf-8-sig", newline="") as stream:
        lines = (line for line in stream if line.strip() and not line.lstrip().startswith("#"))
        try:
            rows = [
                [cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)
            ]
        except csv.Error as error:
            raise StateError(f"{path}: broken CSV: {error}", "mend the file") from None
    if not rows:
        return {}
    names = [str(place + 1) for place in range(len(rows[0]))]
    if not all(_is_number(cell) for cell in rows[0]):
        names, rows = rows[0], rows[1:]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise StateError(f'{path}: two columns are called "{repeated}"', "rename one of them")
    return {
        name: [row[place] if place < len(row) else "" for row in rows]
        for place, name in enumerate(names)
    }


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise StateError(
            f"{path}: broken JSON: {error.msg}, line {error.lineno}", "mend the file at that place"
        ) from None


def _read_parquet(path: Path) -> Cells:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except pa.ArrowInvalid:
        raise StateError(f"{path}: it is no parquet file, or a damaged one", "check it") from None
    return {name: table[name].to_pylist() for name in table.column_names}


# -- columns ---------------------------------------------------------------------------------


def _from_columns(
    path: Path, content: Any, columns: Sequence[str], unit: Unit | None
) -> LatencyTrace:
    cells = _as_columns(path, content)
    names = _choose(path, cells, columns)
    units = {name: _unit_of(path, name, unit) for name in names}
    components = {name: _numbers(path, name, cells[name]) * _MS_PER[units[name]] for name in names}
    used = " and ".join(dict.fromkeys(units.values()))
    total = np.sum(list(components.values()), axis=0)
    source = f"{path}, {_plural('column', names)}"
    return LatencyTrace(total, components, source, used, warnings=_check(total, used))


def _as_columns(path: Path, content: Any) -> Cells:
    """Turn what a JSON file may hold into columns."""
    if isinstance(content, list):
        if all(isinstance(row, Mapping) for row in content) and content:
            names = dict.fromkeys(name for row in content for name in row)
            return {name: [row.get(name) for row in content] for name in names}
        return {_NAMELESS: content} if content else {}
    if isinstance(content, Mapping) and all(isinstance(value, list) for value in content.values()):
        longest = max(map(len, content.values()), default=0)
        return {
            str(name): [*value, *[None] * (longest - len(value))] for name, value in content.items()
        }
    raise StateError(
        f"{path}: this JSON is no trace",
        "give a list of numbers, a list of objects, an object of lists, or a saved profile",
    )


def _choose(path: Path, cells: Cells, columns: Sequence[str]) -> tuple[str, ...]:
    rows = max(map(len, cells.values()), default=0)
    for name in columns:
        if cells and name not in cells:
            raise UsageError(f'{path} has no column "{name}".{did_you_mean(name, cells)}')
    if rows < 2:
        held = "no latency" if rows == 0 else "one latency"
        raise StateError(f"{path} holds {held}", "give a trace of at least two; 2000 is good")
    if not columns and len(cells) > 1:
        raise UsageError(
            f"{path} has {len(cells)} columns: {', '.join(cells)}",
            "name the latency, or the parts that add up to it, with --column",
        )
    return tuple(dict.fromkeys(columns)) or tuple(cells)


def _unit_of(path: Path, name: str, unit: Unit | None) -> str:
    stated = next((known for known in UNITS if name.lower().endswith(f"_{known}")), None)
    if stated is None and unit is None:
        raise UsageError(
            f'{path}: the unit of column "{name}" is not stated',
            "give --unit ms or --unit s, or let the name end in _ms or _s",
        )
    if stated is not None and unit not in (None, stated):
        raise UsageError(
            f'{path}: column "{name}" says {stated}, but the unit given is {unit}',
            "leave --unit away, or rename the column",
        )
    return stated or str(unit)


def _numbers(path: Path, name: str, cells: Sequence[Any]) -> NDArray[np.float64]:
    values = np.empty(len(cells))
    for place, cell in enumerate(cells):
        value, wrong = _number(cell)
        if wrong:
            raise StateError(
                f'{path}: row {place + 1}, column "{name}": {wrong}', "mend or remove that row"
            )
        values[place] = value
    return values


def _number(cell: Any) -> tuple[float, str]:
    """Return a cell's number, and what is wrong with it."""
    if cell is None or cell == "":
        return math.nan, "there is no value"
    if isinstance(cell, bool) or not isinstance(cell, int | float | str):
        return math.nan, f"{json.dumps(cell, default=str)} is no number"
    try:
        value = float(cell)
    except (ValueError, OverflowError):
        return math.nan, f'"{cell}" is no number'
    if not math.isfinite(value):
        return value, f"{value} is not finite"
    return value, f"{value:g} is negative" if value < 0 else ""


def _check(total_ms: NDArray[np.float64], unit: str) -> tuple[str, ...]:
    """Return a warning where the numbers look as if they had another unit."""
    median = float(np.median(total_ms))
    if "ms" in unit and median < _TOO_SHORT_MS:
        return (
            f"The median is {median:.3g} ms. That looks like seconds read as milliseconds; "
            "if so, give --unit s.",
        )
    if median >= 1000 * _TOO_LONG_S:
        finer = "milliseconds read as seconds; if so, give --unit ms"
        if unit != "s":
            finer = "micro- or nanoseconds; if so, convert them"
        return (f"The median is {median / 1000:.3g} s. That looks like {finer}.",)
    return ()


def _add_fixed(trace: LatencyTrace, fixed_ms: FixedCosts) -> LatencyTrace:
    for name in fixed_ms:
        if name in trace.components_ms:
            raise UsageError(
                f'{trace.source}: "{name}" is a part of it already, so it would count twice',
                "leave it away from --fixed-ms, or give it another name",
            )
    if not fixed_ms:
        return trace
    added = {name: _per_row(name, cost, len(trace)) for name, cost in fixed_ms.items()}
    return replace(
        trace,
        total_ms=np.sum([trace.total_ms, *added.values()], axis=0),
        components_ms={**trace.components_ms, **added},
        source=f"{trace.source}, plus {say_costs(fixed_ms)}",
    )


def _per_row(name: str, cost: Cost, rows: int) -> NDArray[np.float64]:
    """One value per row; measured ones are drawn in blocks, by a generator of the cost's name."""
    if not isinstance(cost, Sequence):
        return np.full(rows, cost)
    values = np.array(cost)
    generator = np.random.default_rng([_COST_SEED, *name.encode()])
    return resample_blocks(LatencyTrace(values, {name: values}, name, "ms"), rows, generator)


def _plural(noun: str, names: Sequence[str]) -> str:
    return f"{noun}{'s' if len(names) > 1 else ''} {' + '.join(names)}"


# -- profiles --------------------------------------------------------------------------------


def _is_profile(content: Any) -> bool:
    rows = content.get("rows") if isinstance(content, Mapping) else None
    return bool(rows) and isinstance(rows, list) and _has_samples(rows[0])


def _has_samples(row: Any) -> bool:
    return isinstance(row, Mapping) and "samples_ms" in row and "sampler" in row


def _from_profile(
    path: Path, content: Any, wanted: Mapping[str, Any], unit: Unit | None
) -> LatencyTrace:
    if unit == "s":
        raise UsageError(f"{path} is a profile, whose samples are in ms", "leave --unit away")
    rows = [row for row in content["rows"] if _has_samples(row)]
    row = _choose_row(path, rows, wanted)
    name = f"{row['sampler']}_ms"
    samples = row["samples_ms"] if isinstance(row["samples_ms"], list) else []
    _choose(path, {name: samples}, ())
    values = _numbers(path, name, samples)
    settings = (f"{key} {row[key]}" for key in ("network", *_CHOICES) if key in row)
    machine = content.get("machine")
    trace = LatencyTrace(
        values,
        {str(row["sampler"]): values},
        f"{path}, profile of {', '.join(settings)}",
        "ms",
        kind="profile",
        machine=machine if isinstance(machine, Mapping) else None,
        flow_steps=row.get("flow_steps"),
    )
    return _add_fixed(trace, check_costs(row.get("fixed_ms") or {}, f"{path}, fixed_ms"))


def _choose_row(
    path: Path, rows: Sequence[Mapping[str, Any]], wanted: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the one row that fits; UsageError where none or several do."""
    left = list(rows)
    for key, value in wanted.items():
        held = list(dict.fromkeys(str(row.get(key)) for row in left))
        left = [row for row in left if row.get(key) == value]
        if not left:
            raise UsageError(
                f'{path}: the profile has no {key} "{value}".{did_you_mean(str(value), held)}'
            )
    if len(left) == 1:
        return left[0]
    for key in _CHOICES:
        held = list(dict.fromkeys(str(row.get(key)) for row in left))
        if len(held) > 1:
            word = key.replace("_", "-")
            raise UsageError(
                f"{path}: the profile has more than one {word}: {', '.join(held)}",
                f"choose with --{word}",
            )
    raise UsageError(
        f"{path}: {len(left)} rows of the profile are alike in {', '.join(_CHOICES)}",
        "save a profile of one network and horizon",
    )
