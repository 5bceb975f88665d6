"""How differently the experts of a mixture act: a distance between their action distributions."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rtc_cli.experts.policy import ExpertPolicy, mlp, normalise


def hellinger_distances(
    experts: Sequence[ExpertPolicy], observations: np.ndarray, policy_std: float = 1.0
) -> np.ndarray:
    """(E, E) Hellinger distances of the experts' action distributions, mean over (n, O) states.

    `policy_std` scales the experts' own standard deviations; with 0 each has one action a state,
    and two that differ are at a distance of 1.

    0: the two act alike; 1: no action of one is possible for the other. Actions are squashed
    Gaussians behind one common squashing, which leaves the distance that of the Gaussians:

        H² = 1 − Π_i sqrt(2 σ_i σ'_i / (σ_i² + σ'_i²)) · exp(−(μ_i − μ'_i)² / (4 (σ_i² + σ'_i²)))
    """
    obs = jnp.asarray(observations, jnp.float32)
    means = jnp.stack([mlp(e.layers, normalise(obs, e.obs_mean, e.obs_std)) for e in experts])
    if policy_std == 0.0:
        return np.asarray((means[:, None] != means[None]).any(axis=-1).mean(axis=-1), np.float64)
    std = policy_std * jnp.exp(jnp.stack([expert.log_std for expert in experts]))[:, None]
    return np.asarray(_distances(means, std), np.float64)


@jax.jit
def _distances(means: jax.Array, std: jax.Array) -> jax.Array:
    """Means (E, n, A) and standard deviations (E, 1, A) -> (E, E)."""
    total = std[:, None] ** 2 + std[None] ** 2
    overlap = 0.5 * jnp.log(2.0 * std[:, None] * std[None] / total)
    overlap = overlap - (means[:, None] - means[None]) ** 2 / (4.0 * total)
    affinity = jnp.exp(jnp.sum(overlap, axis=-1))
    return jnp.mean(jnp.sqrt(jnp.maximum(1.0 - affinity, 0.0)), axis=-1)


def mean_distance(distances: np.ndarray) -> float | None:
    """The mean over pairs of different experts; None for a single one."""
    pairs = distances[np.triu_indices(len(distances), k=1)]
    return float(pairs.mean()) if pairs.size else None
