"""Distances between experts against closed forms and numerical integration."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from rtc_cli.experts.diversity import hellinger_distances, mean_distance
from rtc_cli.experts.policy import ExpertPolicy


def expert(mean: list[float], std: list[float], slope: float = 0.0) -> ExpertPolicy:
    """An expert of one observation with mean + slope · observation."""
    size = len(mean)
    weights, bias = jnp.full((1, size), slope), jnp.asarray(mean, jnp.float32)
    return ExpertPolicy(
        layers=((weights, bias),),
        obs_mean=jnp.zeros(1),
        obs_std=jnp.ones(1),
        log_std=jnp.log(jnp.asarray(std, jnp.float32)),
        action_low=-jnp.ones(size),
        action_high=jnp.ones(size),
    )


STATES = np.linspace(-1.0, 1.0, 5, dtype=np.float32)[:, None]


def test_equal_means_and_stds_by_hand() -> None:
    same = [expert([0.3, -1.0], [1.0, 0.5], 2.0)] * 2
    assert hellinger_distances(same, STATES) == pytest.approx(0.0, abs=1e-3)
    apart = [expert([0.0], [1.0]), expert([2.0], [1.0]), expert([0.0], [3.0])]
    found = hellinger_distances(apart, STATES)
    assert found == pytest.approx(found.T)
    assert found[0, 1] == pytest.approx(np.sqrt(1 - np.exp(-(2.0**2) / 8)), rel=1e-5)
    assert found[0, 2] == pytest.approx(np.sqrt(1 - np.sqrt(2 * 3 / 10)), rel=1e-5)
    narrow = hellinger_distances(apart, STATES, policy_std=0.5)
    assert narrow[0, 1] == pytest.approx(np.sqrt(1 - np.exp(-((2.0 / 0.5) ** 2) / 8)), rel=1e-5)
    assert narrow[0, 2] == pytest.approx(found[0, 2], rel=1e-5)
    assert hellinger_distances(apart, STATES, policy_std=0.0).tolist() == [
        [0.0, 1.0, 0.0],
        [1.0, 0.0, 1.0],
        [0.0, 1.0, 0.0],
    ]


def test_two_dimensions_against_integration() -> None:
    def density(mean: list[float], std: list[float]) -> Callable[[float, float], float]:
        law = stats.multivariate_normal(mean, np.diag(np.square(std)))
        return lambda x, y: float(law.pdf([x, y]))

    one, two = ([0.2, -0.1], [1.0, 0.6]), ([-0.7, 0.4], [0.8, 0.9])
    p, q = density(*one), density(*two)
    overlap, _ = integrate.dblquad(lambda y, x: np.sqrt(p(x, y) * q(x, y)), -7, 7, -7, 7)
    found = hellinger_distances([expert(*one), expert(*two)], STATES)[0, 1]
    assert found == pytest.approx(np.sqrt(1 - overlap), abs=1e-4)


def test_the_mean_is_over_pairs_and_over_states() -> None:
    distances = np.array([[0.0, 0.1, 0.2], [0.1, 0.0, 0.6], [0.2, 0.6, 0.0]])
    assert mean_distance(distances) == pytest.approx(0.3)
    assert mean_distance(np.zeros((1, 1))) is None
    pair = [expert([0.0], [1.0], 1.0), expert([0.0], [1.0], -1.0)]
    per_state = [hellinger_distances(pair, state[None])[0, 1] for state in STATES]
    assert hellinger_distances(pair, STATES)[0, 1] == pytest.approx(np.mean(per_state), abs=1e-6)
