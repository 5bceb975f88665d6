"""Delay distributions: one concept for training (which prefixes) and evaluation (which delays)."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from rtc_cli.errors import UsageError


@dataclass(frozen=True)
class DelayDistribution:
    """P(d) on a written-out support of delays in control steps.

    `support` is strictly increasing and contains 0 (the start of an episode has no previous
    chunk); `weights` are non-negative, one per delay, and kept normalised to sum 1. Hashable, so
    usable as a static argument of `jax.jit`. Raises UsageError for anything else.
    """

    support: tuple[int, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_support(self.support)
        _check_weights(self.support, self.weights)
        total = math.fsum(self.weights)
        object.__setattr__(self, "support", tuple(int(d) for d in self.support))
        object.__setattr__(self, "weights", tuple(float(w) / total for w in self.weights))

    @classmethod
    def uniform(cls, support: Sequence[int]) -> "DelayDistribution":
        """Every delay of the support alike."""
        return cls(tuple(support), (1.0,) * len(support))

    @classmethod
    def exponential(cls, support: Sequence[int], rate: float = 1.0) -> "DelayDistribution":
        """P(d) proportional to exp(-rate * d).

        Rate 1 on {0..4} stands for the paper's "exponentially decreasing"; at rate 1 on {0..4}
        the probabilities are .636, .234, .086, .032, .012.
        """
        if not math.isfinite(rate):
            raise UsageError(f"delay rate {rate} is not finite", "give a finite rate, 1.0 say")
        return cls(tuple(support), tuple(math.exp(-rate * d) for d in support))

    @classmethod
    def constant(cls, delay: int) -> "DelayDistribution":
        """Always `delay`. The support contains 0 all the same, with weight 0."""
        if delay == 0:
            return cls((0,), (1.0,))
        return cls((0, delay), (0.0, 1.0))

    @classmethod
    def weights_(cls, support: Sequence[int], weights: Sequence[float]) -> "DelayDistribution":
        """Any weights; they need not sum to 1."""
        return cls(tuple(support), tuple(weights))

    @property
    def max(self) -> int:
        """The longest delay that can occur (weight above 0)."""
        return max(d for d, w in zip(self.support, self.weights, strict=True) if w > 0)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Int[Array, "..."]:
        """Draw independent delays, int32 of the given shape."""
        uniform = jax.random.uniform(key, shape)
        return self.quantile(uniform)

    def quantile(self, uniform: Array) -> Int[Array, "..."]:
        """Map uniform numbers in [0, 1) to delays through the inverse distribution function."""
        cumulative = np.cumsum(np.asarray(self.weights, np.float64)).astype(np.float32)
        last = max(i for i, w in enumerate(self.weights) if w > 0)
        # A delay of weight 0 after the last one that can occur must not be reached by rounding.
        cumulative[last:] = 1.0
        index = jnp.searchsorted(
            jnp.asarray(cumulative), uniform, side="right", method="compare_all"
        )
        return jnp.asarray(self.support, jnp.int32)[jnp.minimum(index, last)]


def _check_support(support: Sequence[int]) -> None:
    shown = f"delay support {tuple(support)}"
    if not support or any(isinstance(d, bool) or int(d) != d or d < 0 for d in support):
        raise UsageError(f"{shown} must be integers >= 0", "write it out, 0,1,2,3,4 say")
    if any(b <= a for a, b in itertools.pairwise(support)):
        raise UsageError(f"{shown} must be strictly increasing", "sort it and remove repeats")
    if support[0] != 0:
        raise UsageError(
            f"{shown} must contain 0: an episode starts without a previous chunk",
            "add 0 (its weight may be 0)",
        )


def _check_weights(support: Sequence[int], weights: Sequence[float]) -> None:
    if len(weights) != len(support):
        raise UsageError(
            f"{len(weights)} weights for {len(support)} delays", "give one weight per delay"
        )
    if any(not math.isfinite(w) or w < 0 for w in weights) or not any(w > 0 for w in weights):
        raise UsageError(
            f"delay weights {tuple(weights)} must be finite, >= 0 and not all 0",
            "give positive weights",
        )
