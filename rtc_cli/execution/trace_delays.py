"""Delays drawn from a measured latency trace, in blocks, so that bursts stay.

``trace:FILE@HZ`` reads a trace (``rtc_cli.traces``: CSV, JSON or parquet, one column of ms or s)
and turns its latencies into control steps at a control rate, rounding up;
``trace:FILE@HZ,skip=15`` leaves out its first 15 rows, a warm-up for example. Every episode starts
somewhere else in the trace.
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

IntArray = NDArray[np.int64]

EXAMPLE = "trace:latencies.csv@50"


@dataclass(frozen=True)
class TraceDelays:
    """The delay model of a trace; equal if text, file content and cap are.

    ``block`` is the mean length of what is drawn in one piece, in rows.
    """

    text: str
    content: str
    hz: float
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
        return np.minimum(to_delays(self.trace.total_ms, self.hz), self.cap)

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
        return np.minimum(to_delays(latencies, self.hz), self.cap)


def read_trace_delays(text: str, rest: str) -> TraceDelays:
    """Read what stands after ``trace:``; UsageError or StateError otherwise."""
    path, at, options = rest.rpartition("@")
    match = re.fullmatch(r"(\d+(?:\.\d*)?)(?:,skip=(\d{1,9}))?", options.strip(), flags=re.ASCII)
    if not at or not path or match is None or float(match[1]) <= 0:
        raise UsageError(
            f'delay model "{text}": "{rest}" is no file with a control rate in Hz',
            f'write it like "{EXAMPLE}", or "{EXAMPLE},skip=15" without the first 15 rows',
        )
    file = Path(path)
    changed = file.stat().st_mtime_ns if file.is_file() else 0
    return _read(text.strip(), file, float(match[1]), int(match[2] or 0), changed)


@lru_cache(maxsize=16)
def _read(text: str, file: Path, hz: float, skip: int, changed: int) -> TraceDelays:
    whole = read_trace(file)
    if len(whole) - skip < 2:
        raise UsageError(
            f'delay model "{text}": {file} has {len(whole)} rows, {skip} are to be left out',
            "leave at least 2",
        )
    trace = whole.after(skip)
    digest = hashlib.sha256(trace.total_ms.tobytes()).hexdigest()[:16]
    return TraceDelays(
        text=text,
        content=f"trace:{digest}@{hz:g}",
        hz=hz,
        cap=np.iinfo(np.int64).max,
        block=default_block(trace),
        trace=trace,
    )
