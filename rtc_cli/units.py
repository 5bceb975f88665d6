"""Milliseconds to control steps, and the text forms of numbers and of lists of delays."""

import math
import re
from typing import Literal, get_args

from rtc_cli.errors import UsageError, did_you_mean

Rounding = Literal["ceil", "floor", "nearest"]
ROUNDINGS: tuple[str, ...] = get_args(Rounding)

# A latency measured as exactly n periods must not become n + 1 through the last bits of a product.
_RELATIVE_SLACK = 1e-9


def latency_to_delay(latency_ms: float, hz: float, rounding: Rounding = "ceil") -> int:
    """Return the delay, in control steps, that a latency means at a control rate.

    `latency_ms` runs from the observation's time stamp to "chunk usable". `ceil` is right where
    a chunk's index 0 is due at the tick of its observation (this project); `floor` where it is
    due one tick later; `nearest` (halves go up) reproduces the paper's 108 ms -> 5 and
    135 ms -> 7 at 50 Hz.
    """
    if not math.isfinite(latency_ms) or latency_ms < 0:
        raise UsageError(f"latency {latency_ms} ms is not possible", "give a number >= 0")
    if not math.isfinite(hz) or hz <= 0:
        raise UsageError(f"control rate {hz} Hz is not possible", "give a number > 0")
    if rounding not in ROUNDINGS:
        raise UsageError(f'unknown rounding "{rounding}".{did_you_mean(rounding, ROUNDINGS)}')
    steps = latency_ms * hz / 1000.0
    slack = _RELATIVE_SLACK * max(1.0, steps)
    if rounding == "ceil":
        return max(0, math.ceil(steps - slack))
    if rounding == "floor":
        return math.floor(steps + slack)
    return math.floor(steps + 0.5 + slack)


def three_digits(value: float) -> str:
    """Three digits, or all before the point: never an exponent for large numbers."""
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def parse_delays(text: str, what: str = "delays") -> tuple[int, ...]:
    """Parse comma-separated integers and inclusive ranges ("0,2-4") into increasing integers.

    `what` they are is said in messages.
    """
    hint = 'write comma-separated integers and inclusive ranges, as in "0,2-4"'
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?", part, flags=re.ASCII)
        if match is None:
            raise UsageError(f'cannot read {what} "{text}": "{part}" is no integer or range', hint)
        low = int(match[1])
        high = int(match[2]) if match[2] is not None else low
        if high < low:
            raise UsageError(
                f'cannot read {what} "{text}": the range "{part.strip()}" runs backwards',
                f'write the smaller end first, as in "{high}-{low}"',
            )
        if high - low > 10_000:
            raise UsageError(f'the range "{part.strip()}" holds over 10000 {what}', hint)
        found.update(range(low, high + 1))
    return tuple(sorted(found))
