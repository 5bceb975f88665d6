"""A diffusion transformer with a context: the action expert of a vision-language-action model.

Action tokens attend to one another and to the cached keys and values of a context, which a
vision-language model computes once per chunk. Queries have several heads, keys and values fewer
(grouped-query attention). adaLN-zero conditions every block on flow time, per token, through the
same time table as the Mixer. The MLP is gated (GEGLU), as in Gemma, on which the published action
experts are built (arXiv 2410.24164, 2504.16054).

On the benchmark tasks a small encoder of the observation stands in for the vision-language model.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from rtc_cli.core.conditioning import Select, TimeEmbedding, adaln_zero, modulate, normalise
from rtc_cli.core.sizes import complete_sizes, require_even
from rtc_cli.errors import UsageError

DEFAULTS = {
    "layers": 2,
    "channels": 64,
    "channel_hidden": 128,
    "heads": 4,
    "kv_heads": 1,
    "head_dim": 16,
    "context": 4,
    "bfloat16": 0,
}
"""A small one, which trains on the benchmark tasks; `bfloat16` is 0 (float32) or 1."""

KeysValues = tuple[Float[Array, "B N G D"], Float[Array, "B N G D"]]
"""Keys and values of N tokens in G groups of width D."""


class TransformerBlock(nnx.Module):
    """Attention to the chunk and the context, then a gated MLP, each behind adaLN and a gate."""

    def __init__(self, sizes: Mapping[str, int], dtype: Any, rngs: nnx.Rngs) -> None:
        channels, hidden = sizes["channels"], sizes["channel_hidden"]
        self.kv_heads, self.head_dim = sizes["kv_heads"], sizes["head_dim"]
        queries, keys = sizes["heads"] * self.head_dim, self.kv_heads * self.head_dim
        self.query = _kernel(rngs, dtype, channels, queries)
        self.key_value = _kernel(rngs, dtype, channels, 2 * keys)
        self.attended = _kernel(rngs, dtype, queries, channels)
        self.mlp_in = _kernel(rngs, dtype, channels, 2 * hidden)
        self.mlp_out = _kernel(rngs, dtype, hidden, channels)
        self.context_key_value = _kernel(rngs, dtype, channels, 2 * keys)

    def __call__(
        self,
        x: Float[Array, "H B C"],
        context: KeysValues,
        modulation: list[Float[Array, "#H #B C"]],
    ) -> Float[Array, "H B C"]:
        scale_1, shift_1, gate_1, scale_2, shift_2, gate_2 = modulation
        x = x + gate_1 * self.attend(modulate(x, scale_1, shift_1), context)
        return x + gate_2 * self.mlp(modulate(x, scale_2, shift_2))

    def attend(self, x: Float[Array, "H B C"], context: KeysValues) -> Float[Array, "H B C"]:
        """Attention of every token to all tokens of its chunk and to the context.

        The context's keys are as many as 20 times the chunk's: they are used where they lie, and
        never copied beside the chunk's own.
        """
        horizon, batch, _ = x.shape
        flat = x.reshape(horizon * batch, -1)
        queries = (flat @ self.query[...]).reshape(horizon, batch, self.kv_heads, -1, self.head_dim)
        keys, values = self._split(flat @ self.key_value[...], horizon, batch)
        context_keys, context_values = context
        to_chunk = jnp.einsum("hbgqd,ubgd->bgqhu", queries, keys)
        to_context = jnp.einsum("hbgqd,bngd->bgqhn", queries, context_keys)
        scores = jnp.concatenate([to_context, to_chunk], axis=-1).astype(jnp.float32)
        weights = jax.nn.softmax(scores * self.head_dim**-0.5, axis=-1).astype(x.dtype)
        tokens = context_keys.shape[1]
        mixed = jnp.einsum("bgqhn,bngd->hbgqd", weights[..., :tokens], context_values)
        mixed = mixed + jnp.einsum("bgqhu,ubgd->hbgqd", weights[..., tokens:], values)
        return (mixed.reshape(horizon * batch, -1) @ self.attended[...]).reshape(x.shape)

    def mlp(self, x: Float[Array, "H B C"]) -> Float[Array, "H B C"]:
        gate, value = jnp.split(x.reshape(-1, x.shape[-1]) @ self.mlp_in[...], 2, axis=-1)
        return ((nnx.gelu(gate) * value) @ self.mlp_out[...]).reshape(x.shape)

    def read(self, context: Float[Array, "B N C"]) -> KeysValues:
        """Keys and values of the context's tokens."""
        batch, tokens, _ = context.shape
        return self._split(context @ self.context_key_value[...], batch, tokens)

    def _split(self, key_value: Array, *leading: int) -> KeysValues:
        keys, values = jnp.split(key_value, 2, axis=-1)
        shape = (*leading, self.kv_heads, self.head_dim)
        return keys.reshape(shape), values.reshape(shape)


