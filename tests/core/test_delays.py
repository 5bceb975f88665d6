"""Delay distributions: probabilities, frequencies, refusals."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.errors import UsageError

CASES = {
    "uniform": (DelayDistribution.uniform(range(5)), [0.2] * 5),
    "exponential": (
        DelayDistribution.exponential(range(5), 1.0),
        [math.exp(-d) * (1 - math.exp(-1)) / (1 - math.exp(-5)) for d in range(5)],
    ),
    "constant": (DelayDistribution.constant(3), [0, 1]),
    "constant 0": (DelayDistribution.constant(0), [1]),
    "weights": (DelayDistribution.weights_((0, 2, 4, 7), (0, 1, 3, 0)), [0, 0.25, 0.75, 0]),
}


@pytest.mark.parametrize("name", CASES)
def test_frequencies(name):
    distribution, expected = CASES[name]
    np.testing.assert_allclose(distribution.weights, expected, atol=1e-12)
    count = 20_000
    drawn = distribution.sample(jax.random.key(0), (count,))
    assert drawn.dtype == jnp.int32
    for delay, p in zip(distribution.support, expected, strict=True):
        share = float(np.mean(np.asarray(drawn) == delay))
        assert abs(share - p) <= 4 * math.sqrt(p * (1 - p) / count)
    assert int(drawn.max()) <= distribution.max


def test_ends_of_the_unit_interval():
    distribution = DelayDistribution.weights_((0, 2, 4, 7), (0, 1, 3, 0))
    below_one = np.nextafter(np.float32(1), np.float32(0))
    assert distribution.quantile(jnp.array([0.0, below_one])).tolist() == [2, 4]


@pytest.mark.parametrize(
    ("support", "weights", "said"),
    [
        ((1, 2), (1, 1), "contain 0"),
        ((0, 2, 1), (1, 1, 1), "increasing"),
        ((0, 0), (1, 1), "increasing"),
        ((), (), "integers"),
        ((0, -1), (1, 1), "integers"),
        ((0, 1.5), (1, 1), "integers"),
        ((0, 1), (1,), "1 weights for 2"),
        ((0, 1), (0, 0), "not all 0"),
        ((0, 1), (1, math.nan), "finite"),
        ((0, 1), (2, -1), ">= 0"),
    ],
)
def test_refusals(support, weights, said):
    with pytest.raises(UsageError, match=said):
        DelayDistribution(support, weights)


def test_is_static():
    draw = jax.jit(lambda key, p: p.sample(key, (3,)), static_argnums=1)
    assert draw(jax.random.key(0), DelayDistribution.constant(2)).tolist() == [2, 2, 2]
