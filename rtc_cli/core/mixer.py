"""The MLP-Mixer velocity network of the paper's simulation (arXiv 2506.07339, 2512.05964).

Every token is an action with the observation beside it, projected to `channels`; blocks mix over
tokens, then over channels; adaLN conditions each on flow time. Inside, arrays are token-major
(H, B, C): mixing over tokens and over channels are both plain 2-D matrix products.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from rtc_cli.core.conditioning import Select, TimeEmbedding, adaln_zero, modulate, normalise
from rtc_cli.core.sizes import complete_sizes, require_even

DEFAULTS = {"layers": 4, "channels": 256, "channel_hidden": 512, "token_hidden": 64}
"""The paper's network."""


class MixerBlock(nnx.Module):
    """One block: tokens mixed, then channels, each behind an adaLN and a gate."""

    def __init__(
        self, horizon: int, channels: int, channel_hidden: int, token_hidden: int, rngs: nnx.Rngs
    ) -> None:
        init = nnx.initializers.lecun_normal()
        token_init = nnx.initializers.variance_scaling(
            1.0, "fan_in", "truncated_normal", in_axis=-1, out_axis=-2
        )
        # Token kernels are stored (out, in): they multiply token-major arrays from the left.
        self.token_in = nnx.Param(token_init(rngs.params(), (token_hidden, horizon)))
        self.token_out = nnx.Param(token_init(rngs.params(), (horizon, token_hidden)))
        self.channel_in = nnx.Param(init(rngs.params(), (channels, channel_hidden)))
        self.channel_out = nnx.Param(init(rngs.params(), (channel_hidden, channels)))

    def __call__(
        self, x: Float[Array, "H B C"], modulation: list[Float[Array, "#H #B C"]]
    ) -> Float[Array, "H B C"]:
        scale_1, shift_1, gate_1, scale_2, shift_2, gate_2 = modulation
        x = x + gate_1 * self.mix_tokens(modulate(x, scale_1, shift_1))
        return x + gate_2 * self.mix_channels(modulate(x, scale_2, shift_2))

    def mix_tokens(self, x: Float[Array, "H B C"]) -> Float[Array, "H B C"]:
        flat = x.reshape(x.shape[0], -1)
        return (self.token_out[...] @ nnx.gelu(self.token_in[...] @ flat)).reshape(x.shape)

    def mix_channels(self, x: Float[Array, "H B C"]) -> Float[Array, "H B C"]:
        flat = x.reshape(-1, x.shape[-1])
        return (nnx.gelu(flat @ self.channel_in[...]) @ self.channel_out[...]).reshape(x.shape)


class Mixer(nnx.Module):
    """Velocity of an action chunk given an observation and a flow time per token.

    `condition`, `observe` and `tokens` are the fast path: what depends on flow time only, what
    depends on the observation only, and the rest. `velocity_per_token` is the straightforward
    implementation of the same function.
    """

    def __init__(
        self,
        horizon: int,
        obs_dim: int,
        action_dim: int,
        options: Mapping[str, int],
        *,
        rngs: nnx.Rngs,
    ) -> None:
        sizes = mixer_sizes(options)
        channels, layers = sizes["channels"], sizes["layers"]
        self.horizon, self.action_dim, self.layers = horizon, action_dim, layers
        self.width = max(channels, sizes["channel_hidden"])
        self.input = nnx.Linear(action_dim + obs_dim, channels, rngs=rngs)
        self.time = TimeEmbedding(channels, rngs=rngs)
        self.adaln = adaln_zero(channels, layers, rngs=rngs)
        for index in range(layers):
            block = MixerBlock(
                horizon, channels, sizes["channel_hidden"], sizes["token_hidden"], rngs
            )
            setattr(self, f"block_{index}", block)
        self.output = nnx.Linear(channels, action_dim, rngs=rngs)

    @property
    def blocks(self) -> list[MixerBlock]:
        return [getattr(self, f"block_{index}") for index in range(self.layers)]

    def condition(self, times: Float[Array, " N"]) -> list[Float[Array, "N C"]]:
        """Scale, shift and gate of every adaLN for N flow times."""
        return jnp.split(self.adaln(self.time(times)), 6 * self.layers + 2, axis=-1)

    def observe(self, observations: Float[Array, "B O"]) -> Float[Array, "B C"]:
        """The observation's part of the input projection, bias included."""
        return observations @ self.input.kernel[self.action_dim :] + self.input.bias[...]

    def tokens(
        self,
        x: Float[Array, "H B A"],
        observed: Float[Array, "B C"],
        conditioning: list[Float[Array, "N C"]],
        select: Select,
    ) -> Float[Array, "H B A"]:
        """Velocity (H, B, A) of noisy actions; `select` finds each token's conditioning."""
        flat = x.reshape(-1, self.action_dim) @ self.input.kernel[: self.action_dim]
        h = flat.reshape(*x.shape[:2], -1) + observed
        for index, block in enumerate(self.blocks):
            h = block(h, [select(table) for table in conditioning[6 * index : 6 * index + 6]])
        scale, shift = (select(table) for table in conditioning[-2:])
        h = modulate(h, scale, shift)
        return self.output(h.reshape(-1, h.shape[-1])).reshape(x.shape)

    def velocity_per_token(
        self,
        observations: Float[Array, "B O"],
        x: Float[Array, "B H A"],
        tau: Float[Array, "B H"],
    ) -> Float[Array, "B H A"]:
        """The same function as one would write it first; a baseline, and the path for any tau.

        Batch-major; the observation beside every token; time embedding and adaLN per token.
        """
        batch, horizon = tau.shape
        beside = jnp.broadcast_to(observations[:, None], (batch, horizon, observations.shape[-1]))
        h = self.input(jnp.concatenate([x, beside], axis=-1))
        vectors = self.adaln(self.time(tau.reshape(-1))).reshape(batch, horizon, -1)
        parts = jnp.split(vectors, 6 * self.layers + 2, axis=-1)
        for index, block in enumerate(self.blocks):
            scale_1, shift_1, gate_1, scale_2, shift_2, gate_2 = parts[6 * index : 6 * index + 6]
            mixed = jnp.swapaxes(normalise(h) * (1 + scale_1) + shift_1, 1, 2)
            mixed = nnx.gelu(mixed @ block.token_in.T) @ block.token_out.T
            h = h + gate_1 * jnp.swapaxes(mixed, 1, 2)
            mixed = nnx.gelu((normalise(h) * (1 + scale_2) + shift_2) @ block.channel_in[...])
            h = h + gate_2 * (mixed @ block.channel_out[...])
        return self.output(normalise(h) * (1 + parts[-2]) + parts[-1])


def mixer_sizes(options: Mapping[str, int]) -> dict[str, int]:
    """Complete and check the sizes of a Mixer; UsageError names the option and what is allowed."""
    sizes = complete_sizes("mixer", options, DEFAULTS)
    require_even("mixer", sizes, "channels")
    return sizes
