"""Delays that vary from one inference to the next: models of them, and how they are written.

=============================================  ==================================================
``constant:2``                                 always 2 control steps
``uniform:0-4``                                each of these alike; lists too: ``uniform:0,2-4``
``poisson:1.5``                                Poisson with this mean
``mixture:0.9*constant:1+0.1*uniform:3-6``     each inference draws one of the parts; the weights
                                               sum to 1
``trace:latencies.csv@50``                     a measured trace at 50 Hz, resampled in blocks; see
                                               ``rtc_cli.execution.trace_delays``
=============================================  ==================================================

A tail cap replaces every longer delay by the cap.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.execution.trace_delays import EXAMPLE, read_trace_delays
from rtc_cli.units import parse_delays

IntArray = NDArray[np.int64]

LONGEST = 10_000
"""Longest delay that a model may be asked for, in control steps."""

_LARGEST_RATE = 1000.0
_NEGLIGIBLE = 1e-16
_SUM_SLACK = 1e-6  # of a mixture's weights


class DelayModel(Protocol):
    """The delays of an episode's inferences, in control steps."""

    @property
    def text(self) -> str:
        """How it is written and shown, the cap included where it cuts something off."""

    @property
    def content(self) -> str:
        """What a result's key holds: equal contents make equal delays."""

    @property
    def mean(self) -> float:
        """Mean delay."""

    @property
    def largest(self) -> int:
        """Longest delay that can occur."""

    def capped(self, cap: int) -> DelayModel:
        """The same with every delay above ``cap`` replaced by it."""

    def sequence(self, generator: np.random.Generator, count: int) -> IntArray:
        """(count,) delays of the inferences of one episode, in order."""


@dataclass(frozen=True)
class Independent:
    """Delays drawn independently: ``weights[d]`` is P(d); the last one is above 0."""

    text: str
    weights: tuple[float, ...]

    @property
    def content(self) -> str:
        """The text says it all."""
        return self.text

    @property
    def mean(self) -> float:
        """Mean delay."""
        return math.fsum(d * weight for d, weight in enumerate(self.weights))

    @property
    def largest(self) -> int:
        """Longest delay that can occur."""
        return len(self.weights) - 1

    def capped(self, cap: int) -> Independent:
        """The same with every delay above ``cap`` replaced by it."""
        if self.largest <= cap:
            return self
        kept = self.weights[:cap]
        return Independent(f"{self.text} cap {cap}", (*kept, math.fsum(self.weights[cap:])))

    def sequence(self, generator: np.random.Generator, count: int) -> IntArray:
        """(count,) delays, one uniform number each: models that share them move together."""
        cumulative = np.cumsum(self.weights)[:-1]
        return np.searchsorted(cumulative, generator.random(count), side="right").astype(np.int64)


def constant(delay: int) -> Independent:
    """The model that is always ``delay``."""
    return Independent(f"constant:{delay}", (*(0.0,) * delay, 1.0))


def nominal_delay(model: DelayModel) -> int:
    """The mean as whole control steps, halves up: what a cell with this model is filed under."""
    return math.floor(round(model.mean, 2) + 0.5)


def read_delay_model(text: str) -> DelayModel:
    """Read a model; UsageError that names the text and what is allowed otherwise."""
    kind, _, rest = text.strip().partition(":")
    reader = _READERS.get(kind.strip())
    if reader is None:
        raise UsageError(
            f'unknown delay model "{text}".{did_you_mean(kind, FORMS)}', f"write {FORMS_TEXT}"
        )
    return reader(text, rest.strip())


def _constant(text: str, rest: str) -> Independent:
    if not re.fullmatch(r"\d{1,6}", rest, flags=re.ASCII):
        raise _error(text, f'"{rest}" is no whole number of control steps', "constant:2")
    return constant(_checked(text, int(rest)))


