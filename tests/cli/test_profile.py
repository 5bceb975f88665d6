"""`rtc profile` on a tiny policy: its rows, its statistics and its costs. No test reads a clock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy as weights

from rtc_cli.analysis import profile
from rtc_cli.analysis.networks import random_policy
from rtc_cli.analysis.profile import (
    PER_TOKEN,
    Clock,
    prefix_per_token,
    profile_samplers,
    ratio_interval,
)
from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import PolicyConfig
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, get_sampler

ROW_KEYS = {
    *("network", "sampler", "batch", "horizon", "flow_steps", "compile_s", "p50_ms", "p95_ms"),
    *("p99_ms", "ratio_to_plain", "flops", "bytes", "delay_at_hz", "samples_ms"),
}


@pytest.fixture(scope="module")
def policy():
    sizes = (("layers", 1), ("channels", 8), ("channel_hidden", 8), ("token_hidden", 4))
    return weights(PolicyConfig("mixer", sizes, 4, 5, 2))


@pytest.fixture(scope="module")
def rows(policy):
    return profile_samplers(policy, ["prefix"], batch=(1,), flow_steps=(3,), rounds=4)


def test_rows(rows):
    assert [row["sampler"] for row in rows] == ["plain", "prefix", PER_TOKEN]
    for row in rows:
        assert row.keys() >= ROW_KEYS
        assert len(row["samples_ms"]) == row["rounds"] == 4
        assert row["p50_ms"] == pytest.approx(np.median(row["samples_ms"]))
        assert row["per_step_ms"] == pytest.approx(row["p50_ms"] / 3)
        assert row["delay_at_hz"] == int(np.ceil(row["p95_ms"] * 30 / 1000))
    assert rows[0]["ratio_to_plain"] == rows[0]["ratio_low"] == rows[0]["ratio_high"] == 1.0


def test_per_token_is_the_same_sampler(policy):
    generator = np.random.default_rng(1)
    noise, overlap = generator.standard_normal((2, 3, 4, 2), np.float32)
    request = ChunkRequest(ChunkGeometry(4, 2, 2), 3, noise, overlap)
    velocity = policy.velocity(generator.standard_normal((3, 5), np.float32))
    chunk = jax.jit(prefix_per_token)(velocity, request)
    expected = jax.jit(get_sampler("prefix").__call__)(velocity, request)
    np.testing.assert_allclose(chunk, expected, atol=2e-5)
    assert jnp.array_equal(chunk[:, :2], overlap[:, :2])


def test_random_weights_do_not_leave_adaln_at_zero():
    policy = random_policy("quickstart", 8)
    assert float(jnp.abs(policy.params["adaln"]["kernel"]).max()) > 0
    assert policy.config.horizon == 8


def test_the_ratio_of_a_constant_factor_is_exact():
    baseline = np.random.default_rng(0).lognormal(size=40)
    assert ratio_interval(3 * baseline, baseline) == pytest.approx((3.0, 3.0, 3.0))


def test_the_ratio_interval_covers():
    """Independent lognormal times with ratio 2 of their medians: covered in most of 100 draws."""
    generator = np.random.default_rng(0)
    covered = 0
    for number in range(100):
        plain, other = generator.lognormal(sigma=0.2, size=(2, 50))
        _, low, high = ratio_interval(2 * other, plain, seed=number)
        covered += low <= 2 <= high
    assert covered >= 88


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"samplers": ["pnv"]}, "pnv"),
        ({"samplers": []}, "no sampler"),
        ({"samplers": ["pinv"], "rounds": 1}, "1 rounds"),
        ({"samplers": ["pinv"], "batch": (0,)}, "batch 0"),
        ({"samplers": ["pinv"], "flow_steps": (0,)}, "flow steps 0"),
        ({"samplers": ["pinv"], "horizon": 9}, "horizon 9"),
    ],
)
def test_bad_settings(policy, settings, words):
    with pytest.raises(UsageError, match=words):
        profile_samplers(policy, **settings)


def test_flops_are_those_of_the_steps_written_out(policy, rows):
    """Counted for one and two steps and continued: three steps written out have as many."""
    sampler = get_sampler("prefix")
    noise = jnp.ones((1, 4, 2))

    def chunk(policy, table, observations, noise, s, d):
        request = ChunkRequest(ChunkGeometry(4, s, d), 3, noise, noise)
        return sampler(policy.velocity(observations, table), request, unroll=True)

    arguments = (policy, policy.time_table(sampler.times(3)), jnp.ones((1, 5)), noise)
    compiled = jax.jit(chunk).lower(*arguments, jnp.int32(2), jnp.int32(2)).compile()
    assert rows[1]["flops"] == pytest.approx(compiled.cost_analysis()["flops"], rel=0.02)


def test_fixed_costs_are_part_of_the_delay():
    clock = Clock(hz=50.0, fixed_ms={"vision": 18.0, "prefill": 44.0})
    found = profile._delays(np.full(9, 14.0), 50, clock)
    assert found["total_p50_ms"] == found["total_p95_ms"] == 76.0
    assert [found[f"delay_{name}"] for name in ("ceil", "nearest", "floor")] == [4, 4, 3]
    assert found["delay_at_hz"] == 4
    assert found["chunk_share"] == 4 / 50
    assert found["highest_hz"]["2"] == pytest.approx(2000 / 76)
    with pytest.raises(UsageError, match=r"x is -1\.0 ms"):
        Clock(fixed_ms={"x": -1.0})
