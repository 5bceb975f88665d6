"""Geometry: the rules, and that traced values pass."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.errors import UsageError


@pytest.mark.parametrize("horizon", [1, 2, 5, 8])
def test_accepts_exactly_the_legal_cells(horizon):
    for s, d in itertools.product(range(-1, horizon + 2), repeat=2):
        legal = 1 <= s <= horizon and 0 <= d <= s and d <= horizon - s
        if legal:
            assert ChunkGeometry(horizon, s, d).overlap == horizon - s
        else:
            with pytest.raises(UsageError):
                ChunkGeometry(horizon, s, d)


@pytest.mark.parametrize("convert", [int, np.int64, np.asarray, jnp.int32])
def test_error_names_the_values_and_what_is_legal(convert):
    with pytest.raises(
        UsageError, match=r"horizon 8, exec_horizon 6, delay 3.*at most.* 2"
    ) as info:
        ChunkGeometry(8, convert(6), convert(3))
    assert "from 3 to 5" in info.value.hint


def test_traced_values_are_not_checked():
    overlap = jax.jit(lambda g: g.overlap)(ChunkGeometry(8, 2, 2))
    assert int(overlap) == 6
    jax.jit(lambda s, d: ChunkGeometry(8, s, d).overlap)(jnp.int32(6), jnp.int32(3))
