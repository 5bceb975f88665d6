"""Alternated timing: every candidate once per round, so that a busy machine disturbs all alike."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

Candidates = dict[str, Callable[[], Any]]


def measure(candidates: Candidates, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of every call, warm and device-synchronised; round by round."""
    samples: dict[str, list[float]] = {name: [] for name in candidates}
    for call in candidates.values():
        jax.block_until_ready(call())
        jax.block_until_ready(call())
    names = list(candidates)
    for index in range(rounds):
        # Every other round runs backwards: no candidate always follows the same one.
        for name in names if index % 2 else reversed(names):
            start = time.perf_counter()
            jax.block_until_ready(candidates[name]())
            samples[name].append(1e3 * (time.perf_counter() - start))
    return samples


def ratio(samples: dict[str, list[float]], slow: str, fast: str) -> float:
    """Median over rounds of time(slow) / time(fast), paired within the round."""
    pairs = zip(samples[slow], samples[fast], strict=True)
    return statistics.median(a / b for a, b in pairs)


def show_medians(samples: dict[str, list[float]]) -> None:
    for name, values in samples.items():
        print(f"  {name:28s} {statistics.median(values):9.2f} ms  (best {min(values):.2f})")


def show_ratio(
    samples: dict[str, list[float]], slow: str, fast: str, target: float, *, at_most: bool = False
) -> None:
    """Print one ratio and whether it meets its target (a factor to reach, or not to exceed)."""
    value = ratio(samples, slow, fast)
    met = value <= target if at_most else value >= target
    rule = "at most" if at_most else "at least"
    print(f"  {slow} / {fast}: {value:.2f}  ({rule} {target}: {'met' if met else 'NOT MET'})")
