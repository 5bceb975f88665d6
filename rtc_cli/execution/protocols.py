"""Protocols: which execution horizon s goes with which delay d.

``paper``
    s = max(d, 1). It changes s together with d, so the mean age of the observation behind an
    action, d + (s - 1)/2, grows with both.
``fixed:S``
    one s for all delays.
``grid``
    every legal s for each delay.

A fourth label is given by ``open_loop_cells`` only: ``open-loop``, execution without delay.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.errors import UsageError, did_you_mean

PROTOCOLS = ("paper", "fixed:S", "grid")

OPEN_LOOP = "open-loop"
"""Label of the cells at d = 0 that tell what executing s steps open loop costs by itself."""


def protocol_cells(protocol: str, horizon: int, delays: Iterable[int]) -> tuple[ChunkGeometry, ...]:
    """All cells of a protocol, every one validated before any is returned.

    Raises:
        UsageError: for an unknown protocol, or a cell that is not legal at this horizon.
    """
    delays = tuple(delays)
    if protocol == "paper":
        _check_paper(horizon, delays)
        pairs = [(max(delay, 1), delay) for delay in delays]
    elif protocol == "grid":
        pairs = [pair for delay in delays for pair in _legal(horizon, delay)]
    else:
        exec_horizon = _fixed(protocol)
        pairs = [(exec_horizon, delay) for delay in delays]
    return tuple(_cell(protocol, horizon, exec_horizon, delay) for exec_horizon, delay in pairs)


def open_loop_cells(cells: Sequence[ChunkGeometry]) -> tuple[ChunkGeometry, ...]:
    """Cells at d = 0, for s = 1 and every execution horizon of these cells."""
    horizon = cells[0].horizon
    steps = sorted({1, *(int(cell.exec_horizon) for cell in cells)})
    return tuple(ChunkGeometry(horizon=horizon, exec_horizon=s, delay=0) for s in steps)


def _check_paper(horizon: int, delays: tuple[int, ...]) -> None:
    longest = max(delays, default=0)
    if longest > horizon // 2:
        raise UsageError(
            f'protocol "paper", delay {longest}: s = d and d <= H - s allow delays 0 to '
            f"{horizon // 2} at horizon {horizon}",
            f"use delays up to {horizon // 2}",
        )


def _legal(horizon: int, delay: int) -> list[tuple[int, int]]:
    legal = range(max(delay, 1), horizon - delay + 1)
    if delay < 0 or not legal:
        raise UsageError(
            f"delay {delay} has no legal execution horizon at horizon {horizon}: "
            "s must satisfy max(d, 1) <= s <= H - d",
            f"use delays 0 to {horizon // 2}",
        )
    return [(exec_horizon, delay) for exec_horizon in legal]


def _fixed(protocol: str) -> int:
    kind, _, value = protocol.partition(":")
    if kind != "fixed":
        raise UsageError(f'unknown protocol "{protocol}".{did_you_mean(protocol, PROTOCOLS)}')
    if not value.isdecimal():
        raise UsageError(
            f'protocol "{protocol}" needs an execution horizon in control steps',
            'write it like "fixed:4"',
        )
    return int(value)


def _cell(protocol: str, horizon: int, exec_horizon: int, delay: int) -> ChunkGeometry:
    try:
        return ChunkGeometry(horizon=horizon, exec_horizon=exec_horizon, delay=delay)
    except UsageError as error:
        raise UsageError(f'protocol "{protocol}", delay {delay}: {error}', error.hint) from error
