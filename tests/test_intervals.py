"""Intervals against closed forms, published values and simulated coverage."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rtc_cli.errors import UsageError
from rtc_cli.intervals import (
    DelayTolerance,
    Interval,
    d90,
    equivalent,
    paired_by_episode,
    paired_by_seed,
    ratio_by_episode,
    ratio_by_seed,
    wilson,
)


def test_wilson_against_published_values() -> None:
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3: 81/263, 15/148, 0/20, 1/29.
    for successes, n, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        interval = wilson(successes, n)
        assert interval.low == pytest.approx(low, abs=5e-5)
        assert interval.high == pytest.approx(high, abs=5e-5)
        assert interval.estimate == successes / n


@given(st.integers(1, 3000), st.data())
def test_wilson_ends_solve_the_score_equation(n: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, n))
    estimate, low, high = wilson(successes, n)
    assert 0.0 <= low <= estimate <= high <= 1.0
    for end in (low, high):
        if 0.0 < end < 1.0:
            score = (estimate - end) ** 2 / (end * (1 - end) / n)
            assert score == pytest.approx(1.959964**2, rel=1e-4)


def test_wilson_edges() -> None:
    assert np.isnan(wilson(0, 0)).all()
    assert wilson(5, 5).high == 1.0
    # Field note: 2048 trials give a half-width of about 2.2 points at p = 0.5.
    interval = wilson(1024, 2048)
    assert (interval.high - interval.low) / 2 == pytest.approx(0.0216, abs=1e-4)
    with pytest.raises(UsageError, match="3 successes of 2 episodes"):
        wilson(3, 2)


def test_one_task_is_the_paired_t_test() -> None:
    differences = np.array([0.03, 0.11, -0.02, 0.07, 0.05])
    got = paired_by_seed(differences)
    expected = stats.ttest_1samp(differences, 0.0).confidence_interval(0.95)
    assert got.estimate == pytest.approx(differences.mean())
    assert (got.low, got.high) == pytest.approx((expected.low, expected.high))


def test_paired_by_seed_by_hand() -> None:
    # var_k = 0.02 and 0.08 with R = 2, G = 2: se = sqrt(0.1 / 2) / 2; t(0.975, 2) = 4.302653.
    got = paired_by_seed([[0.1, 0.3], [0.0, 0.4]])
    half = 4.302653 * np.sqrt(0.1 / 2) / 2
    assert got == pytest.approx((0.2, 0.2 - half, 0.2 + half), rel=1e-6)


def test_one_seed_gives_no_interval_over_seeds() -> None:
    got = paired_by_seed([[0.1], [0.3]])
    assert got.estimate == pytest.approx(0.2)
    assert np.isnan([got.low, got.high]).all()


def test_paired_by_seed_covers() -> None:
    """3 tasks of different means and spreads, 5 seeds: the interval covers 95%."""
    rng = np.random.default_rng(0)
    means, spreads = np.array([[0.0], [0.1], [-0.05]]), np.array([[0.02], [0.03], [0.025]])
    hits = 0
    for _ in range(2000):
        got = paired_by_seed(means + spreads * rng.normal(size=(3, 5)))
        hits += got.low <= means.mean() <= got.high
    assert 0.935 <= hits / 2000 <= 0.97


def test_paired_by_episode() -> None:
    one = np.array([1, 0, -1, 0, 1, 1, 0, 0.0])
    two = np.array([0, 0, 1, 0.0])
    got = paired_by_episode([one, two])
    error = np.sqrt(one.var(ddof=1) / 8 + two.var(ddof=1) / 4) / 2
    assert got.estimate == pytest.approx((0.25 + 0.25) / 2)
    assert got.high - got.estimate == pytest.approx(1.959964 * error)
    assert np.isnan(paired_by_episode([np.array([1.0])]).low)
    with pytest.raises(UsageError):
        paired_by_episode([])


def test_paired_by_episode_covers_for_these_checkpoints() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(1000):
        both = rng.random((2, 200, 2)) < np.array([[[0.8, 0.7]], [[0.5, 0.3]]])
        got = paired_by_episode(both[..., 0].astype(float) - both[..., 1])
        hits += got.low <= 0.15 <= got.high
    assert 0.93 <= hits / 1000 <= 0.97


def seed_differences(
    rng: np.random.Generator, tasks: int, seeds: int, whole: float, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Numerators and denominators whose means have the ratio `share`; they share a baseline."""
    means = np.linspace(0.4, 1.6, tasks)[:, None] * whole
    spreads = np.linspace(0.02, 0.05, tasks)[:, None]
    baseline, top, own = spreads * rng.normal(size=(3, tasks, seeds))
    return share * means + own - baseline, means + top - baseline


