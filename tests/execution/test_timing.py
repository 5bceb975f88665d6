"""The clock of delays that vary, against a slow simulation that follows the definition."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_clock import slow_async, slow_oracle, slow_sync

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.execution.delay_models import constant, read_delay_model
from rtc_cli.execution.estimators import read_estimator
from rtc_cli.execution.metrics import constant_layout
from rtc_cli.execution.timeline import HOLD, SCHEDULES
from rtc_cli.execution.timing import (
    Clock,
    Timing,
    count_inferences,
    make_clock,
    most_inferences,
    plain,
)
from rtc_cli.execution.varying import count_cases

ESTIMATORS = ("exact", "max-of-last:1", "max-of-last:3", "percentile:0.7", "constant:2")


@st.composite
def cases(draw: st.DrawFn) -> dict[str, Any]:
    horizon = draw(st.integers(1, 12))
    exec_horizon = draw(st.integers(1, horizon))
    ticks = draw(st.integers(1, 50))
    longest = draw(st.sampled_from([2, horizon // 2, horizon - 1, horizon + 3]))
    count = count_inferences(exec_horizon, ticks)
    rows = st.lists(st.integers(0, max(longest, 0)), min_size=count, max_size=count)
    delays = np.array(draw(st.lists(rows, min_size=1, max_size=4)))
    return {"horizon": horizon, "exec_horizon": exec_horizon, "ticks": ticks, "delays": delays}


def clock_of(case: dict[str, Any], timing: Timing, schedule: str, **options: Any) -> Clock:
    sizes = {name: case[name] for name in ("horizon", "exec_horizon")}
    return make_clock(case["delays"], timing, schedule=schedule, **sizes, **options)


@settings(max_examples=300, deadline=None)
@given(
    cases(),
    st.sampled_from(ESTIMATORS),
    st.sampled_from(["play", "discard"]),
    st.sampled_from(["play", "clamp"]),
    st.sampled_from([None, 0, 2]),
)
def test_async_equals_the_slow_simulation(
    case: dict[str, Any], estimator: str, on_late: Any, on_exceed: Any, trained: int | None
) -> None:
    timing = Timing(constant(3), read_estimator(estimator), on_late, on_exceed)
    clock = clock_of(case, timing, "async", trained=trained)
    ticks, horizon = case["ticks"], case["horizon"]
    chunk, index = clock.acting(ticks)
    lengths = np.arange(1, len(chunk) + 1).clip(max=ticks)
    counts = count_cases(clock, lengths)
    reaction = clock.reaction(ticks)
    for e, delays in enumerate(case["delays"].tolist()):
        slow = slow_async(
            delays, horizon=horizon, s=case["exec_horizon"], ticks=ticks, estimator=estimator,
            before=3, discard=on_late == "discard", trained=trained, clamp=on_exceed == "clamp",
        )  # fmt: skip
        assert list(zip(chunk[e].tolist(), index[e].tolist(), strict=True)) == slow.acting
        n = len(slow.requests)
        asked = (clock.start, clock.asked_exec_horizon, clock.asked_delay, clock.left)
        assert np.stack([a[e, :n] for a in asked], 1).tolist() == [list(r) for r in slow.requests]
        assert clock.start[e, n] >= ticks
        arrived = clock.arrival[e] < ticks
        assert clock.arrival[e, arrived & clock.late[e]].tolist() == slow.late
        length = int(lengths[e])
        for name, happened in (
            ("dropped_chunks", slow.dropped),
            ("clipped_requests", slow.clipped),
            ("exceeded_requests", slow.exceeded),
        ):
            assert counts[name][e] == sum(tick < length for tick in happened), name
        for event in range(1, ticks):
            answer = [arrival for start, arrival in slow.answers if start >= event]
            if answer:
                assert reaction[e, event] == answer[0] - event
        for s, d in {(s, d) for _, s, d, _ in slow.requests}:
            ChunkGeometry(horizon, s, d)  # every request is legal


@settings(max_examples=100, deadline=None)
@given(cases())
def test_sync_and_oracle_equal_the_slow_simulation(case: dict[str, Any]) -> None:
    ticks, s = case["ticks"], case["exec_horizon"]
    sync, oracle = (clock_of(case, plain(0), how).acting(ticks) for how in ("sync", "oracle"))
    for e, delays in enumerate(case["delays"].tolist()):
        expected = slow_sync(delays, s=s, ticks=ticks)
        assert np.stack(sync, 2)[e].tolist() == [list(pair) for pair in expected]
        expected = slow_oracle(delays, horizon=case["horizon"], s=s, ticks=ticks)
        assert np.stack(oracle, 2)[e].tolist() == [list(pair) for pair in expected]


@given(st.integers(1, 12), st.data(), st.integers(1, 60), st.sampled_from(SCHEDULES))
def test_one_constant_delay_is_the_timeline(
    horizon: int, data: st.DataObject, ticks: int, schedule: str
) -> None:
    s = data.draw(st.integers(1, horizon))
    d = data.draw(st.integers(0, min(s, horizon - s)))
    delays = np.full((1, count_inferences(s, ticks)), d)
    clock = make_clock(delays, plain(d), horizon=horizon, exec_horizon=s, schedule=schedule)
    layout = constant_layout(
        horizon=horizon, exec_horizon=s, delay=d, ticks=ticks, schedule=schedule
    )
    started = layout.ready.shape[1]
    assert (clock.acting(ticks)[0] == layout.chunk).all()
    assert (clock.arrival[:, :started] == layout.ready).all()
    assert (clock.reaction(ticks) == layout.reaction).all()
    assert clock.kept.all()
    assert not (clock.late | clock.clipped | clock.exceeded).any()
    if schedule == "async":
        assert (clock.asked_delay == d).all()
        assert (clock.asked_exec_horizon == s).all()


def test_a_starved_robot_by_hand() -> None:
    # H = 4, s = 2: a chunk takes 6 ticks, is dropped, and the next one takes 1.
    delays = np.array([[6, 1, 1, 1]])
    clock = make_clock(delays, plain(1), horizon=4, exec_horizon=2, schedule="async")
    chunk, index = clock.acting(10)
    assert chunk[0].tolist() == [0, 0, 0, 0, HOLD, HOLD, HOLD, 2, 2, 3]
    assert index[0].tolist() == [0, 1, 2, 3, HOLD, HOLD, HOLD, 1, 2, 1]
    assert clock.start[0].tolist() == [0, 6, 8, 10]
    assert clock.asked_exec_horizon[0].tolist() == [2, 4, 2, 2]
    assert clock.asked_delay[0].tolist() == [2, 0, 1, 1]
    assert clock.kept[0].tolist() == [False, True, True, True]
    assert clock.late[0].tolist() == [True, True, False, False]


def test_an_old_observation_delays_the_reaction() -> None:
    delays = np.full((1, count_inferences(2, 20, lag=3)), 1)
    timing = Timing(constant(1), observation_lag=3)
    sizes: dict[str, Any] = {"horizon": 8, "exec_horizon": 2}
    late = make_clock(delays, timing, schedule="async", **sizes).reaction(20)
    now = make_clock(delays, plain(1), schedule="async", **sizes).reaction(23)
    # An event at tick e shows at tick e + 3.
    assert (late[0, 1:] == now[0, 4:23] + 3).all()


def test_all_cells_find_enough_delays() -> None:
    for s in (1, 3, 8):
        for lag in (0, 2, 1000):
            assert count_inferences(s, 100, lag) <= most_inferences(100)
            assert (count_inferences(s, 100, lag) - 1) * s > 100


def test_what_a_row_and_a_key_say() -> None:
    timing = Timing(read_delay_model("poisson:1.5").capped(7), read_estimator("max-of-last:10"))
    assert timing.columns == {
        "delay_model": "poisson:1.5 cap 7",
        "estimator": "max-of-last:10",
        "on_late": "play",
        "on_exceed": "play",
        "observation_lag": 0,
    }
    assert timing.content["delay_model"] == "poisson:1.5 cap 7"
    assert not timing.is_plain


@pytest.mark.parametrize(
    ("timing", "is_plain"),
    [
        (Timing(constant(2)), True),
        (Timing(read_delay_model("uniform:2")), False),
        (Timing(constant(2), on_late="discard"), True),
        (Timing(constant(2), read_estimator("constant:2")), False),
        (Timing(constant(2), on_exceed="clamp"), False),
        (Timing(constant(2), observation_lag=1), False),
    ],
)
def test_a_constant_delay_that_everybody_knows_is_plain(timing: Timing, is_plain: bool) -> None:
    assert timing.is_plain is is_plain
