"""The explanation of guidance, on policies whose guided chunk is known in closed form."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.analysis import explain as module
from rtc_cli.analysis.explain import Seam, explain, recorded_seams
from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import PolicyConfig
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, get_sampler

H, S, D, K = 8, 4, 2, 5


@pytest.fixture(scope="module")
def policy():
    sizes = (("layers", 1), ("channels", 8), ("channel_hidden", 8), ("token_hidden", 4))
    return random_policy(PolicyConfig("mixer", sizes, H, 5, 6))


@pytest.fixture(scope="module")
def seam(policy):
    draw = np.random.default_rng(0).standard_normal
    observations = draw((6, policy.config.obs_dim)).astype(np.float32)
    overlap = draw((6, H, policy.config.action_dim)).astype(np.float32)
    overlap[:, H - S :] = 0
    return Seam(jnp.asarray(observations), jnp.asarray(overlap), ChunkGeometry(H, S, D))


@pytest.fixture(scope="module")
def found(policy, seam):
    samplers = [(name, get_sampler(name)) for name in ("plain", "pinv", "prefix")]
    return explain(policy, seam, samplers, flow_steps=K)


def rows(found, sampler):
    return [row for row in found["steps"] if row["sampler"] == sampler]


def test_the_weights_are_the_published_ones(found):
    """K = 5, beta = 5: unclipped infinity, 4.25, 2.17, 2.17, 4.25; only the first is clipped."""
    free = [row["weight_unclipped"] for row in rows(found, "pinv")]
    assert free[0] is None
    assert free[1:] == pytest.approx([4.25, 2.1667, 2.1667, 4.25], abs=1e-3)
    assert [row["clipped"] for row in rows(found, "pinv")] == [True, False, False, False, False]
    assert {row["weight"] for row in rows(found, "plain")} == {None}


def test_a_step_begins_where_the_last_one_ended(found):
    for sampler in ("plain", "pinv", "prefix"):
        mine = rows(found, sampler)
        assert [row["tau"] for row in mine] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
        for row, following in itertools.pairwise(mine):
            assert row["prefix_error_after"] == following["prefix_error_before"]


def test_guidance_brings_the_prefix_nearer_and_a_clean_prefix_is_there_at_once(found):
    last = {name: rows(found, name)[-1]["prefix_error_after"] for name in ("plain", "pinv")}
    assert last["pinv"] < 0.5 * last["plain"]
    assert all(row["prefix_error_before"] < 1e-6 for row in rows(found, "prefix"))


def test_the_end_of_the_path_is_the_chunk(policy, seam):
    noise = jnp.asarray(np.random.default_rng(1).standard_normal((6, H, 6)), jnp.float32)
    request = ChunkRequest(seam.geometry, K, noise, seam.overlap)
    for name in ("plain", "pinv", "prefix"):
        sampler = get_sampler(name)

        @jax.jit
        def both(policy, observations, request, sampler=sampler):
            velocity = policy.velocity(observations)
            opaque = sampler.path(lambda x, tau: velocity(x, tau), request)
            return sampler.path(velocity, request), opaque, sampler(velocity, request)

        path, opaque, chunk = both(policy, seam.observations, request)
        assert path.shape == (K + 1, 6, H, 6)
        np.testing.assert_allclose(path[-1], chunk, atol=1e-5)
        np.testing.assert_allclose(opaque, path, atol=2e-4)


def test_the_jump_is_measured_at_the_hand_over(found, policy, seam):
    noise = module._noise(policy, 6, 1)
    request = ChunkRequest(seam.geometry, K, noise, seam.overlap)
    chunk = jax.jit(get_sampler("plain").__call__)(policy.velocity(seam.observations), request)
    jump = np.linalg.norm(np.asarray(chunk[:, D] - seam.overlap[:, D - 1]), axis=-1).mean()
    mine = next(row for row in found["seams"] if row["sampler"] == "plain")
    assert mine["jump"] == pytest.approx(jump, rel=1e-4)


def test_recorded_seams_stay_within_episodes(policy):
    lengths = np.array([S, S + 3], np.int32)  # the first has no pair
    obs = np.zeros((lengths.sum(), policy.config.obs_dim), np.float32)
    obs[:, 0] = np.arange(len(obs))
    seams = recorded_seams(policy, obs, lengths, ChunkGeometry(H, S, D), count=60)
    assert sorted(set(np.asarray(seams.observations[:, 0]).tolist())) == [
        2 * S,
        2 * S + 1,
        2 * S + 2,
    ]
    with pytest.raises(UsageError, match="longer than s"):
        recorded_seams(policy, obs, lengths, ChunkGeometry(H, 7, 1), count=4)


def test_delay_zero_has_no_prefix(policy, seam):
    with pytest.raises(UsageError, match="no prefix"):
        explain(policy, Seam(seam.observations, seam.overlap, ChunkGeometry(H, S, 0)), [])
