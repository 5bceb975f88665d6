"""Conditioning on flow time: its embedding, adaLN, and the selection of a row per token.

A network sees flow time only through adaLN's scale, shift and gate. These are computed once for
each distinct flow time (a *table*, one row per time), and a token then selects its row. Token-major
arrays are (H, B, C): tokens, batch, channels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

Select = Callable[[Float[Array, "N C"]], Float[Array, "#H #B C"]]
"""Takes a table of N rows to each token's row, broadcastable to (H, B, C)."""

MIN_PERIOD = 4e-3
MAX_PERIOD = 4.0


def time_features(tau: Float[Array, " N"], width: int) -> Float[Array, "N width"]:
    """Sine and cosine of flow time at periods spaced geometrically from 4e-3 to 4.

    The first half of the features are sines. `width` must be even.
    """
    fraction = jnp.linspace(0.0, 1.0, width // 2)
    period = MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** fraction
    # An outer product, not a matrix product: that would round the phase on some accelerators.
    phase = tau[:, None] * (2 * jnp.pi / period)
    return jnp.concatenate([jnp.sin(phase), jnp.cos(phase)], axis=-1)


class TimeEmbedding(nnx.Module):
    """Flow time (N,) -> embedding (N, width): sinusoids, then two layers with swish."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.width = width
        self.first = nnx.Linear(width, width, rngs=rngs)
        self.second = nnx.Linear(width, width, rngs=rngs)

    def __call__(self, tau: Float[Array, " N"]) -> Float[Array, "N width"]:
        return nnx.swish(self.second(nnx.swish(self.first(time_features(tau, self.width)))))


def adaln_zero(
    channels: int, layers: int, *, param_dtype: Any = jnp.float32, rngs: nnx.Rngs
) -> nnx.Linear:
    """All adaLN layers of a network as one product, zero at first.

    Six vectors per block (scale, shift and gate of its two parts), two for the output.
    """
    return nnx.Linear(
        channels,
        (6 * layers + 2) * channels,
        kernel_init=nnx.initializers.zeros_init(),
        param_dtype=param_dtype,
        rngs=rngs,
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CleanRows:
    """Rows of a table for a chunk with a clean prefix: `clean` for its tokens, else `own`.

    Selected by comparison. To look a row up for every token gives the same numbers, and costs a
    tenth of a small network's time at batch 32.
    """

    own: Int[Array, ""]
    clean: Int[Array, ""] | int
    prefix: Bool[Array, "H #B"]


Rows = Int[Array, "#H #B"] | CleanRows
"""Which row of a table each token takes: token i of example b takes row `rows[i, b]`."""


def select_rows(rows: Rows) -> Select:
    """Select each token's row."""
    if isinstance(rows, CleanRows):
        prefix = rows.prefix[..., None]
        return lambda table: jnp.where(prefix, table[rows.clean], table[rows.own])
    return lambda table: table[rows]


def select_clean(prefix: Bool[Array, "H B"]) -> Select:
    """Select for training: example b's own row b, but the last row for tokens of the prefix."""
    return lambda table: jnp.where(prefix[..., None], table[-1], table[:-1])


def select_own(table: Float[Array, "B C"]) -> Float[Array, "1 B C"]:
    """Select for training without delays: row b for every token of example b."""
    return table[None]


def normalise(x: Float[Array, "... C"]) -> Float[Array, "... C"]:
    """Layer norm over channels without learned scale and shift (epsilon 1e-6).

    Computed in float32 whatever the dtype of x, which is the result's too.
    """
    wide = x.astype(jnp.float32)
    centred = wide - jnp.mean(wide, axis=-1, keepdims=True)
    variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
    return (centred * jax.lax.rsqrt(variance + 1e-6)).astype(x.dtype)


def modulate(
    x: Float[Array, "... C"], scale: Float[Array, "..."], shift: Float[Array, "..."]
) -> Float[Array, "... C"]:
    """adaLN: the layer norm of x, scaled by 1 + scale and shifted."""
    return normalise(x) * (1 + scale) + shift
