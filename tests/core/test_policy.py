"""Network and policy: two paths of one function, closed forms of the loss, types of actions."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.core.conditioning import CleanRows
from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import (
    Normaliser,
    PhysicalActions,
    Policy,
    PolicyConfig,
    get_network,
    list_networks,
)
from rtc_cli.errors import UsageError

B, H, OBS, A = 4, 6, 5, 3
OPTIONS = (("channel_hidden", 16), ("channels", 8), ("layers", 2), ("token_hidden", 12))
CONFIG = PolicyConfig("mixer", OPTIONS, H, OBS, A)


@pytest.fixture(scope="module")
def policy():
    return random_policy(CONFIG)


@pytest.fixture(scope="module")
def initial():
    return Policy.init(CONFIG, Normaliser.identity(OBS, A), jax.random.key(0))


@pytest.fixture(scope="module")
def batch():
    draw = np.random.default_rng(1).standard_normal
    obs, actions, noise = (
        jnp.asarray(draw(shape), jnp.float32) for shape in ((B, OBS), (B, H, A), (B, H, A))
    )
    return obs, actions, noise


@jax.jit
def velocity(policy, obs, x, tau):
    return policy.velocity(obs)(x, tau)


@jax.jit
def loss_at(policy, *examples):
    return policy.loss_at(*examples)


@functools.partial(jax.jit, static_argnames="delays")
def gradient_of_loss(policy, *batch, delays):
    def loss_of(params):
        return dataclasses.replace(policy, params=params).loss(*batch, delays)

    return jax.value_and_grad(loss_of)(policy.params)


def test_table_equals_per_token_path(policy, batch):
    obs, x, _ = batch
    times = jnp.array([0.0, 0.3, 0.7, 1.0])
    rows = np.random.default_rng(2).integers(0, 4, (H, B))
    expected = velocity(policy, obs, x, times[rows].T)
    field = jax.jit(lambda policy, x, rows: policy.velocity(obs).tabulate(times)(x, rows))
    got = field(policy, jnp.swapaxes(x, 0, 1), rows)
    assert float(jnp.std(expected)) > 0.1
    np.testing.assert_allclose(jnp.swapaxes(got, 0, 1), expected, atol=1e-5)


@pytest.mark.parametrize("delays", [[3], [0, 2, 5, 8]])
def test_a_clean_prefix_takes_the_rows_that_it_would_look_up(policy, batch, delays):
    obs, x, _ = batch
    times = np.append(np.arange(4) / 4, 1.0)
    prefix = jnp.arange(H)[:, None] < jnp.asarray(delays)
    field = jax.jit(lambda policy, x, rows: policy.velocity(obs).tabulate(times)(x, rows))
    x = jnp.swapaxes(x, 0, 1)
    for own in (0, 3):
        looked_up = jnp.where(prefix, 4, own)
        rows = CleanRows(jnp.int32(own), 4, prefix)
        got, expected = field(policy, x, rows), field(policy, x, looked_up)
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_mixer_is_the_written_out_network(policy, batch):
    """One example in NumPy, double precision, from the definition."""
    obs, x, _ = (np.asarray(value[0], np.float64) for value in batch)
    p = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), policy.params)
    tau = np.linspace(0, 1, H)
    period = 4e-3 * 1000.0 ** np.linspace(0, 1, 4)
    phase = 2 * np.pi * tau[:, None] / period
    e = np.concatenate([np.sin(phase), np.cos(phase)], 1)
    for layer in ("first", "second"):
        e = e @ p["time"][layer]["kernel"] + p["time"][layer]["bias"]
        e = e / (1 + np.exp(-e))
    parts = np.split(e @ p["adaln"]["kernel"] + p["adaln"]["bias"], 14, axis=1)

    def norm(h):
        return (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-6)

    def gelu(z):
        return 0.5 * z * (1 + np.tanh(np.sqrt(2 / np.pi) * (z + 0.044715 * z**3)))

    joined = np.concatenate([x, np.tile(obs, (H, 1))], 1)
    h = joined @ p["input"]["kernel"] + p["input"]["bias"]
    for i in range(2):
        block, (s1, b1, g1, s2, b2, g2) = p[f"block_{i}"], parts[6 * i : 6 * i + 6]
        z = norm(h) * (1 + s1) + b1
        h = h + g1 * (block["token_out"] @ gelu(block["token_in"] @ z))
        z = norm(h) * (1 + s2) + b2
        h = h + g2 * (gelu(z @ block["channel_in"]) @ block["channel_out"])
    v = (norm(h) * (1 + parts[12]) + parts[13]) @ p["output"]["kernel"] + p["output"]["bias"]
    got = velocity(policy, *batch[:2], jnp.tile(jnp.asarray(tau, jnp.float32), (B, 1)))
    np.testing.assert_allclose(got[0], v, atol=2e-4)


def test_vjp_against_finite_differences(policy, batch):
    obs, x, direction = batch
    rows = jnp.zeros((1, 1), jnp.int32)

    @jax.jit
    def field(x):
        table = policy.velocity(obs).tabulate(jnp.array([0.4]))
        return jnp.swapaxes(table(jnp.swapaxes(x, 0, 1), rows), 0, 1)

    cotangent = np.random.default_rng(3).standard_normal(x.shape, np.float32)
    (pulled,) = jax.jit(lambda x, cotangent: jax.vjp(field, x)[1](cotangent))(x, cotangent)
    step = 1e-2
    difference = (field(x + step * direction) - field(x - step * direction)) / (2 * step)
    expected = jnp.sum(difference * cotangent, axis=(1, 2))
    np.testing.assert_allclose(jnp.sum(pulled * direction, axis=(1, 2)), expected, atol=2e-3)


def test_loss_is_the_ordinary_mean_without_delay(policy, batch):
    obs, actions, noise = batch
    tau = jnp.array([0.0, 0.2, 0.5, 0.9])
    x = tau[:, None, None] * actions + (1 - tau[:, None, None]) * noise
    v = velocity(policy, obs, x, jnp.broadcast_to(tau[:, None], (B, H)))
    expected = float(jnp.mean((v - (actions - noise)) ** 2))
    valid = jnp.ones((B, H), bool)
    for delay in (None, jnp.zeros(B, jnp.int32)):
        got = loss_at(policy, obs, actions, valid, noise, tau, delay)
        assert float(got) == pytest.approx(expected, rel=1e-5)


def test_loss_with_delays_counts_valid_postfix_elements_only(policy, batch):
    obs, actions, noise = batch
    tau, delay = np.array([0.0, 0.2, 0.5, 0.9], np.float32), np.array([0, 1, 3, 2])
    valid = np.arange(H) < np.array([6, 4, 3, 5])[:, None]
    prefix = np.arange(H) < delay[:, None]
    times = jnp.asarray(np.where(prefix, 1, tau[:, None]), jnp.float32)
    x = times[..., None] * actions + (1 - times[..., None]) * noise
    error = np.asarray(velocity(policy, obs, x, times) - (actions - noise))
    expected = float(np.mean(error[valid & ~prefix] ** 2))
    got = loss_at(policy, obs, actions, valid, noise, jnp.asarray(tau), jnp.asarray(delay))
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_prefix_enters_clean(policy, batch):
    """The prefix's noise changes nothing, and its error does not count."""
    obs, actions, noise = batch
    tau, delay, valid = jnp.full(B, 0.3), jnp.full(B, 2), jnp.ones((B, H), bool)

    def loss(noise):
        return loss_at(policy, obs, actions, valid, noise, tau, delay)

    assert float(loss(noise)) == float(loss(noise.at[:, :2].set(7.0)))
    assert float(loss(noise)) != float(loss(noise.at[:, 2].set(7.0)))


