"""One episode's timeline, tick by tick in plain Python, from the words of the definition.

Independent of ``rtc_cli.execution.timing``: it knows nothing but delays and keeps its own history.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

HOLD = -1


@dataclass
class Slow:
    """What happened: per tick, per request and per arrival."""

    acting: list[tuple[int, int]] = field(default_factory=list)  # (chunk, index) of each tick
    requests: list[tuple[int, int, int, int]] = field(default_factory=list)
    """(tick, realised s, d_cond, actions left)"""
    late: list[int] = field(default_factory=list)  # ticks of arrival
    dropped: list[int] = field(default_factory=list)
    clipped: list[int] = field(default_factory=list)  # ticks of the request
    exceeded: list[int] = field(default_factory=list)
    answers: list[tuple[int, int]] = field(default_factory=list)  # (request, arrival) of kept ones


def estimate(text: str, seen: list[int], happens: int, before: int) -> int:
    """What the sampler is told before the geometry has its say."""
    kind, _, value = text.partition(":")
    if kind == "exact":
        return happens
    if kind == "constant":
        return int(value)
    if not seen:
        return before
    if kind == "max-of-last":
        return max(seen[-int(value) :])
    rank = max(math.ceil(round(float(value) * len(seen), 6)), 1)
    return sorted(seen)[rank - 1]


def slow_async(
    delays: list[int],
    *,
    horizon: int,
    s: int,
    ticks: int,
    estimator: str = "exact",
    before: int = 0,
    discard: bool = False,
    trained: int | None = None,
    clamp: bool = False,
) -> Slow:
    """An episode of the schedule ``async``."""
    slow = Slow()
    running, due = 0, 0  # the running chunk, and the tick at which its index 0 was due
    flight: tuple[int, int, int, int] | None = None  # chunk, start, delay, told
    next_start, seen, waiting = 0, [], list(delays)
    for tick in range(ticks):
        while True:
            if flight is not None and flight[1] + flight[2] == tick:
                chunk, start, delay, told = flight
                flight = None
                seen.append(delay)
                if delay > told:
                    slow.late.append(tick)
                if delay >= horizon or (discard and delay > told):
                    slow.dropped.append(tick)
                else:
                    running, due = chunk, start
                    slow.answers.append((start, tick))
            if flight is None and tick == next_start:
                delay = waiting.pop(0)
                realised = s if not slow.requests else min(tick - due, horizon)
                wanted = estimate(estimator, seen, delay, before)
                told = min(wanted, realised, horizon - realised)
                if told < wanted:
                    slow.clipped.append(tick)
                if trained is not None and told > trained:
                    slow.exceeded.append(tick)
                    told = trained if clamp else told
                left = max(horizon - (tick - due), 0)
                slow.requests.append((tick, realised, told, left))
                flight = (len(slow.requests), tick, delay, told)
                next_start = tick + max(s, delay)
                if delay == 0:
                    continue
            break
        index = tick - due
        slow.acting.append((running, index) if index < horizon else (HOLD, HOLD))
    return slow


def slow_sync(delays: list[int], *, s: int, ticks: int) -> list[tuple[int, int]]:
    """(chunk, index) of each tick under the schedule ``sync``."""
    acting = [(0, i) for i in range(s)]
    for number, delay in enumerate(delays, start=1):
        acting += [(HOLD, HOLD)] * delay + [(number, i) for i in range(s)]
    return acting[:ticks]


def slow_oracle(delays: list[int], *, horizon: int, s: int, ticks: int) -> list[tuple[int, int]]:
    """(chunk, index) of each tick under the schedule ``oracle``: token j acts at t + d + j."""
    arrivals, start = [0], 0
    for delay in delays:
        arrivals.append(start + delay)
        start += max(s, delay)
    acting = []
    for tick in range(ticks):
        chunk = max(k for k, arrival in enumerate(arrivals) if arrival <= tick)
        index = tick - arrivals[chunk]
        acting.append((chunk, index) if index < horizon else (HOLD, HOLD))
    return acting
