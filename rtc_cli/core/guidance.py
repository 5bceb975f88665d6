"""Inference-time guidance: how much each token is pulled, and how strongly at each flow time."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtc_cli.errors import UsageError, did_you_mean

Ramp = Callable[[Float[Array, "..."]], Float[Array, "..."]]

_RAMPS: dict[str, Ramp] = {
    "exp": lambda c: c * jnp.expm1(c) / (math.e - 1.0),
    "linear": lambda c: c,
    "zeros": jnp.zeros_like,
    "ones": jnp.ones_like,
}

MASKS = tuple(_RAMPS)
"""Names of the soft masks; `zeros` is the hard mask."""


def check_mask(mask: str) -> None:
    """Raise UsageError unless `mask` names a soft mask."""
    if mask not in _RAMPS:
        raise UsageError(
            f'unknown mask "{mask}".{did_you_mean(mask, MASKS)}', "choose another mask"
        )


def overlap_weights(
    horizon: int,
    exec_horizon: int | Int[Array, "*B"],
    delay: int | Int[Array, "*B"],
    mask: str = "exp",
) -> Float[Array, "*B H"]:
    """Weights W of the overlap's tokens, for one (s, d) or a batch of them.

        W_i = 1               for i < d
        W_i = ramp(c_i)       for d <= i < H - s,   c_i = (H - s - i) / (H - s - d + 1)
        W_i = 0               for i >= H - s

    with ramp(c) = c (e^c - 1) / (e - 1) (`exp`), c (`linear`), 0 (`zeros`), 1 (`ones`).
    Source: arXiv 2506.07339, eq. 5.

    >>> [round(float(w), 2) for w in overlap_weights(50, 25, 6)[jnp.array([5, 6, 10, 25])]]
    [1.0, 0.88, 0.49, 0.0]
    """
    check_mask(mask)
    token = jnp.arange(horizon)
    end = horizon - jnp.asarray(exec_horizon)[..., None]
    start = jnp.asarray(delay)[..., None]
    # Outside d <= i < H - s the ramp is not used; the clip keeps it finite there.
    c = jnp.clip((end - token) / jnp.maximum(end - start + 1, 1), 0.0, 1.0).astype(jnp.float32)
    weights = jnp.where(token < start, 1.0, _RAMPS[mask](c))
    return jnp.where(token < end, weights, 0.0)


def guidance_weight(
    tau: Float[Array, "..."], max_guidance_weight: float, prior_std: float = 1.0
) -> Float[Array, "..."]:
    """g(tau) = min(beta, (1 - tau) / (tau r^2)), beta at tau = 0.

        r^2 = (1 - tau)^2 sigma^2 / ((1 - tau)^2 + sigma^2 tau^2)

    with sigma = `prior_std`, the standard deviation of the data's prior. sigma = 1 gives the
    weight of arXiv 2506.07339; the general form is Soare (2025).

    >>> [round(float(g), 2) for g in guidance_weight(jnp.arange(5) / 5, jnp.inf)]
    [inf, 4.25, 2.17, 2.17, 4.25]
    """
    variance = prior_std**2
    numerator = (1 - tau) ** 2 + variance * tau**2
    denominator = tau * (1 - tau) * variance
    safe = jnp.where(denominator > 0, denominator, 1.0)
    unclipped = jnp.where(denominator > 0, numerator / safe, jnp.inf)
    return jnp.minimum(unclipped, max_guidance_weight)
