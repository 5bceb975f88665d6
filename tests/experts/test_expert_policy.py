"""Experts on disk and in a mixture."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.errors import StateError, UsageError
from rtc_cli.experts.policy import ExpertPolicy, mixture_actor


def make_expert(seed=0, obs_dim=5, action_dim=2):
    random = np.random.default_rng(seed)
    sizes = (obs_dim, 32, 32, action_dim)
    layers = tuple(
        (
            jnp.asarray(random.normal(size=(a, b)) / np.sqrt(a), jnp.float32),
            jnp.asarray(random.normal(size=b), jnp.float32),
        )
        for a, b in pairwise(sizes)
    )
    return ExpertPolicy(
        layers=layers,
        obs_mean=jnp.asarray(random.normal(size=obs_dim), jnp.float32),
        obs_std=jnp.asarray(random.uniform(0.5, 2.0, obs_dim), jnp.float32),
        log_std=jnp.asarray(random.normal(size=action_dim) * 0.1, jnp.float32),
        action_low=jnp.asarray([-1.0, 0.0][:action_dim], jnp.float32),
        action_high=jnp.asarray([1.0, 2.0][:action_dim], jnp.float32),
    )


def rows(count, seed=0):
    random = np.random.default_rng(seed)
    obs = random.normal(size=(count, 5)).astype(np.float32)
    return obs, random.integers(0, 2**31, count), random.integers(0, 256, count)


def test_samples_stay_within_bounds_and_have_the_stated_spread():
    expert = make_expert()
    keys = jax.random.split(jax.random.key(0), 4000)
    actions = np.asarray(expert.sample(jnp.zeros((4000, 5)), keys))
    assert (actions >= expert.action_low).all()
    assert (actions <= expert.action_high).all()
    u = np.arctanh((actions - expert.action_low) / (expert.action_high - expert.action_low) * 2 - 1)
    np.testing.assert_allclose(u.std(0), np.exp(expert.log_std), rtol=0.05)


def test_saved_and_loaded_expert_is_the_same(tmp_path):
    expert = make_expert()
    expert.save(tmp_path / "expert")
    loaded = ExpertPolicy.load(tmp_path / "expert")
    assert loaded.digest == expert.digest
    same = jax.tree.map(lambda a, b: bool((a == b).all()), expert, loaded)
    assert all(jax.tree.leaves(same))


def test_digests_tell_experts_apart():
    assert make_expert(0).digest != make_expert(1).digest


@pytest.mark.parametrize("name", ["expert.safetensors", "config.json"])
def test_a_flipped_byte_is_refused(tmp_path, name):
    make_expert().save(tmp_path / "expert")
    file = tmp_path / "expert" / name
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(StateError, match=name):
        ExpertPolicy.load(tmp_path / "expert")


def test_a_missing_expert_is_refused(tmp_path):
    with pytest.raises(StateError, match="nowhere"):
        ExpertPolicy.load(tmp_path / "nowhere")


def test_mixture_does_not_depend_on_the_batch():
    actor = mixture_actor([make_expert(0), make_expert(1)], seed=3)
    obs, episode, tick = rows(600)
    whole = actor(obs, episode, tick)
    order = np.random.default_rng(1).permutation(600)
    np.testing.assert_array_equal(actor(obs[order], episode[order], tick[order]), whole[order])
    for count in (1, 7, 64, 300):
        part = actor(obs[:count], episode[:count], tick[:count])
        np.testing.assert_array_equal(part, whole[:count])


def test_mixture_draws_each_expert_alike_and_keeps_it_for_the_episode():
    experts = [make_expert(0), make_expert(1), make_expert(2)]
    actor = mixture_actor(experts, seed=5)
    chosen = actor.expert_of(np.arange(6000))
    counts = np.bincount(chosen, minlength=3)
    assert np.abs(counts - 2000).max() < 5 * np.sqrt(6000 * 2 / 9)
    assert (mixture_actor(experts, seed=6).expert_of(np.arange(6000)) != chosen).any()

    obs = np.zeros((2000, 5), np.float32)
    episode, tick = np.full(2000, 11), np.arange(2000)
    actions = actor(obs, episode, tick)
    expert = experts[int(actor.expert_of(np.array([11]))[0])]
    keys = jax.random.split(jax.random.key(9), 4000)
    reference = np.asarray(expert.sample(jnp.zeros((4000, 5)), keys))
    np.testing.assert_allclose(actions.mean(0), reference.mean(0), atol=0.06)
    np.testing.assert_allclose(actions.std(0), reference.std(0), rtol=0.1)


def test_noise_is_fresh_at_every_tick_and_in_every_episode():
    actor = mixture_actor([make_expert()], seed=0)
    obs = np.zeros((200, 5), np.float32)
    along = actor(obs, np.full(200, 4), np.arange(200))[:, 0]
    across = actor(obs, np.arange(200), np.full(200, 4))[:, 0]
    assert len(np.unique(along)) == 200
    assert abs(np.corrcoef(along[:-1], along[1:])[0, 1]) < 0.25
    assert abs(np.corrcoef(along, across)[0, 1]) < 0.25


def test_policy_std_scales_the_spread_before_the_squashing():
    expert = make_expert()
    obs, episode, tick = rows(300)
    low, high = np.asarray(expert.action_low), np.asarray(expert.action_high)

    def before_squashing(std):
        actions = mixture_actor([expert], seed=2, policy_std=std)(obs, episode, tick)
        return np.arctanh(((actions - low) / (high - low) * 2 - 1).astype(np.float64))

    mean = np.asarray(expert.act(jnp.asarray(obs), jnp.zeros((300, 2))))
    still = mixture_actor([expert], seed=2, policy_std=0.0)(obs, episode, tick)
    np.testing.assert_allclose(still, mean, atol=1e-6)
    # Rows near a bound lose their digits in arctanh.
    inside = (np.abs(before_squashing(1.0)) < 3).all(1)
    assert inside.sum() > 100
    whole = (before_squashing(1.0) - before_squashing(0.0))[inside]
    half = (before_squashing(0.5) - before_squashing(0.0))[inside]
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-3)


def test_mixtures_that_make_no_sense_are_refused():
    with pytest.raises(UsageError, match="at least one"):
        mixture_actor([], 0)
    with pytest.raises(UsageError, match="differ"):
        mixture_actor([make_expert(), make_expert(obs_dim=4)], 0)
