"""The delay that a sampler is told, from the delays that went before.

==================  ===============================================================================
``exact``           the delay that will happen; no deployed system has it
``max-of-last:10``  the longest of the last 10 (RTC's Algorithm 1, arXiv 2506.07339)
``percentile:0.95`` the smallest of the episode's delays so far that 95% of them do not exceed
``constant:3``      always 3
==================  ===============================================================================

Before an episode's first chunk has arrived, ``max-of-last`` and ``percentile`` give the model's
mean delay, in whole steps: somebody who deploys a policy has timed it before.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtc_cli.errors import UsageError, did_you_mean

IntArray = NDArray[np.int64]

KINDS = ("exact", "max-of-last", "percentile", "constant")

_EXAMPLES = {
    "max-of-last": ("a whole number above 0", "max-of-last:10"),
    "percentile": ("a share above 0 and up to 1", "percentile:0.95"),
    "constant": ("a whole number of control steps", "constant:3"),
}
_SLACK = 1e-9  # 0.7 * 10 must not count as more than 7


@dataclass(frozen=True)
class Estimator:
    """A rule for the conditioned delay; ``value`` is what stands after the colon."""

    kind: str
    value: float = 0.0

    @property
    def text(self) -> str:
        """How it is written and shown."""
        if self.kind == "exact":
            return self.kind
        return f"{self.kind}:{np.format_float_positional(self.value, trim='-')}"

    def estimates(self, delays: IntArray, before: int) -> IntArray:
        """(n, C) what is told for each of C inferences of n episodes.

        Args:
            delays: (n, C) what happens, in control steps; entry k is known only to ``exact``
                when inference k starts, those before it to all.
            before: what is told while no chunk has arrived yet.
        """
        if self.kind == "exact":
            return delays.copy()
        if self.kind == "constant":
            return np.full_like(delays, int(self.value))
        known = delays[:, :-1]
        later = self._max_of_last(known) if self.kind == "max-of-last" else self._percentile(known)
        return np.concatenate([np.full_like(delays[:, :1], before), later], axis=1)

    def _max_of_last(self, delays: IntArray) -> IntArray:
        """(n, m) -> (n, m): entry k is the maximum of entries k - b + 1 to k."""
        window = min(int(self.value), max(delays.shape[1], 1))
        longest = delays.copy()
        for back in range(1, window):
            longest[:, back:] = np.maximum(longest[:, back:], delays[:, : delays.shape[1] - back])
        return longest

    def _percentile(self, delays: IntArray) -> IntArray:
        """(n, m) -> (n, m): entry k is the percentile (nearest rank) of entries 0 to k."""
        needed = np.ceil(self.value * np.arange(1, delays.shape[1] + 1) - _SLACK)
        found = np.zeros_like(delays)
        for delay in np.unique(delays)[::-1].tolist():
            enough = np.cumsum(delays <= delay, axis=1) >= needed
            found[enough] = delay
        return found


EXACT = Estimator("exact")


def read_estimator(text: str) -> Estimator:
    """Read an estimator; UsageError that names the text and what is allowed otherwise."""
    kind, colon, rest = text.strip().partition(":")
    if kind == "exact" and not colon:
        return EXACT
    if kind not in _EXAMPLES:
        raise UsageError(
            f'unknown estimator "{text}".{did_you_mean(kind, KINDS)}',
            "write exact, max-of-last:10, percentile:0.95 or constant:3",
        )
    whole = kind != "percentile"
    pattern = r"\d{1,4}" if whole else r"\d+(\.\d*)?|\.\d+"
    value = float(rest) if re.fullmatch(pattern, rest, flags=re.ASCII) else -1.0
    allowed = {"max-of-last": value >= 1, "percentile": 0 < value <= 1, "constant": value >= 0}
    if not allowed[kind]:
        rule, example = _EXAMPLES[kind]
        raise UsageError(f'estimator "{text}": "{rest}" is not {rule}', f'write "{example}"')
    return Estimator(kind, value)
