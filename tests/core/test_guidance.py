"""Soft masks and guidance weights: spot values from the papers, and their definition."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.core.guidance import MASKS, guidance_weight, overlap_weights
from rtc_cli.errors import UsageError


def test_spot_values_of_the_exponential_mask():
    weights = overlap_weights(50, 25, 6, "exp")
    assert weights[:6].tolist() == [1.0] * 6
    assert float(weights[6]) == pytest.approx(0.88, abs=0.005)
    assert float(weights[10]) == pytest.approx(0.49, abs=0.005)
    assert weights[25:].tolist() == [0.0] * 25


def defined(h, s, d, mask):
    """The mask written out token by token, in double precision."""
    result = []
    for i in range(h):
        c = (h - s - i) / (h - s - d + 1)
        ramp = {"exp": c * (math.exp(c) - 1) / (math.e - 1), "linear": c, "zeros": 0, "ones": 1}
        result.append(0 if i >= h - s else 1 if i < d else ramp[mask])
    return result


@pytest.mark.parametrize("mask", MASKS)
def test_equals_the_definition_at_every_cell(mask):
    one = jax.jit(lambda s, d: overlap_weights(8, s, d, mask))
    for s in range(1, 9):
        delays = range(min(s, 8 - s) + 1)
        for d in delays:
            np.testing.assert_allclose(one(s, d), defined(8, s, d, mask), atol=1e-6)
        batch = overlap_weights(8, s, jnp.array(delays), mask)
        np.testing.assert_allclose(batch, [defined(8, s, d, mask) for d in delays], atol=1e-6)


def test_unknown_mask():
    with pytest.raises(UsageError, match='Did you mean "linear"'):
        overlap_weights(8, 2, 2, "liner")


def test_guidance_weights_at_five_steps():
    tau = jnp.arange(5) / 5
    np.testing.assert_allclose(
        guidance_weight(tau, math.inf), [math.inf, 4.25, 2 + 1 / 6, 2 + 1 / 6, 4.25], rtol=1e-5
    )
    clipped = guidance_weight(tau, 3.0)
    np.testing.assert_allclose(clipped, [3, 3, 2 + 1 / 6, 2 + 1 / 6, 3], rtol=1e-5)


def test_prior_std():
    tau, sigma = 0.3, 0.4
    r2 = (1 - tau) ** 2 * sigma**2 / ((1 - tau) ** 2 + sigma**2 * tau**2)
    expected = (1 - tau) / (tau * r2)
    assert float(guidance_weight(jnp.float32(tau), 1e9, sigma)) == pytest.approx(expected, rel=1e-5)
    assert float(guidance_weight(jnp.float32(0.0), 7.0, sigma)) == 7.0
