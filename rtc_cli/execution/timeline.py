"""Which chunk, and which of its actions, acts at every control tick.

One cycle, for execution horizon s and delay d, in control ticks:

.. code-block:: text

    async  tick       t          t+d              t+s                t+s+d
           inference  |--- d ---|                 |--- d ---|
           executed   old[0:d]   new[d:s]          new[s:s+d] ...

    sync   tick       t          t+d                    t+d+s
           inference  |--- d ---|                       |--- d ---|
           executed   hold x d   new[0:s]                hold x d ...

    oracle tick       t          t+d              t+s                t+s+d
           inference  |--- d ---|                 |--- d ---|
           executed   old[0:d]   new[0:s-d]        new[s-d:s] ...

``old[0:d]`` stands for ``overlap[0:d]``: the overlap is the unexecuted rest of the running chunk,
aligned so that ``overlap[0]`` is the action due at tick t. An episode starts with one chunk free
of charge, ``first``. Under ``async`` the first inference starts at tick 0 too, from the same
observation, and its overlap is ``first[0:H-s]``; under ``sync`` ``first[0:s]`` is executed and
the first inference starts at tick s. Under ``oracle`` the policy is shown the state that is
predicted for tick t+d, so that its token j acts at t+d+j.

Chunks are numbered: 0 is ``first``, k is the k-th inference. Plain Python and NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from rtc_cli.errors import UsageError, did_you_mean

Schedule = Literal["async", "sync", "oracle"]
SCHEDULES: tuple[str, ...] = get_args(Schedule)

HOLD = -1
"""Chunk number and index of a tick at which no chunk acts and the robot holds still."""

FIRST_CHUNK_TICK = -1
"""Tick that stands for the start of inference of ``first`` where noise is keyed by ticks."""


class Cycle(NamedTuple):
    """One cycle of a schedule, in control ticks relative to the start of its inference."""

    ticks: int
    """From one start of inference to the next."""
    hold: int
    """Ticks at the start of the cycle without any action to execute."""
    overlap_stop: int
    """``overlap[0:overlap_stop]`` is executed next."""
    new_start: int
    new_stop: int
    """Then ``new[new_start:new_stop]``."""


class Window(NamedTuple):
    """One inference: its chunk's number, the tick it starts at and the tick it is usable at."""

    chunk: int
    start: int
    ready: int


@dataclass(frozen=True)
class Timeline:
    """What happens in the first ``ticks`` control ticks of an episode.

    Attributes:
        chunk: (ticks,) number of the acting chunk; 0 is ``first``, ``HOLD`` is a hold action.
        index: (ticks,) index of the acting action in its chunk, ``HOLD`` for a hold action.
        inferences: the inferences that start within these ticks, in order; ``first`` is free and
            is not one of them.
    """

    horizon: int
    exec_horizon: int
    delay: int
    schedule: str
    chunk: NDArray[np.int64]
    index: NDArray[np.int64]
    inferences: tuple[Window, ...]

    @property
    def observed_at(self) -> NDArray[np.int64]:
        """(ticks,) tick of the observation behind each action; -1 for a hold action."""
        starts = np.array([0, *(window.start for window in self.inferences)], dtype=np.int64)
        return np.where(self.chunk == HOLD, -1, starts[np.maximum(self.chunk, 0)])

    @property
    def handovers(self) -> NDArray[np.int64]:
        """Ticks (from 1 on) at which a chunk acts for the first time."""
        order = np.maximum.accumulate(self.chunk)
        return np.flatnonzero((order[1:] > order[:-1]) & (self.chunk[1:] != HOLD)) + 1


def check_schedule(schedule: str) -> None:
    """Raise UsageError unless ``schedule`` is one of SCHEDULES."""
    if schedule not in SCHEDULES:
        raise UsageError(f'unknown schedule "{schedule}".{did_you_mean(schedule, SCHEDULES)}')


def cycle(exec_horizon: int, delay: int, schedule: str = "async") -> Cycle:
    """The cycle of a legal (s, d) under a schedule."""
    check_schedule(schedule)
    if schedule == "sync":
        return Cycle(exec_horizon + delay, delay, 0, 0, exec_horizon)
    if schedule == "oracle":
        return Cycle(exec_horizon, 0, delay, 0, exec_horizon - delay)
    return Cycle(exec_horizon, 0, delay, delay, exec_horizon)


def first_inference(exec_horizon: int, schedule: str = "async") -> int:
    """Tick at which the first inference starts (``first`` itself is free)."""
    check_schedule(schedule)
    return exec_horizon if schedule == "sync" else 0


def timeline(
    *, horizon: int, exec_horizon: int, delay: int, ticks: int, schedule: str = "async"
) -> Timeline:
    """Lay out an episode of ``ticks`` control ticks for a legal (H, s, d).

    The geometry is taken as it is: ``ChunkGeometry`` is where it is validated.
    """
    plan = cycle(exec_horizon, delay, schedule)
    start = first_inference(exec_horizon, schedule)
    chunks, indices = [0] * start, list(range(start))
    windows: list[Window] = []
    # Action overlap[0] of the running chunk: where the chunk before this cycle had got to.
    running, due = 0, start
    while len(chunks) < ticks:
        number = len(windows) + 1
        windows.append(Window(number, len(chunks), len(chunks) + delay))
        chunks += [HOLD] * plan.hold + [running] * plan.overlap_stop
        indices += [HOLD] * plan.hold + [due + i for i in range(plan.overlap_stop)]
        chunks += [number] * (plan.new_stop - plan.new_start)
        indices += range(plan.new_start, plan.new_stop)
        running, due = number, plan.new_stop
    return Timeline(
        horizon=horizon,
        exec_horizon=exec_horizon,
        delay=delay,
        schedule=schedule,
        chunk=np.array(chunks[:ticks], dtype=np.int64),
        index=np.array(indices[:ticks], dtype=np.int64),
        inferences=tuple(windows),
    )


def reaction_ticks(plan: Cycle, first: int, delay: int, ticks: int) -> NDArray[np.int64]:
    """(ticks,) ticks from an event to the first action that could depend on it.

    Entry e is for an event that the observation of tick e is the first to show: the wait for the
    next start of inference, plus the delay. ``first`` is the tick of the first inference; entry 0
    is 0, because ``first`` is computed from that observation and acts at once.
    """
    event = np.arange(ticks, dtype=np.int64)
    wait = np.where(event <= first, first - event, (first - event) % plan.ticks)
    return np.where(event == 0, 0, wait + delay)
