"""Toy data and policies with known answers for the training tests."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.recipe import TrainConfig
from rtc_cli.training.checkpoints import CheckpointMeta


@dataclass(frozen=True)
class Windows:
    observations: np.ndarray
    actions: np.ndarray
    valid: np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinePolicy:
    """Predicts the first action as obs @ w + b from inputs shaken by the key; not a flow policy."""

    params: Any
    normaliser: Normaliser

    def loss(self, observations, actions, valid, key, delays):
        shaken = observations + 0.1 * jax.random.normal(key, observations.shape)
        predicted = shaken @ self.params["w"] + self.params["b"]
        return jnp.mean(jnp.square(predicted - actions[:, 0]) * valid[:, :1])

    def loss_and_gradient(self, *batch):
        def loss_of(params):
            return dataclasses.replace(self, params=params).loss(*batch)

        return jax.value_and_grad(loss_of)(self.params)


@pytest.fixture
def windows() -> Windows:
    rng = np.random.default_rng(7)
    return Windows(
        rng.normal(size=(70, 3)).astype(np.float32),
        rng.normal(size=(70, 4, 2)).astype(np.float32),
        rng.random((70, 4)) < 0.9,
    )


@pytest.fixture
def line() -> LinePolicy:
    params = {"w": jnp.full((3, 2), 0.5), "b": jnp.zeros(2)}
    return LinePolicy(params, Normaliser.identity(3, 2))


@pytest.fixture
def config() -> TrainConfig:
    return TrainConfig(batch=16, epochs=4, learning_rate=0.05, warmup_steps=3)


@pytest.fixture
def policy(windows: Windows) -> Policy:
    """A real policy, as small as possible."""
    sizes = (("layers", 1), ("channels", 8), ("channel_hidden", 8), ("token_hidden", 4))
    normaliser = Normaliser.from_data(windows.observations, windows.actions, windows.valid)
    return random_policy(PolicyConfig("mixer", sizes, 4, 3, 2), normaliser)


@pytest.fixture
def meta(policy: Policy) -> CheckpointMeta:
    return CheckpointMeta(
        task="catcher",
        kind="prefix",
        train_seed=5,
        epoch=0,
        epochs=4,
        config=policy.config,
        normaliser=policy.normaliser,
        delays=DelayDistribution.exponential((0, 1, 2)),
        recipe_hash="abc123",
        scene_digest="def456",
    )


@pytest.fixture
def same_bits():
    """Whether two trees have the same structure and the same bits in every leaf."""

    def same(a: Any, b: Any) -> bool:
        a_leaves, a_structure = jax.tree.flatten(a)
        b_leaves, b_structure = jax.tree.flatten(b)
        pairs = zip(a_leaves, b_leaves, strict=True)
        return a_structure == b_structure and all(
            np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs
        )

    return same


@pytest.fixture
def with_nan():
    """The same windows with a NaN in one observation."""

    def spoil(windows: Windows) -> Windows:
        observations = windows.observations.copy()
        observations[11, 1] = np.nan
        return dataclasses.replace(windows, observations=observations)

    return spoil