def test_loss_is_zero_when_nothing_counts(policy, batch):
    obs, actions, noise = batch
    tau, none_valid = jnp.full(B, 0.3), jnp.zeros((B, H), bool)
    assert float(loss_at(policy, obs, actions, none_valid, noise, tau, None)) == 0.0
    everything = jnp.full(B, H)
    valid = jnp.ones((B, H), bool)
    assert float(loss_at(policy, obs, actions, valid, noise, tau, everything)) == 0.0


def test_invalid_steps_do_not_reach_the_gradient(policy):
    """A NaN error of a step that does not count leaves loss and gradient finite."""
    from rtc_cli.core.flow import masked_squares

    error = jnp.array([[[1.0], [jnp.nan]]])
    counted = jnp.array([[True, False]])
    (value, number), gradient = jax.value_and_grad(masked_squares, has_aux=True)(error, counted)
    assert (float(value), float(number)) == (1.0, 1.0)
    assert gradient.ravel().tolist() == [2.0, 0.0]


@pytest.mark.parametrize("tile", [1, 2, B])
def test_gradient_in_tiles_is_the_gradient_of_the_loss(policy, batch, tile, monkeypatch):
    obs, actions, _ = batch
    # Unequal numbers of valid steps: a mean of the tiles' means would be wrong.
    valid = jnp.arange(H) < jnp.array([[1], [H], [3], [2]])
    key, delays = jax.random.key(5), DelayDistribution.uniform(range(3))
    monkeypatch.setattr("rtc_cli.core.policy._TILE_ACTIVATIONS", tile * H * 16)
    examples = (obs, actions, valid, key)
    in_tiles = jax.jit(lambda policy, *batch: policy.loss_and_gradient(*batch, delays))
    loss, gradient = in_tiles(policy, *examples)
    expected_loss, expected = gradient_of_loss(policy, *examples, delays=delays)
    np.testing.assert_allclose(loss, expected_loss, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), gradient, expected)