def _uniform(text: str, rest: str) -> Independent:
    try:
        delays = parse_delays(rest)
    except UsageError:
        raise _error(text, f'"{rest}" is no list of control steps', "uniform:0-4") from None
    weights = [0.0] * (_checked(text, delays[-1]) + 1)
    for delay in delays:
        weights[delay] = 1.0 / len(delays)
    return Independent(f"uniform:{_ranges(delays)}", tuple(weights))


def _poisson(text: str, rest: str) -> Independent:
    rate = _number(rest)
    if rate is None or not 0 < rate <= _LARGEST_RATE:
        rule = f'"{rest}" is no mean above 0 and up to {_LARGEST_RATE:g} control steps'
        raise _error(text, rule, "poisson:1.5")
    weights: list[float] = []
    while len(weights) <= rate or weights[-1] > _NEGLIGIBLE:
        d = len(weights)
        weights.append(math.exp(d * math.log(rate) - rate - math.lgamma(d + 1)))
    total = math.fsum(weights)
    return Independent(f"poisson:{_shown(rate)}", tuple(weight / total for weight in weights))


def _mixture(text: str, rest: str) -> Independent:
    parts = [_part(text, part) for part in rest.split("+")]
    total = math.fsum(weight for weight, _ in parts)
    if abs(total - 1.0) > _SUM_SLACK:
        raise _error(text, f"the weights sum to {total:g}, not to 1", _MIXTURE)
    longest = max(len(model.weights) for _, model in parts)
    weights = np.zeros(longest)
    for weight, model in parts:
        weights[: len(model.weights)] += weight / total * np.array(model.weights)
    shown = "+".join(f"{_shown(weight)}*{model.text}" for weight, model in parts)
    return Independent(f"mixture:{shown}", tuple(weights.tolist()))


def _part(text: str, part: str) -> tuple[float, Independent]:
    number, star, spec = part.partition("*")
    weight = _number(number.strip())
    if not star or weight is None or not 0 < weight <= 1:
        raise _error(text, f'"{part.strip()}" is no weight above 0 times a model', _MIXTURE)
    kind = spec.strip().partition(":")[0].strip()
    if kind not in _PARTS:
        raise _error(text, f'a part may be {", ".join(_PARTS)}, not "{spec.strip()}"', _MIXTURE)
    return weight, _PARTS[kind](text, spec.strip().partition(":")[2].strip())


def _number(text: str) -> float | None:
    return float(text) if re.fullmatch(r"\d+(\.\d*)?|\.\d+", text, flags=re.ASCII) else None


def _shown(value: float) -> str:
    """The shortest text that reads back as this number."""
    return np.format_float_positional(value, trim="-")


def _checked(text: str, delay: int) -> int:
    if delay > LONGEST:
        raise _error(text, f"{delay} is above {LONGEST} control steps", "uniform:0-4")
    return delay


def _error(text: str, why: str, example: str) -> UsageError:
    return UsageError(f'delay model "{text}": {why}', f'write it like "{example}"')


def _ranges(values: Sequence[int]) -> str:
    """Increasing integers as text, "0,2-4"."""
    runs: list[str] = []
    for _, run in itertools.groupby(enumerate(values), key=lambda pair: pair[1] - pair[0]):
        members = [value for _, value in run]
        few = len(members) == 1
        runs.append(f"{members[0]}" if few else f"{members[0]}-{members[-1]}")
    return ",".join(runs)


_MIXTURE = "mixture:0.9*constant:1+0.1*uniform:3-6"

_PARTS: dict[str, Callable[[str, str], Independent]] = {
    "constant": _constant,
    "uniform": _uniform,
    "poisson": _poisson,
}

# Each takes the whole text, for messages, and what follows the kind.
_READERS: dict[str, Callable[[str, str], DelayModel]] = {
    **_PARTS,
    "mixture": _mixture,
    "trace": read_trace_delays,
}

FORMS = tuple(_READERS)
FORMS_TEXT = f"constant:2, uniform:0-4, poisson:1.5, {_MIXTURE} or {EXAMPLE}"
"""How a model is written, for messages and help texts."""
