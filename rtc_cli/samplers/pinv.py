"""Inference-time real-time chunking: pseudo-inverse guidance towards the overlap."""

import math
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_cli.core.guidance import check_mask, guidance_weight, overlap_weights
from rtc_cli.errors import UsageError
from rtc_cli.samplers.base import Field, Problem, Sampler, Step


@dataclass(frozen=True)
class Guided(Sampler):
    """What guided samplers share: settings, checks, the error towards the overlap.

    mask: soft mask, `exp`, `linear`, `zeros` (hard) or `ones`.
    max_guidance_weight: beta, the clip of the guidance weight, >= 0.
    prior_std: sigma, the standard deviation of the data's prior, > 0.
    """

    mask: str = "exp"
    max_guidance_weight: float = 5.0
    prior_std: float = 1.0

    def __post_init__(self) -> None:
        check_mask(self.mask)
        _check_number("max_guidance_weight", self.max_guidance_weight, zero_allowed=True)
        _check_number("prior_std", self.prior_std, zero_allowed=False)

    def error(
        self, denoised: Float[Array, "H B A"], overlap: Float[Array, "H B A"], problem: Problem
    ) -> Float[Array, "H B A"]:
        """W * (Y - denoised), the weighted distance of the denoised chunk from the overlap Y."""
        weights = overlap_weights(
            problem.geometry.horizon,
            problem.exec_horizon,
            jnp.atleast_1d(problem.delay),
            self.mask,
        )
        return weights.T[..., None] * (overlap - denoised)

    def weight(self, step: Step) -> Float[Array, ""]:
        """g(tau) of this step."""
        return guidance_weight(step.tau, self.max_guidance_weight, self.prior_std)


@dataclass(frozen=True)
class Pinv(Guided):
    """x <- x + dt (v + g(tau) e^T d x1/dx), x1 = x + (1 - tau) v(x, tau), e = W (Y - x1).

    The Jacobian is that of x1, identity part included: one vector-Jacobian product per step, for
    the batch at once. Cost: a velocity and a backward pass through it per step. Not to be
    confused with `pinv-detached`, which has no backward pass. Without an overlap, and where all
    weights are 0, it equals `plain`.
    Source: arXiv 2506.07339, Algorithm 1; prior_std: Soare (2025).
    """

    name: ClassVar[str] = "pinv"
    tile: ClassVar[int] = 32  # the backward pass keeps the activations of the forward pass too

    def update(
        self, velocity: Field, x: Float[Array, "H B A"], step: Step, problem: Problem
    ) -> Float[Array, "H B A"]:
        rows = jnp.full((1, 1), step.index)
        if problem.overlap is None:
            return x + step.dt * velocity(x, rows)
        v, pull = jax.vjp(lambda x: velocity(x, rows), x)
        error = self.error(x + (1 - step.tau) * v, problem.overlap, problem)
        (through_velocity,) = pull((1 - step.tau) * error)
        return x + step.dt * (v + self.weight(step) * (error + through_velocity))


def _check_number(name: str, value: object, *, zero_allowed: bool) -> None:
    rule = ">= 0" if zero_allowed else "> 0"
    fits = (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and (value > 0 or (zero_allowed and value == 0))
    )
    if not fits:
        raise UsageError(f"{name} = {value!r} must be a finite number {rule}", f"give one {rule}")
