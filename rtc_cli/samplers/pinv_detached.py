"""Guidance with the velocity held constant: no Jacobian of the network."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_cli.samplers.base import Field, Problem, Step
from rtc_cli.samplers.pinv import Guided


@dataclass(frozen=True)
class PinvDetached(Guided):
    """x <- x + dt (v + g(tau) e), e = W (Y - x - (1 - tau) v).

    As `pinv` with d x1/dx replaced by the identity: an ablation, not inference-time RTC. Cost:
    one velocity per step, no backward pass. lerobot's "guided" mode computes this, since it
    takes the velocity before the graph is built.
    """

    name: ClassVar[str] = "pinv-detached"

    def update(
        self, velocity: Field, x: Float[Array, "H B A"], step: Step, problem: Problem
    ) -> Float[Array, "H B A"]:
        v = velocity(x, jnp.full((1, 1), step.index))
        if problem.overlap is None:
            return x + step.dt * v
        error = self.error(x + (1 - step.tau) * v, problem.overlap, problem)
        return x + step.dt * (v + self.weight(step) * error)
