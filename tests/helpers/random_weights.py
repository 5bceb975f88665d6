"""Policies with random weights for tests that need some weights and no particular ones.

Drawn by NumPy: `Policy.init` compiles one program per size, for several seconds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig, parameter_shapes


def random_policy(
    config: PolicyConfig, normaliser: Normaliser | None = None, seed: int = 0
) -> Policy:
    """A policy whose weights are all random, biases and adaLN included; no normaliser: identity.

    Every weight is normal with variance 1 / its first axis (0.01 for vectors), adaLN's kernel a
    quarter of that, as after `Policy.init(..., adaln_zero=False)`.
    """
    draw = np.random.default_rng(seed).standard_normal

    def weight(path: jax.tree_util.KeyPath, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        scale = 0.1 if len(leaf.shape) < 2 else leaf.shape[0] ** -0.5
        if jax.tree_util.keystr(path, simple=True, separator="/") == "adaln/kernel":
            scale *= 0.5
        return jnp.asarray(scale * draw(leaf.shape), leaf.dtype)

    params = jax.tree_util.tree_map_with_path(weight, parameter_shapes(config))
    normaliser = normaliser or Normaliser.identity(config.obs_dim, config.action_dim)
    return Policy(config, params, normaliser)
