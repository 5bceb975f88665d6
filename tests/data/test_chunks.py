"""Chunk windows against a loop that spells them out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtc_cli.data.chunks import windows
from rtc_cli.errors import UsageError


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 12))
def test_windows_are_those_of_a_plain_loop(lengths, horizon):
    actions = np.random.default_rng(0).normal(size=(sum(lengths), 2)).astype(np.float32)
    cut, valid = windows(actions, np.array(lengths), horizon)
    row = 0
    for length in lengths:
        episode = actions[row : row + length]
        for tick in range(length):
            rest = episode[tick : tick + horizon]
            np.testing.assert_array_equal(cut[row, : len(rest)], rest)
            assert (cut[row, len(rest) :] == 0).all()
            assert valid[row].tolist() == [i < len(rest) for i in range(horizon)]
            row += 1
    assert row == len(cut) == len(valid)
    np.testing.assert_array_equal(cut[:, 0], actions)


def test_a_horizon_below_one_is_refused():
    with pytest.raises(UsageError, match="horizon 0"):
        windows(np.zeros((3, 1)), np.array([3]), 0)
