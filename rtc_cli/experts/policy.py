"""An expert: a Gaussian policy behind a tanh; and a mixture of experts that acts in episodes.

The action is `low + (tanh(u) + 1) / 2 * (high - low)` with `u ~ N(mean(obs), exp(log_std)²)`: the
standard deviation belongs to `u`, before the squashing. Experts act by sampling.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from rtc_cli.errors import StateError, UsageError
from rtc_cli.files import new_folder, verify_checksums, write_checksums, write_json

Layers = tuple[tuple[jax.Array, jax.Array], ...]  # (weights (in, out), bias (out,)) per layer

SCHEMA = 1
TILE = 256  # rows per call of the mixture: XLA's last bits differ between batch sizes
OBS_CLIP = 10.0  # normalised observations are held within this many standard deviations


def mlp(layers: Layers, x: jax.Array) -> jax.Array:
    """Apply a multilayer perceptron with tanh between its layers: (..., in) -> (..., out)."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


def squash(u: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Map unbounded u to physical actions within [low, high]."""
    return low + 0.5 * (jnp.tanh(u) + 1.0) * (high - low)


def normalise(obs: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Centre and scale observations, clipped to ±OBS_CLIP."""
    return jnp.clip((obs - mean) / std, -OBS_CLIP, OBS_CLIP)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExpertPolicy:
    """A trained expert; a pytree. All arrays float32.

    layers: the perceptron of the mean; obs_mean, obs_std: (O,); log_std, action_low, action_high:
    (A,), log_std of u before the squashing.
    """

    layers: Layers
    obs_mean: jax.Array
    obs_std: jax.Array
    log_std: jax.Array
    action_low: jax.Array
    action_high: jax.Array

    @property
    def obs_dim(self) -> int:
        return int(self.obs_mean.shape[0])

    @property
    def action_dim(self) -> int:
        return int(self.action_low.shape[0])

    def act(self, obs: jax.Array, noise: jax.Array) -> jax.Array:
        """Return physical actions (n, A) from observations (n, O) and standard normals (n, A)."""
        mean = mlp(self.layers, normalise(obs, self.obs_mean, self.obs_std))
        return squash(mean + jnp.exp(self.log_std) * noise, self.action_low, self.action_high)

    def sample(self, obs: jax.Array, keys: jax.Array) -> jax.Array:
        """Sample physical actions (n, A) for observations (n, O), one random key per row (n,)."""
        return self.act(obs, _normals(keys, self.action_dim))

    @property
    def digest(self) -> str:
        """The SHA-256 of all arrays, in hexadecimal: two experts with one digest act alike."""
        state = hashlib.sha256()
        for name, array in sorted(_to_arrays(self).items()):
            state.update(f"{name}{array.shape}".encode())
            state.update(array.tobytes())
        return state.hexdigest()

    def save(self, folder: Path | str) -> None:
        """Write the expert into a new folder: arrays as safetensors, sizes as JSON, checksums."""
        hidden = [int(weights.shape[1]) for weights, _ in self.layers[:-1]]
        sizes = {"obs_dim": self.obs_dim, "action_dim": self.action_dim, "hidden": hidden}
        with new_folder(folder) as temporary:
            save_file(_to_arrays(self), temporary / "expert.safetensors")
            write_json(
                temporary / "config.json", {"schema": SCHEMA, "digest": self.digest, **sizes}
            )
            write_checksums(temporary)

    @staticmethod
    def load(folder: Path | str) -> "ExpertPolicy":
        """Read an expert that `save` wrote; StateError where a file is missing or changed."""
        folder = Path(folder)
        verify_checksums(folder, "expert")
        hint = f"remove {folder} and train the expert again"
        try:
            config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            arrays = load_file(folder / "expert.safetensors")
        except (OSError, ValueError, SafetensorError) as error:
            raise StateError(f"expert {folder} cannot be read: {error}", hint) from None
        if config.get("schema") != SCHEMA:
            found = config.get("schema")
            raise StateError(f"expert {folder} has schema {found!r}; {SCHEMA} is readable", hint)
        return _from_arrays(arrays, depth=len(config["hidden"]) + 1)


def _to_arrays(policy: ExpertPolicy) -> dict[str, np.ndarray]:
    arrays = {
        field.name: np.asarray(getattr(policy, field.name))
        for field in fields(policy)
        if field.name != "layers"
    }
    for index, (weights, bias) in enumerate(policy.layers):
        arrays[f"layers.{index}.weights"] = np.ascontiguousarray(weights)
        arrays[f"layers.{index}.bias"] = np.ascontiguousarray(bias)
    return arrays


def _from_arrays(arrays: dict[str, np.ndarray], depth: int) -> ExpertPolicy:
    layers = tuple(
        (jnp.asarray(arrays[f"layers.{i}.weights"]), jnp.asarray(arrays[f"layers.{i}.bias"]))
        for i in range(depth)
    )
    names = [field.name for field in fields(ExpertPolicy) if field.name != "layers"]
    rest: dict[str, Any] = {name: jnp.asarray(arrays[name]) for name in names}
    return ExpertPolicy(layers=layers, **rest)


class MixtureActor:
    """A random expert per episode, acting by sampling; see `mixture_actor`.

    `expert_ids` names the experts (their digests); `expert_of(episode)` tells which one of them
    acts in an episode.
    """

    def __init__(self, experts: Sequence[ExpertPolicy], seed: int, policy_std: float = 1.0) -> None:
        if not experts:
            raise UsageError("a mixture needs at least one expert, got none")
        sizes = {(expert.obs_dim, expert.action_dim) for expert in experts}
        if len(sizes) > 1:
            raise UsageError(
                f"the experts of a mixture differ in (obs_dim, action_dim): {sorted(sizes)}",
                "mix experts of one task only",
            )
        self.experts = tuple(experts)
        self.seed = seed
        self.policy_std = policy_std
        self.expert_ids = tuple(expert.digest for expert in experts)
        self._choice_key, self._noise_key = jax.random.split(jax.random.key(seed))

    def expert_of(self, episode: np.ndarray) -> np.ndarray:
        """Return the index of the expert that acts in each episode: (n,) int -> (n,) int32."""
        return _in_tiles(
            lambda part: _choose(self._choice_key, part, len(self.experts)),
            np.asarray(episode, np.uint32),
        )

    def __call__(self, obs: np.ndarray, episode: np.ndarray, tick: np.ndarray) -> np.ndarray:
        """Return physical actions (n, A) float32 for obs (n, O), episode (n,), tick (n,)."""
        keys = (self._choice_key, self._noise_key)
        return _in_tiles(
            partial(_mixture_actions, self.experts, keys, self.policy_std),
            np.asarray(obs, np.float32),
            np.asarray(episode, np.uint32),
            np.asarray(tick, np.uint32),
        )


def mixture_actor(
    experts: Sequence[ExpertPolicy], seed: int, policy_std: float = 1.0
) -> MixtureActor:
    """Return an actor `(obs (n, O), episode (n,), tick (n,)) -> actions (n, A)`.

    Each episode gets one expert, uniformly at random; the expert samples its actions, with its
    standard deviation times `policy_std` (0: the action at the mean of u). Both depend on (seed,
    episode, tick) and the row's observation only, bit for bit, whatever the batch: rows go through
    the network in padded tiles of one size. Episodes and ticks must fit in 32 bits.
    """
    return MixtureActor(experts, seed, policy_std)


def _in_tiles(function: Any, *rows: np.ndarray) -> np.ndarray:
    """Apply a function to rows in zero-padded tiles of TILE rows and join what it returns."""
    count = len(rows[0])
    parts = []
    for start in range(0, max(count, 1), TILE):
        tile = [array[start : start + TILE] for array in rows]
        short = TILE - len(tile[0])
        padded = [np.pad(a, [(0, short)] + [(0, 0)] * (a.ndim - 1)) for a in tile]
        parts.append(np.asarray(function(*padded)))
    return np.concatenate(parts)[:count]


def _normals(keys: jax.Array, size: int) -> jax.Array:
    return jax.vmap(lambda key: jax.random.normal(key, (size,)))(keys)


@partial(jax.jit, static_argnums=2)
def _choose(key: jax.Array, episode: jax.Array, count: int) -> jax.Array:
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, episode)
    return jax.vmap(lambda k: jax.random.randint(k, (), 0, count))(keys)


@partial(jax.jit, static_argnums=2)
def _mixture_actions(
    experts: tuple[ExpertPolicy, ...],
    keys: tuple[jax.Array, jax.Array],
    policy_std: float,
    obs: jax.Array,
    episode: jax.Array,
    tick: jax.Array,
) -> jax.Array:
    choice_key, noise_key = keys
    chosen = _choose(choice_key, episode, len(experts))
    per_episode = jax.vmap(jax.random.fold_in, (None, 0))(noise_key, episode)
    noise = _normals(jax.vmap(jax.random.fold_in)(per_episode, tick), experts[0].action_dim)
    if policy_std != 1.0:  # even a factor of 1 would change how the program rounds
        noise = policy_std * noise
    # A few small networks for all rows are cheaper than sorting the rows by expert.
    proposals = jnp.stack([expert.act(obs, noise) for expert in experts])
    return proposals[chosen, jnp.arange(obs.shape[0])]
