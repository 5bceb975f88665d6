"""Baselines in the style of the public research code of real-time chunking, written by us.

The same Mixer with the same parameters, so outputs can be compared, but: batch-major arrays, the
observation repeated for every token, flow time embedded and adaLN computed in every step for every
example, guidance as a vmap of per-example vector-Jacobian products.
"""

from typing import Any

import jax
import jax.numpy as jnp

from rtc_cli.core.guidance import guidance_weight, overlap_weights
from rtc_cli.core.policy import Policy

Params = dict[str, Any]


def reference_params(policy: Policy) -> Params:
    """The policy's parameters with one adaLN layer per norm, as that code keeps them."""
    layers = sum(name.startswith("block_") for name in policy.params)
    adaln = policy.params["adaln"]
    kernel = jnp.split(adaln["kernel"], 6 * layers + 2, axis=1)
    bias = jnp.split(adaln["bias"], 6 * layers + 2)

    def layer(first: int, count: int) -> Params:
        part = slice(first, first + count)
        return {
            "kernel": jnp.concatenate(kernel[part], axis=1),
            "bias": jnp.concatenate(bias[part]),
        }

    blocks = [
        {
            "token_in": policy.params[f"block_{i}"]["token_in"].T,
            "token_out": policy.params[f"block_{i}"]["token_out"].T,
            "channel_in": policy.params[f"block_{i}"]["channel_in"],
            "channel_out": policy.params[f"block_{i}"]["channel_out"],
            "adaln_1": layer(6 * i, 3),
            "adaln_2": layer(6 * i + 3, 3),
        }
        for i in range(layers)
    ]
    shared = {name: policy.params[name] for name in ("input", "time", "output")}
    return shared | {"blocks": blocks, "final_adaln": layer(6 * layers, 2)}


def velocity(params: Params, obs: jax.Array, x: jax.Array, time: jax.Array) -> jax.Array:
    """Velocity (B, H, A) of x at flow times () or (B,)."""
    batch, horizon, _ = x.shape
    h = linear(params["input"], jnp.concatenate([x, jnp.repeat(obs[:, None], horizon, 1)], -1))
    embedded = embed(params["time"], jnp.broadcast_to(time, batch))
    for block in params["blocks"]:
        scale, shift, gate = jnp.split(linear(block["adaln_1"], embedded)[:, None], 3, -1)
        mixed = jnp.transpose(layer_norm(h) * (1 + scale) + shift, (0, 2, 1))
        mixed = jax.nn.gelu(mixed @ block["token_in"]) @ block["token_out"]
        h = h + gate * jnp.transpose(mixed, (0, 2, 1))
        scale, shift, gate = jnp.split(linear(block["adaln_2"], embedded)[:, None], 3, -1)
        mixed = (layer_norm(h) * (1 + scale) + shift) @ block["channel_in"]
        h = h + gate * (jax.nn.gelu(mixed) @ block["channel_out"])
    scale, shift = jnp.split(linear(params["final_adaln"], embedded)[:, None], 2, -1)
    return linear(params["output"], layer_norm(h) * (1 + scale) + shift)


def linear(layer: Params, x: jax.Array) -> jax.Array:
    return x @ layer["kernel"] + layer["bias"]


def layer_norm(x: jax.Array) -> jax.Array:
    mean = jnp.mean(x, axis=-1, keepdims=True)
    variance = jnp.maximum(0.0, jnp.mean(jnp.square(x), axis=-1, keepdims=True) - mean**2)
    return (x - mean) * jax.lax.rsqrt(variance + 1e-6)


def embed(layers: Params, time: jax.Array) -> jax.Array:
    width = layers["first"]["kernel"].shape[0]
    period = 4e-3 * (4.0 / 4e-3) ** jnp.linspace(0.0, 1.0, width // 2)
    phase = jnp.einsum("i,j->ij", time, 2 * jnp.pi / period, precision=jax.lax.Precision.HIGHEST)
    features = jnp.concatenate([jnp.sin(phase), jnp.cos(phase)], axis=-1)
    return jax.nn.swish(linear(layers["second"], jax.nn.swish(linear(layers["first"], features))))


def plain(params: Params, obs: jax.Array, noise: jax.Array, steps: int) -> jax.Array:
    """Plain Euler steps."""
    dt = 1 / steps

    def step(carry: Any, _: None) -> Any:
        x, time = carry
        return (x + dt * velocity(params, obs, x, time), time + dt), None

    (x, _), _ = jax.lax.scan(step, (noise, jnp.float32(0.0)), length=steps)
    return x


def guided(
    params: Params,
    obs: jax.Array,
    noise: jax.Array,
    overlap: jax.Array,
    exec_horizon: jax.Array,
    delay: jax.Array,
    steps: int,
) -> jax.Array:
    """Guidance with one vector-Jacobian product per example, vmapped."""
    dt, horizon = 1 / steps, noise.shape[1]

    def step(carry: Any, _: None) -> Any:
        x, time = carry

        def corrected(obs: jax.Array, x: jax.Array, target: jax.Array) -> jax.Array:
            def denoise(x: jax.Array) -> tuple[jax.Array, jax.Array]:
                v = velocity(params, obs[None], x[None], time)[0]
                return x + (1 - time) * v, v

            denoised, pull, v = jax.vjp(denoise, x, has_aux=True)
            weights = overlap_weights(horizon, exec_horizon, delay, "exp")
            (correction,) = pull((target - denoised) * weights[:, None])
            return v + guidance_weight(time, 5.0) * correction

        v = jax.vmap(corrected)(obs, x, overlap)
        return (x + dt * v, time + dt), None

    (x, _), _ = jax.lax.scan(step, (noise, jnp.float32(0.0)), length=steps)
    return x


def loss(params: Params, obs: jax.Array, actions: jax.Array, key: jax.Array) -> jax.Array:
    """Ordinary flow-matching loss, mean over all elements."""
    noise_key, time_key, _ = jax.random.split(key, 3)
    time = jax.random.uniform(time_key, (obs.shape[0],))
    noise = jax.random.normal(noise_key, actions.shape)
    x = (1 - time[:, None, None]) * noise + time[:, None, None] * actions
    return jnp.mean(jnp.square(velocity(params, obs, x, time) - (actions - noise)))
