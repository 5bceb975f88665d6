"""Metrics against a slow loop that follows the definitions word by word."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtc_cli.execution.metrics import Trace, episode_metrics
from rtc_cli.execution.timeline import HOLD, timeline

HZ = 30.0
NAN = float("nan")


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else NAN


def slow(trace: Trace, e: int, s: int, d: int, schedule: str) -> dict[str, float]:
    """The metrics of episode e, one definition at a time."""
    n = int(trace.lengths[e])
    total = trace.actions.shape[1]
    plan = timeline(horizon=8, exec_horizon=s, delay=d, ticks=total + 40, schedule=schedule)
    a = trace.actions[e].astype(float)
    seams, others, seen = [], [], int(plan.chunk[0])
    for t in range(1, n):
        jump = float(np.sqrt(((a[t] - a[t - 1]) ** 2).sum()))
        new = plan.chunk[t] > seen
        (seams if new else others).append(jump)
        seen = max(seen, int(plan.chunk[t]))
    ready = [w.ready for w in plan.inferences][: trace.seam_gap.shape[1]]
    usable = [c for c, tick in enumerate(ready) if tick < n]
    starts = [w.start for w in plan.inferences]
    reactions = [min(t for t in starts if t >= event) - event + d for event in range(1, n)]
    seconds = n / HZ
    return {
        "time_to_success_s": seconds if trace.solved[e] else NAN,
        "throughput_per_min": 60 / seconds if trace.solved[e] else 0.0,
        "seam_jump": mean(seams) / mean(others) if mean(others) > 0 else NAN,
        "seam_gap": mean([trace.seam_gap[e, c] for c in usable if trace.seam_gap[e, c] >= 0]),
        "prefix_error": mean(
            [trace.prefix_error[e, c] for c in usable if trace.prefix_error[e, c] >= 0]
        ),
        "action_delta": mean([float(np.abs(a[t] - a[t - 1]).mean()) for t in range(1, n)]),
        "action_delta2": mean(
            [float(np.abs(a[t] - 2 * a[t - 1] + a[t - 2]).mean()) for t in range(2, n)]
        ),
        "starved_ticks": 0,
        "late_chunks": 0,
        "waiting_ticks": int((plan.chunk[:n] == HOLD).sum()),
        "reaction_ticks": mean([float(r) for r in reactions]),
    }


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.data(), st.sampled_from(["async", "sync"]))
def test_metrics_equal_the_slow_loop(seed: int, s: int, data: st.DataObject, how: str) -> None:
    d = data.draw(st.integers(0, min(s, 8 - s)))
    rng = np.random.default_rng(seed)
    n, ticks = 5, 23
    count = len(timeline(horizon=8, exec_horizon=s, delay=d, ticks=ticks, schedule=how).inferences)
    gap, error = rng.random((2, n, count))
    error[:, rng.random(count) < 0.3] = np.nan
    trace = Trace(
        actions=rng.normal(size=(n, ticks, 3)).astype(np.float32),
        lengths=np.array([1, 2, 3, ticks, rng.integers(1, ticks + 1)]),
        solved=rng.random(n) < 0.5,
        seam_gap=gap,
        prefix_error=error,
    )
    got = episode_metrics(trace, horizon=8, exec_horizon=s, delay=d, schedule=how, control_hz=HZ)
    for e in range(n):
        expected = slow(trace, e, s, d, how)
        assert got.keys() == expected.keys()
        for name, value in expected.items():
            assert got[name][e] == pytest.approx(value, nan_ok=True), name


def test_a_constant_action_has_no_seam() -> None:
    trace = Trace(
        actions=np.ones((1, 10, 2), np.float32),
        lengths=np.array([10]),
        solved=np.array([False]),
        seam_gap=np.zeros((1, 5)),
        prefix_error=np.full((1, 5), np.nan),
    )
    got = episode_metrics(
        trace, horizon=8, exec_horizon=2, delay=1, schedule="async", control_hz=HZ
    )
    assert np.isnan(got["seam_jump"][0])  # nothing changes anywhere: a ratio 0 / 0
    assert got["action_delta"][0] == got["action_delta2"][0] == got["seam_gap"][0] == 0.0
    assert np.isnan(got["prefix_error"][0])
    assert np.isnan(got["time_to_success_s"][0])


def test_a_jump_only_at_hand_overs_is_relative_to_the_rest() -> None:
    # s = 2, d = 1: hand-overs at ticks 1, 3, 5; steps of 3 there, of 1 elsewhere.
    steps = np.array([0, 3, 1, 3, 1, 3], np.float32)
    trace = Trace(
        actions=np.cumsum(steps)[None, :, None],
        lengths=np.array([6]),
        solved=np.array([True]),
        seam_gap=np.zeros((1, 3)),
        prefix_error=np.zeros((1, 3)),
    )
    got = episode_metrics(
        trace, horizon=8, exec_horizon=2, delay=1, schedule="async", control_hz=HZ
    )
    assert got["seam_jump"][0] == pytest.approx(3.0)
    assert got["time_to_success_s"][0] == pytest.approx(0.2)
    assert got["throughput_per_min"][0] == pytest.approx(300.0)
    # Events 1..5 wait 1, 0, 1, 0, 1 ticks and then d = 1.
    assert got["reaction_ticks"][0] == pytest.approx(1.6)
