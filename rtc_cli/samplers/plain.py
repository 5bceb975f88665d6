"""Plain Euler steps of the flow."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_cli.samplers.base import Field, Problem, Sampler, Step


@dataclass(frozen=True)
class Plain(Sampler):
    """x <- x + dt v(x, tau). Ignores the previous chunk.

    Cost: one velocity per step. Order: 1. Source: flow matching (arXiv 2210.02747).
    """

    name: ClassVar[str] = "plain"

    def update(
        self, velocity: Field, x: Float[Array, "H B A"], step: Step, problem: Problem
    ) -> Float[Array, "H B A"]:
        return x + step.dt * velocity(x, jnp.full((1, 1), step.index))
