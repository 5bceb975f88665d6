"""Estimators against closed forms and a slow loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from slow_clock import estimate

from rtc_cli.errors import UsageError
from rtc_cli.execution.estimators import read_estimator

DELAYS = np.array([[3, 0, 1, 5, 2, 2, 0]])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("exact", [3, 0, 1, 5, 2, 2, 0]),
        ("constant:4", [4] * 7),
        ("max-of-last:1", [9, 3, 0, 1, 5, 2, 2]),
        ("max-of-last:2", [9, 3, 3, 1, 5, 5, 2]),
        ("max-of-last:10", [9, 3, 3, 3, 5, 5, 5]),
        ("percentile:1", [9, 3, 3, 3, 5, 5, 5]),
        ("percentile:0.5", [9, 3, 0, 1, 1, 2, 2]),
    ],
)
def test_by_hand(text: str, expected: list[int]) -> None:
    assert read_estimator(text).estimates(DELAYS, before=9).tolist() == [expected]


@given(
    st.lists(st.integers(0, 9), min_size=1, max_size=40),
    st.sampled_from(["max-of-last:3", "percentile:0.95", "percentile:0.7", "percentile:0.1"]),
)
def test_nothing_of_the_future_is_known(delays: list[int], text: str) -> None:
    told = read_estimator(text).estimates(np.array([delays]), before=7)[0]
    expected = [estimate(text, delays[:k], delays[k], 7) for k in range(len(delays))]
    assert told.tolist() == expected


def test_a_constant_sequence_is_told_exactly() -> None:
    delays = np.full((3, 20), 2)
    for text in ("exact", "max-of-last:10", "percentile:0.95", "constant:2"):
        assert (read_estimator(text).estimates(delays, before=2) == 2).all()


def test_a_percentile_of_a_known_law() -> None:
    """Of independent delays, the share at most the estimate tends to the percentile."""
    delays = np.random.default_rng(0).integers(0, 100, (200, 400))
    told = read_estimator("percentile:0.95").estimates(delays, before=0)[:, 300:]
    assert np.mean(delays[:, 300:] <= told) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("text", ["exact", "max-of-last:10", "percentile:0.95", "constant:3"])
def test_text_and_back(text: str) -> None:
    assert read_estimator(text).text == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("exact:1", 'unknown estimator "exact:1"'),
        ("mean", 'unknown estimator "mean".*Allowed: exact, max-of-last, percentile, constant'),
        ("percentil:0.9", 'Did you mean "percentile"'),
        ("max-of-last:0", '"0" is not a whole number above 0'),
        ("max-of-last", '"" is not a whole number above 0'),
        ("percentile:95", '"95" is not a share above 0 and up to 1'),
        ("percentile:0", '"0" is not a share'),
        ("constant:-1", '"-1" is not a whole number of control steps'),
        ("constant:1.5", '"1.5" is not a whole number'),
    ],
)
def test_bad_estimators_are_named_with_what_is_allowed(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        read_estimator(text)
    assert "write" in caught.value.hint
