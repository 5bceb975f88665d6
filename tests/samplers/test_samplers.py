"""Every sampler on fields with known answers, and what all of them promise.

A new sampler is one row of `FAMILY`: the chunk it makes of the constant field, written out by hand.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.guidance import guidance_weight, overlap_weights
from rtc_cli.core.policy import PhysicalActions, PolicyConfig
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, get_sampler, list_samplers

B, H, A, K, OBS = 4, 8, 2, 5, 3
SAMPLERS = ("plain", "pinv", "pinv-detached", "prefix")


def arrays(batch=B):
    return np.random.default_rng(0).normal(size=(2, batch, H, A)).astype(np.float32)


def request(s=3, d=2, delay=None, overlap=True, steps=K, batch=B):
    noise, previous = arrays(batch)
    return ChunkRequest(ChunkGeometry(H, s, d), steps, noise, previous if overlap else None, delay)


def gaussian_field(slope, offset):
    """v = slope x + offset: linear, so every step can be written out."""
    return lambda x, tau: slope * x + offset


def expected_plain(noise, overlap, s, d, slope, offset):
    for _ in range(K):
        noise = noise + (slope * noise + offset) / K
    return noise


def expected_prefix(noise, overlap, s, d, slope, offset):
    chunk = expected_plain(noise, overlap, s, d, slope, offset)
    return np.concatenate([overlap[:, :d], chunk[:, d:]], axis=1)


def expected_guided(noise, overlap, s, d, slope, offset, *, through_velocity):
    x, weights = noise, np.asarray(overlap_weights(H, s, d))[:, None]
    for k in range(K):
        tau = k / K
        v = slope * x + offset
        error = weights * (overlap - (x + (1 - tau) * v))
        jacobian = 1 + (1 - tau) * slope if through_velocity else 1
        x = x + (v + float(guidance_weight(jnp.float32(tau), 5.0)) * jacobian * error) / K
    return x


FAMILY = {
    "plain": expected_plain,
    "prefix": expected_prefix,
    "pinv": lambda *a: expected_guided(*a, through_velocity=True),
    "pinv-detached": lambda *a: expected_guided(*a, through_velocity=False),
}


@pytest.fixture(scope="module")
def policy():
    options = (("channel_hidden", 16), ("channels", 8), ("layers", 1), ("token_hidden", 12))
    return random_policy(PolicyConfig("mixer", options, H, OBS, A))


@functools.partial(jax.jit, static_argnums=0)
def sample(sampler, field, request):
    """The sampler's chunk; compiled once per sampler and shapes, for all tests."""
    return sampler(field, request)


def observations(batch=B):
    return jax.random.normal(jax.random.key(2), (batch, OBS))


def test_every_sampler_has_a_known_answer():
    assert set(FAMILY) == set(SAMPLERS) <= set(list_samplers())


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize(("slope", "offset"), [(0.0, 0.7), (-0.8, 0.3)])
def test_linear_field(name, slope, offset):
    sampler, field = get_sampler(name), gaussian_field(slope, offset)

    @jax.jit
    def chunk(s, d):
        noise, overlap = arrays()
        return sampler(field, ChunkRequest(ChunkGeometry(H, s, d), K, noise, overlap))

    for s, d in ((1, 0), (3, 2), (4, 4), (8, 0)):
        expected = FAMILY[name](*arrays(), s, d, slope, offset)
        np.testing.assert_allclose(chunk(s, d), expected, atol=1e-5)


def test_converges_to_the_exact_flow():
    """x' = tau: the error of Euler's method is 1 / (2 K)."""
    for steps in (1, 10):
        chunk = get_sampler("plain")(lambda x, tau: tau[..., None], request(steps=steps))
        np.testing.assert_allclose(chunk - arrays()[0], 0.5 - 0.5 / steps, atol=1e-5)