def test_a_ratio_by_hand() -> None:
    # One task, two seeds: n = 2, d = 4, var/R = 0.01, 0.04, cov/R = 0.02 (d = 2 n exactly), so
    # every seed has the ratio 1/2 and the interval is that point.
    got = ratio_by_seed([1.9, 2.1], [3.8, 4.2])
    assert got == pytest.approx((0.5, 0.5, 0.5), abs=1e-9)
    # Denominators without spread: the interval of the numerator, divided.
    part = paired_by_seed([0.1, 0.2, 0.4])
    ratio = ratio_by_seed([0.1, 0.2, 0.4], [0.5] * 3)
    assert ratio == pytest.approx([end / 0.5 for end in part])


@given(st.integers(0, 10_000), st.floats(-0.2, 0.2))
def test_the_ratio_has_ends_exactly_where_the_denominator_excludes_zero(
    seed: int, whole: float
) -> None:
    parts, wholes = seed_differences(np.random.default_rng(seed), 3, 4, whole, 0.5)
    denominator = paired_by_seed(wholes)
    ratio = ratio_by_seed(parts, wholes)
    excludes = denominator.low > 0 or denominator.high < 0
    assert np.isfinite([ratio.low, ratio.high]).all() == excludes
    if excludes:
        assert ratio.low <= ratio.estimate <= ratio.high
        # Its ends are the ratios r for which 0 is just inside the interval of part - r whole.
        for end in (ratio.low, ratio.high):
            edge = paired_by_seed(parts - end * wholes)
            assert min(abs(edge.low), abs(edge.high)) == pytest.approx(0, abs=1e-6 * (1 + end**2))


@pytest.mark.parametrize(("tasks", "seeds", "whole"), [(12, 3, 0.2), (3, 5, 0.2), (1, 3, 0.3)])
def test_the_ratio_covers(tasks: int, seeds: int, whole: float) -> None:
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(1500):
        got = ratio_by_seed(*seed_differences(rng, tasks, seeds, whole, 0.7))
        if np.isfinite(got.low):
            hits.append(got.low <= 0.7 <= got.high)
    assert len(hits) > 1000
    assert 0.935 <= np.mean(hits) <= 0.97


def test_the_ratio_covers_for_these_checkpoints() -> None:
    """Two tasks of 200 paired episodes: naive .5, oracle .8, a method that recovers two thirds."""
    rng = np.random.default_rng(3)
    hits = []
    for _ in range(1500):
        shared = rng.random((2, 200, 1)) < 0.5  # half of the episodes have one luck for all three
        draws = np.where(shared, rng.random((2, 200, 1)), rng.random((2, 200, 3)))
        naive, method, oracle = np.moveaxis(draws < [0.5, 0.7, 0.8], 2, 0).astype(float)
        got = ratio_by_episode(list(method - naive), list(oracle - naive))
        hits.append(got.low <= 2 / 3 <= got.high)
    assert 0.935 <= np.mean(hits) <= 0.97


def test_a_ratio_without_replication_has_no_interval() -> None:
    assert ratio_by_seed([[0.1], [0.3]], [[0.4], [0.4]]).estimate == pytest.approx(0.5)
    assert np.isnan(ratio_by_seed([[0.1], [0.3]], [[0.4], [0.4]]).low)
    assert np.isnan(ratio_by_episode([[1.0]], [[1.0]]).low)
    assert np.isnan(ratio_by_seed([0.1, 0.2], [0.0, 0.0]).estimate)
    with pytest.raises(UsageError, match="equal and not empty"):
        ratio_by_seed([0.1, 0.2], [0.1])
    with pytest.raises(UsageError):
        ratio_by_episode([], [])


def test_d90() -> None:
    delays = [0, 1, 2, 3, 4]
    # Level 0.9: between 0.95 at d = 1 and 0.75 at d = 2, a quarter of the way.
    assert d90(delays, [1.0, 0.95, 0.75, 0.5, 0.2], 1.0).value == pytest.approx(1.25)
    assert d90(delays, [0.9, 0.9, 0.8, 0.5, 0.2], 1.0) == DelayTolerance(1.0)
    assert d90(delays, [1.0, 0.8, 0.95, 0.85, 0.2], 1.0).value == pytest.approx(2.5)
    assert d90(delays, [1.0] * 5, 1.0) == DelayTolerance(4.0, ">")
    assert d90(delays, [0.8] * 5, 1.0) == DelayTolerance(0.0, "<")
    assert [str(d) for d in (DelayTolerance(4.0, ">"), DelayTolerance(0.0, "<"))] == ["> 4", "< 0"]
    assert str(DelayTolerance(1.25)) == "1.2"
    with pytest.raises(UsageError, match="increasing"):
        d90([1, 0], [1.0, 1.0], 1.0)


def test_equivalence() -> None:
    assert equivalent(Interval(0.0, -0.01, 0.02), 0.02)
    assert not equivalent(Interval(0.0, -0.03, 0.02), 0.02)
    assert not equivalent(Interval(0.0, np.nan, np.nan), 0.02)
