"""Delays drawn from a measured latency trace, in blocks, so that bursts stay.

``trace:FILE@HZ`` reads a trace (``rtc_cli.traces``: CSV, JSON or parquet, one column of ms or s)
and turns its latencies into control steps at a control rate, rounding up;
``trace:FILE@HZ,skip=15`` leaves out its first 15 rows, a warm-up for example, and
``trace:FILE@HZ,rounding=nearest`` rounds otherwise. Every episode starts somewhere else in the
trace. FILE ends at the last "@", so it may hold any character.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtc_cli.errors import UsageError
from rtc_cli.traces import LatencyTrace, default_block, read_trace, resample_blocks, to_delays
from rtc_cli.units import ROUNDINGS, Rounding

IntArray = NDArray[np.int64]

EXAMPLE = "trace:latencies.csv@50"

_OPTIONS = re.compile(
    r"(?P<hz>\d+(\.\d*)?)(,skip=(?P<skip>\d{1,9}))?"
    rf"(,rounding=(?P<rounding>{'|'.join(ROUNDINGS)}))?",
    flags=re.ASCII,
)


@dataclass(frozen=True)
class TraceDelays:
    """The delay model of a trace; equal if text, file content and cap are.

    ``text`` has the file's name and the beginning of its latencies' digest: another trace under
    the same name is another model. ``block`` is the mean length of what is drawn in one piece, in
    rows.
    """

    text: str
    content: str
    hz: float
    rounding: Rounding
    cap: int
    block: float = field(compare=False)
    trace: LatencyTrace = field(compare=False, repr=False)

    @property
    def mean(self) -> float:
        """Mean delay of the trace."""
        return float(self._delays.mean())

    @property
    def largest(self) -> int:
        """Longest delay of the trace."""
        return int(self._delays.max())

    @cached_property
    def _delays(self) -> IntArray:
        return np.minimum(to_delays(self.trace.total_ms, self.hz, self.rounding), self.cap)

    def capped(self, cap: int) -> TraceDelays:
        """The same with every delay above ``cap`` replaced by it."""
        if self.largest <= cap:
            return self
        return replace(
            self, text=f"{self.text} cap {cap}", content=f"{self.content} cap {cap}", cap=cap
        )

    def sequence(self, generator: np.random.Generator, count: int) -> IntArray:
        """(count,) delays of the inferences of one episode, in order."""
        latencies = resample_blocks(self.trace, count, generator, self.block)
        return np.minimum(to_delays(latencies, self.hz, self.rounding), self.cap)


def trace_model(file: Path, hz: float, rounding: Rounding = "ceil") -> str:
    """Return the text that reads as the delays of a file's latencies at a control rate."""
    rate = np.format_float_positional(hz, trim="-")
    return f"trace:{file}@{rate}" + ("" if rounding == "ceil" else f",rounding={rounding}")


def digest(trace: LatencyTrace) -> str:
    """Return what tells the latencies of two traces apart, 16 hexadecimal digits."""
    return hashlib.sha256(trace.total_ms.tobytes()).hexdigest()[:16]


def read_trace_delays(text: str, rest: str) -> TraceDelays:
    """Read what stands after ``trace:``; UsageError or StateError otherwise."""
    path, at, options = rest.rpartition("@")
    match = _OPTIONS.fullmatch(options.strip())
    if not at or not path or match is None or float(match["hz"]) <= 0:
        raise UsageError(
            f'delay model "{text}": "{rest}" is no file with a control rate in Hz, and options '
            "that exist",
            f'write it like "{EXAMPLE}", or "{EXAMPLE},skip=15" without the first 15 rows, or '
            f'"{EXAMPLE},rounding=nearest" (one of {", ".join(ROUNDINGS)})',
        )
    file = Path(path)
    changed = file.stat().st_mtime_ns if file.is_file() else 0
    skip, rounding = int(match["skip"] or 0), match["rounding"] or "ceil"
    return _read(text.strip(), file, float(match["hz"]), skip, rounding, changed)


@lru_cache(maxsize=16)
def _read(
    text: str, file: Path, hz: float, skip: int, rounding: Rounding, changed: int
) -> TraceDelays:
    whole = read_trace(file)
    if len(whole) - skip < 2:
        raise UsageError(
            f'delay model "{text}": {file} has {len(whole)} rows, {skip} are to be left out',
            "leave at least 2",
        )
    trace = whole.after(skip)
    content = digest(trace)
    # A name may hold what means something in a table, parentheses for example.
    name = re.sub(r"[^\w.+-]+", "_", file.name)
    rate = f"{hz:g}" if rounding == "ceil" else f"{hz:g},{rounding}"
    return TraceDelays(
        text=f"trace:{name}@{rate} #{content[:6]}",
        content=f"trace:{content}@{rate}",
        hz=hz,
        rounding=rounding,
        cap=np.iinfo(np.int64).max,
        block=default_block(trace),
        trace=trace,
    )