def test_token_times():
    """An opaque field sees its tokens' times: 1 in the prefix, k/K elsewhere."""
    chunk = get_sampler("prefix")(
        lambda x, tau: jnp.where(tau[..., None] == 1, jnp.nan, tau[..., None]), request(d=2)
    )
    np.testing.assert_allclose(chunk[:, 2:] - arrays()[0][:, 2:], 0.4, atol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
def test_table_path_equals_per_token_path(name, policy):
    """One compiled program for all cells, traced s and d, against the opaque field."""
    field, sampler = policy.velocity(observations()), get_sampler(name)

    @jax.jit
    def opaque(field, request):
        return sampler(lambda x, tau: field(x, tau), request)

    programs = set()
    for s, d in ((1, 0), (3, 2), (4, 4)):
        fast, slow = sample(sampler, field, request(s, d)), opaque(field, request(s, d))
        programs.add((sample._cache_size(), opaque._cache_size()))
        np.testing.assert_allclose(fast, slow, atol=1e-5)
        if name == "prefix":
            np.testing.assert_array_equal(fast[:, :d], arrays()[1][:, :d])
    assert len(programs) == 1


@pytest.mark.parametrize("name", SAMPLERS)
def test_delay_per_example(name, policy):
    delay = jnp.array([0, 1, 3, 2], jnp.int32)
    sampler, field = get_sampler(name), policy.velocity(observations())
    together = sample(sampler, field, request(3, 3, delay))
    for example, d in enumerate(delay.tolist()):
        one = sample(sampler, field, request(3, d))
        np.testing.assert_allclose(together[example], one[example], atol=1e-5)
        if name == "prefix":
            np.testing.assert_array_equal(together[example, :d], arrays()[1][example, :d])


@pytest.mark.parametrize("name", SAMPLERS)
def test_exec_horizon_per_example(name, policy):
    """Rows with their own (s, d) get what a request of that (s, d) gets, inside jit and outside."""
    pairs = [(1, 0), (3, 2), (H, 0), (4, 4)]
    own = {
        "exec_horizon": jnp.array([s for s, _ in pairs]),
        "delay": jnp.array([d for _, d in pairs]),
    }
    sampler, field = get_sampler(name), policy.velocity(observations())
    mixed = dataclasses.replace(request(4, 4), **own)
    together = sampler(field, mixed)
    np.testing.assert_allclose(together, sample(sampler, field, mixed), atol=1e-5)
    for example, (s, d) in enumerate(pairs):
        one = sample(sampler, field, request(s, d))
        np.testing.assert_allclose(together[example], one[example], atol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
def test_without_previous_chunk_equals_plain(name, policy):
    field, bare = policy.velocity(observations()), request(1, 0, overlap=False)
    sampler, plain = get_sampler(name), sample(get_sampler("plain"), field, bare)
    np.testing.assert_array_equal(sample(sampler, field, bare), plain)
    if name == "prefix":  # guidance by the soft mask goes beyond d; a prefix of 0 does not
        np.testing.assert_allclose(sample(sampler, field, request(1, 0)), plain, atol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
def test_whole_horizon_executed_leaves_nothing_to_guide(name, policy):
    field, whole = policy.velocity(observations()), request(H, 0)
    plain = sample(get_sampler("plain"), field, whole)
    np.testing.assert_allclose(sample(get_sampler(name), field, whole), plain, atol=1e-6)


@pytest.mark.parametrize("name", SAMPLERS)
def test_overlap_beyond_its_end_is_ignored(name, policy):
    field, clean = policy.velocity(observations()), request(3, 2)
    dirty = dataclasses.replace(clean, overlap=np.array(clean.overlap))
    dirty.overlap[:, H - 3 :] = np.nan
    sampler = get_sampler(name)
    np.testing.assert_array_equal(sample(sampler, field, dirty), sample(sampler, field, clean))


@pytest.mark.parametrize("name", SAMPLERS)
def test_tiles_give_rows_of_their_own(name, policy):
    """130 examples in tiles of 64: each row is what its tile alone gives."""
    sampler = get_sampler(name)
    many, obs = request(batch=130, steps=3), observations(130)
    whole = sample(sampler, policy.velocity(obs), many)
    second = jax.tree.map(lambda leaf: leaf[64:128], (obs, many.noise, many.overlap))
    part = dataclasses.replace(many, noise=second[1], overlap=second[2])
    alone = sample(sampler, policy.velocity(second[0]), part)
    np.testing.assert_allclose(whole[64:128], alone, atol=1e-6)
    in_threads = sampler(policy.velocity(obs), many)
    np.testing.assert_allclose(whole, in_threads, atol=1e-5)
    unrolled = sampler(policy.velocity(obs), many, unroll=True)
    np.testing.assert_allclose(whole, unrolled, atol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_ready_time_table_changes_nothing(name, policy):
    sampler, obs = get_sampler(name), observations()
    table = policy.time_table(sampler.times(K))
    expected = sample(sampler, policy.velocity(obs), request())
    found = sample(sampler, policy.velocity(obs, table), request())
    np.testing.assert_allclose(found, expected, atol=1e-6)
    other = policy.time_table(sampler.times(K + 1))  # of other times: not used
    found = policy.velocity(obs, other).tabulate(sampler.times(K)).conditioning
    jax.tree.map(np.testing.assert_array_equal, found, table.conditioning)


def test_a_ready_time_table_is_used(policy):
    sampler, obs = get_sampler("plain"), observations()
    table = policy.time_table(sampler.times(K))
    doubled = dataclasses.replace(
        table, conditioning=jax.tree.map(lambda t: 2 * t, table.conditioning)
    )
    plain, changed = (sample(sampler, policy.velocity(obs, t), request()) for t in (table, doubled))
    assert float(jnp.abs(plain - changed).max()) > 1e-3


def test_pinv_gradient_against_finite_differences(policy):
    """One step of pinv from tau = 0 against a Jacobian of the denoised chunk by differences."""
    s, d, beta = 3, 2, 1.5
    obs, (noise, overlap) = observations(1), arrays(1)
    field, tau = policy.velocity(obs), jnp.zeros((1, H))
    geometry = ChunkGeometry(H, s, d)
    sampler = get_sampler("pinv", max_guidance_weight=beta)
    chunk = sample(sampler, field, ChunkRequest(geometry, 1, noise, overlap))

    compiled = jax.jit(lambda x: x + field(x, tau))

    def denoise(x):
        return np.asarray(compiled(x))

    weights = np.asarray(overlap_weights(H, s, d))[:, None]
    error = weights * (overlap[0] - denoise(noise)[0])
    correction, step = np.zeros((H, A)), 1e-2
    for i, j in itertools.product(range(H), range(A)):
        unit = np.zeros((1, H, A), np.float32)
        unit[0, i, j] = step
        column = (denoise(noise + unit) - denoise(noise - unit))[0] / (2 * step)
        correction[i, j] = np.sum(error * column)
    np.testing.assert_allclose(chunk[0], denoise(noise)[0] + beta * correction, atol=5e-3)


def test_settings():
    sampler = get_sampler("pinv", mask="linear", max_guidance_weight=2.0, prior_std=0.5)
    assert sampler.settings == {"mask": "linear", "max_guidance_weight": 2.0, "prior_std": 0.5}
    assert sampler == get_sampler("pinv", **sampler.settings)
    assert hash(sampler) == hash(get_sampler("pinv", **sampler.settings))
    assert get_sampler("prefix").settings == {}


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("prefx", {}, 'unknown sampler "prefx". Did you mean "prefix"'),
        ("pinv", {"masks": "exp"}, 'no setting "masks". Did you mean "mask"'),
        ("pinv", {"mask": "exq"}, 'unknown mask "exq". Did you mean "exp"'),
        ("pinv", {"max_guidance_weight": -1.0}, "max_guidance_weight = -1.0.*>= 0"),
        ("pinv", {"prior_std": 0}, "prior_std = 0.*> 0"),
        ("pinv", {"prior_std": float("nan")}, "prior_std = nan"),
        ("plain", {"mask": "exp"}, 'no setting "mask"'),
    ],
)
def test_bad_settings(name, settings, said):
    with pytest.raises(UsageError, match=said):
        get_sampler(name, **settings)


def bad(**changes):
    return dataclasses.replace(request(3, 2), **changes)


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"noise": np.zeros((B, H + 1, A), np.float32)}, UsageError, r"\(B, 8, A\)"),
        ({"noise": np.zeros((B, H, A))}, UsageError, "float64"),
        ({"overlap": np.zeros((B, H, A + 1), np.float32)}, UsageError, "must agree"),
        ({"overlap": None}, UsageError, "delay 2 without an overlap"),
        ({"flow_steps": 0}, UsageError, "flow_steps 0"),
        ({"delay": np.array([0, 1, 2, 3])}, UsageError, r"\[0, 1, 2, 3\] must lie in 0..2"),
        ({"delay": np.zeros(3, np.int32)}, UsageError, r"needed is int32 \(4,\)"),
        ({"exec_horizon": np.ones(3, np.int32)}, UsageError, r"exec_horizon has.*int32 \(4,\)"),
        (
            {"exec_horizon": np.array([2, 3, 7, 3])},
            UsageError,
            "horizon 8, exec_horizon 7, delay 2: delay must be at most",
        ),
        ({"noise": PhysicalActions(jnp.zeros((B, H, A)))}, TypeError, "physical units"),
        ({"overlap": PhysicalActions(jnp.zeros((B, H, A)))}, TypeError, "physical units"),
    ],
)
def test_bad_requests(changes, error, said):
    with pytest.raises(error, match=said):
        get_sampler("plain")(gaussian_field(0.0, 0.0), bad(**changes))