def test_loss_draws_the_same_noise_with_and_without_delays(policy, batch):
    obs, actions, _ = batch
    valid, key = jnp.ones((B, H), bool), jax.random.key(5)
    (plain, plain_gradient), (delayed, delayed_gradient) = (
        gradient_of_loss(policy, obs, actions, valid, key, delays=delays)
        for delays in (None, DelayDistribution.constant(0))
    )
    assert float(plain) == pytest.approx(float(delayed), rel=1e-6)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), plain_gradient, delayed_gradient
    )


def test_initial_adaln_is_zero(initial, batch):
    obs, x, _ = batch
    early, late = (velocity(initial, obs, x, jnp.full((B, H), t)) for t in (0.1, 0.8))
    np.testing.assert_array_equal(early, late)


def test_params_are_a_plain_tree(initial):
    keys = {type(k) for path, _ in jax.tree.leaves_with_path(initial.params) for k in path}
    assert keys == {jax.tree_util.DictKey}
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(initial.params))


def test_normaliser_round_trip():
    rng = np.random.default_rng(0)
    obs, actions = rng.normal(3, 2, (50, OBS)), rng.normal(-1, 5, (50, H, A))
    obs[:, 1] = 4.0
    valid = np.arange(H) < rng.integers(1, H + 1, (50, 1))
    normaliser = Normaliser.from_data(obs, np.where(valid[..., None], actions, 1e6), valid)
    normal = normaliser.observations(obs)
    np.testing.assert_allclose(normal.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(normal.std(0), [1, 0, 1, 1, 1], atol=1e-5)
    np.testing.assert_allclose(normaliser.action_std, actions[valid].std(0), rtol=1e-5)
    physical = PhysicalActions(jnp.asarray(actions, jnp.float32))
    back = normaliser.physical(normaliser.actions(physical))
    np.testing.assert_allclose(back.array, actions, rtol=1e-4, atol=1e-4)


def test_physical_actions_are_no_array():
    normaliser, physical = Normaliser.identity(OBS, A), PhysicalActions(jnp.zeros((2, A)))
    with pytest.raises(TypeError):
        normaliser.physical(physical)
    with pytest.raises(TypeError):
        normaliser.actions(physical.array)
    with pytest.raises(TypeError):
        np.asarray(physical)


def test_networks_by_name():
    assert "mixer" in list_networks()
    with pytest.raises(UsageError, match='Did you mean "mixer"'):
        get_network("mixr")


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [("layrs", 2, 'Did you mean "layers"'), ("layers", 0, "layers = 0"), ("channels", 7, "odd")],
)
def test_network_options(option, value, said):
    config = PolicyConfig("mixer", ((option, value),), H, OBS, A)
    with pytest.raises(UsageError, match=said):
        Policy.init(config, Normaliser.identity(OBS, A), jax.random.key(0))


def test_wrong_shapes(policy, batch):
    obs, actions, _ = batch
    with pytest.raises(UsageError, match=r"\(4, 4\).*\(B, 5\)"):
        policy.velocity(obs[:, 1:])
    with pytest.raises(UsageError, match="actions"):
        policy.loss(obs, actions[:, 1:], jnp.ones((B, H), bool), jax.random.key(0))
