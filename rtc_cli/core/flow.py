"""Flow matching: the path from noise to data, its target, the sum of squared errors that count."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Velocity = Callable[[Float[Array, "B H A"], Float[Array, "B H"]], Float[Array, "B H A"]]
"""velocity(x, tau): any function, with one flow time per token; what every sampler accepts."""


def interpolate(
    data: Float[Array, "..."], noise: Float[Array, "..."], tau: Float[Array, "..."]
) -> Float[Array, "..."]:
    """x_tau = tau * data + (1 - tau) * noise: tau = 0 is noise, tau = 1 is data.

    At tau = 1 the result equals `data` (exactly, for finite noise).

    >>> float(interpolate(jnp.float32(2.0), jnp.float32(-1.0), jnp.float32(0.5)))
    0.5
    """
    return tau * data + (1 - tau) * noise


def target_velocity(data: Float[Array, "..."], noise: Float[Array, "..."]) -> Float[Array, "..."]:
    """u = data - noise, the derivative of `interpolate` by tau.

    The loss equation of arXiv 2512.05964 prints the opposite sign; its Algorithm 1 has this one.
    """
    return data - noise


def masked_squares(
    error: Float[Array, "H B A"], counted: Bool[Array, "H B"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Sum of squared errors of the counted tokens, and their number of elements.

    Errors of tokens that do not count may be anything, NaN included.
    """
    # Masked before it is squared: the gradient of what does not count must be 0, not 0 * NaN.
    squares = jnp.square(jnp.where(counted[..., None], error, 0.0))
    return jnp.sum(squares), jnp.sum(counted, dtype=jnp.float32) * error.shape[-1]