class Transformer(nnx.Module):
    """Velocity of an action chunk given an observation and a flow time per token.

    A `Network` (see `rtc_cli.core.policy`), as the Mixer is one. What `observe` returns are the
    cached keys and values of the context, a pair per block: the rest of a chunk's computation
    does not see the observation. They are in the network's dtype; actions and velocities are
    float32 outside.
    """

    has_context = True

    def __init__(
        self,
        horizon: int,
        obs_dim: int,
        action_dim: int,
        options: Mapping[str, int],
        *,
        rngs: nnx.Rngs,
    ) -> None:
        sizes = transformer_sizes(options)
        self.layers, channels = sizes["layers"], sizes["channels"]
        self.width = 2 * sizes["channel_hidden"]
        self.dtype = jnp.bfloat16 if sizes["bfloat16"] else jnp.float32
        self.input = _kernel(rngs, self.dtype, action_dim, channels)
        self.position = _table(rngs, self.dtype, horizon, channels)
        self.context_in = _kernel(rngs, self.dtype, obs_dim, channels)
        self.context_position = _table(rngs, self.dtype, sizes["context"], channels)
        self.context_hidden = _kernel(rngs, self.dtype, channels, sizes["channel_hidden"])
        self.context_out = _kernel(rngs, self.dtype, sizes["channel_hidden"], channels)
        self.time = TimeEmbedding(channels, rngs=rngs)
        self.adaln = adaln_zero(channels, self.layers, param_dtype=self.dtype, rngs=rngs)
        for index in range(self.layers):
            setattr(self, f"block_{index}", TransformerBlock(sizes, self.dtype, rngs))
        self.output = nnx.Linear(channels, action_dim, rngs=rngs)

    @property
    def blocks(self) -> list[TransformerBlock]:
        return [getattr(self, f"block_{index}") for index in range(self.layers)]

    def condition(self, times: Float[Array, " N"]) -> list[Float[Array, "N C"]]:
        """Scale, shift and gate of every adaLN for N flow times."""
        vectors = self.adaln(self.time(times)).astype(self.dtype)
        return jnp.split(vectors, 6 * self.layers + 2, axis=-1)

    def observe(self, observations: Float[Array, "B O"]) -> list[KeysValues]:
        """Keys and values of the context in every block: what a chunk computes once."""
        seen = observations.astype(self.dtype) @ self.context_in[...]
        context = seen[:, None] + self.context_position[...]
        hidden = nnx.gelu(normalise(context) @ self.context_hidden[...])
        context = normalise(context + hidden @ self.context_out[...])
        return [block.read(context) for block in self.blocks]

    def tokens(
        self,
        x: Float[Array, "H B A"],
        observed: list[KeysValues],
        conditioning: list[Float[Array, "N C"]],
        select: Select,
    ) -> Float[Array, "H B A"]:
        """Velocity (H, B, A) of noisy actions; `select` finds each token's conditioning."""
        flat = x.reshape(-1, x.shape[-1]).astype(self.dtype) @ self.input[...]
        h = flat.reshape(*x.shape[:2], -1) + self.position[...][:, None]
        for index, block in enumerate(self.blocks):
            vectors = [select(table) for table in conditioning[6 * index : 6 * index + 6]]
            h = block(h, observed[index], vectors)
        scale, shift = (select(table) for table in conditioning[-2:])
        h = modulate(h, scale, shift)
        return self.output(h.reshape(-1, h.shape[-1]).astype(jnp.float32)).reshape(x.shape)

    def velocity_per_token(
        self,
        observations: Float[Array, "B O"],
        x: Float[Array, "B H A"],
        tau: Float[Array, "B H"],
        observed: list[KeysValues] | None = None,
    ) -> Float[Array, "B H A"]:
        """The same function as one would write it first; a baseline, and the path for any tau.

        Batch-major; time embedding and adaLN per token; the context's keys and values copied
        beside the chunk's, for the library's attention. `observed`, where it is known already,
        stands for the observations.
        """
        batch, horizon = tau.shape
        cache = self.observe(observations) if observed is None else observed
        h = x.astype(self.dtype) @ self.input[...] + self.position[...]
        vectors = self.adaln(self.time(tau.reshape(-1))).astype(self.dtype)
        parts = jnp.split(vectors.reshape(batch, horizon, -1), 6 * self.layers + 2, axis=-1)
        for index, block in enumerate(self.blocks):
            scale_1, shift_1, gate_1, scale_2, shift_2, gate_2 = parts[6 * index : 6 * index + 6]
            mixed = normalise(h) * (1 + scale_1) + shift_1
            queries = (mixed @ block.query[...]).reshape(batch, horizon, -1, block.head_dim)
            own = block._split(mixed @ block.key_value[...], batch, horizon)
            keys, values = (
                jnp.concatenate(pair, 1) for pair in zip(cache[index], own, strict=True)
            )
            attended = jax.nn.dot_product_attention(queries, keys, values)
            h = h + gate_1 * (attended.reshape(batch, horizon, -1) @ block.attended[...])
            gate, value = jnp.split(
                (normalise(h) * (1 + scale_2) + shift_2) @ block.mlp_in[...], 2, axis=-1
            )
            h = h + gate_2 * ((nnx.gelu(gate) * value) @ block.mlp_out[...])
        h = normalise(h) * (1 + parts[-2]) + parts[-1]
        return self.output(h.astype(jnp.float32))


def transformer_sizes(options: Mapping[str, int]) -> dict[str, int]:
    """Complete and check the sizes; UsageError names the option and what is allowed."""
    sizes = complete_sizes("transformer", options, DEFAULTS, zero_allowed=("bfloat16",))
    require_even("transformer", sizes, "channels")
    if sizes["heads"] % sizes["kv_heads"]:
        raise UsageError(
            f"transformer option heads = {sizes['heads']} is no multiple of kv_heads = "
            f"{sizes['kv_heads']}: every key has to serve as many queries",
            "give a multiple",
        )
    if sizes["bfloat16"] > 1:
        raise UsageError(f"transformer option bfloat16 = {sizes['bfloat16']}", "give 0 or 1")
    return sizes


def _kernel(rngs: nnx.Rngs, dtype: Any, inputs: int, outputs: int) -> nnx.Param:
    init = nnx.initializers.lecun_normal()
    return nnx.Param(init(rngs.params(), (inputs, outputs), dtype))


def _table(rngs: nnx.Rngs, dtype: Any, rows: int, channels: int) -> nnx.Param:
    return nnx.Param(nnx.initializers.normal(0.02)(rngs.params(), (rows, channels), dtype))
