"""The pure part of PPO against slow loops and closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.experts import update as ppo

SETTINGS = ppo.UpdateSettings(
    learning_rate=1e-2,
    epochs=4,
    minibatches=2,
    gamma=0.9,
    gae_lambda=0.8,
    rpo_alpha=0.0,
    entropy_weight=0.0,
)


def slow_gae(reward, value, next_value, terminal, done, gamma, lam):
    ticks, worlds = reward.shape
    advantage = np.zeros((ticks, worlds))
    for world in range(worlds):
        for start in range(ticks):
            factor = 1.0
            for t in range(start, ticks):
                bootstrap = 0.0 if terminal[t, world] else next_value[t, world]
                delta = reward[t, world] + gamma * bootstrap - value[t, world]
                advantage[start, world] += factor * delta
                if done[t, world]:
                    break
                factor *= gamma * lam
    return advantage


def test_gae_equals_the_sum_it_stands_for():
    random = np.random.default_rng(0)
    reward, value, next_value = random.normal(size=(3, 20, 5)).astype(np.float32)
    done = random.random((20, 5)) < 0.2
    terminal = done & (random.random((20, 5)) < 0.5)
    fast = ppo.gae(*map(jnp.asarray, (reward, value, next_value, terminal, done)), 0.97, 0.9)
    slow = slow_gae(reward, value, next_value, terminal, done, 0.97, 0.9)
    np.testing.assert_allclose(fast, slow, atol=1e-5)


def test_a_timeout_is_worth_the_value_behind_it_and_a_failure_is_not():
    one = jnp.ones((1, 1))
    timeout = ppo.gae(0 * one, 0 * one, one, one < 0, one > 0, 0.9, 0.95)
    failure = ppo.gae(0 * one, 0 * one, one, one > 0, one > 0, 0.9, 0.95)
    assert float(timeout[0, 0]) == pytest.approx(0.9)
    assert float(failure[0, 0]) == 0.0


def test_running_moments_are_those_of_all_observations():
    obs = np.random.default_rng(1).normal(3.0, 2.0, (300, 4)).astype(np.float32)
    moments = ppo.Statistics(jnp.zeros(()), jnp.zeros(4), jnp.ones(4))
    for part in np.split(obs, [50, 51, 200]):
        moments = ppo.merge(moments, jnp.asarray(part))
    np.testing.assert_allclose(moments.mean, obs.mean(0), rtol=1e-5)
    np.testing.assert_allclose(moments.variance, obs.var(0), rtol=1e-4)
    assert float(moments.total) == 300


def make_learner(seed=0):
    random = np.random.Generator(np.random.Philox(seed))
    return ppo.init_learner(random, 3, 1, (16,), 0.0, SETTINGS)


def test_initial_weights_are_orthogonal():
    (first, _), (last, _) = make_learner().networks.critic
    np.testing.assert_allclose(first @ first.T, 2.0 * np.eye(3), atol=1e-5)
    np.testing.assert_allclose(last.T @ last, np.eye(1), atol=1e-5)


def test_every_epoch_sees_every_row_once():
    draws = ppo.draw(np.random.default_rng(0), 64, 2, SETTINGS)
    assert draws.rows.shape == (8, 32)
    assert draws.shift.shape == (8, 32, 2)
    for epoch in np.asarray(draws.rows).reshape(4, 64):
        assert sorted(epoch) == list(range(64))
    assert np.abs(draws.shift).max() <= 1.0


def make_rollout(reward_of_noise, seed=0):
    random = np.random.default_rng(seed)
    obs, next_obs = random.normal(size=(2, 8, 32, 3)).astype(np.float32)
    noise = random.normal(size=(8, 32, 1)).astype(np.float32)
    every = jnp.ones((8, 32), bool)
    reward = jnp.asarray(reward_of_noise(noise[..., 0]))
    return ppo.Rollout(*map(jnp.asarray, (obs, noise)), reward, jnp.asarray(next_obs), every, every)


def test_updates_move_the_policy_towards_the_reward():
    learner, random = make_learner(), np.random.default_rng(3)
    for seed in range(5):
        rollout = make_rollout(lambda noise: noise, seed)  # larger actions pay
        draws = ppo.draw(random, 8 * 32, 1, SETTINGS)
        learner, metrics = ppo.update(learner, rollout, draws, SETTINGS)
    assert bool(metrics["finite"])
    before = ppo.mlp(make_learner().networks.actor, rollout.obs)
    after = ppo.mlp(learner.networks.actor, rollout.obs)
    assert float(jnp.mean(after - before)) > 0.1


def test_nan_is_noticed():
    rollout = make_rollout(lambda noise: np.where(noise > 2, np.nan, noise))
    draws = ppo.draw(np.random.default_rng(0), 8 * 32, 1, SETTINGS)
    _, metrics = ppo.update(make_learner(), rollout, draws, SETTINGS)
    assert not bool(metrics["finite"])
