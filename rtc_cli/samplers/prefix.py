"""Training-time real-time chunking: the committed actions are a clean prefix."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtc_cli.core.conditioning import CleanRows, Rows
from rtc_cli.samplers.base import Field, Problem, Sampler, Step


@dataclass(frozen=True)
class Prefix(Sampler):
    """The first d tokens are the committed actions at flow time 1; the rest is denoised.

    The result's first d tokens equal overlap[:, :d] bit for bit (the paper's listing leaves them
    moved by the last step). Cost: one velocity per step. Needs a network trained with simulated
    delay. Source: arXiv 2512.05964.
    """

    name: ClassVar[str] = "prefix"

    def times(self, flow_steps: int) -> np.ndarray:
        return np.append(super().times(flow_steps), 1.0)

    def start(self, problem: Problem) -> Float[Array, "H B A"]:
        return _paste(problem.noise, problem)

    def update(
        self, velocity: Field, x: Float[Array, "H B A"], step: Step, problem: Problem
    ) -> Float[Array, "H B A"]:
        rows: Rows = jnp.full((1, 1), step.index)
        if problem.overlap is not None:
            rows = CleanRows(step.index, problem.flow_steps, problem.prefix)
        return _paste(x + step.dt * velocity(x, rows), problem)


def _paste(x: Float[Array, "H B A"], problem: Problem) -> Float[Array, "H B A"]:
    if problem.overlap is None:
        return x
    return jnp.where(problem.prefix[..., None], problem.overlap, x)
