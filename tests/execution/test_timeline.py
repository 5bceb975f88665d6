"""Properties of the timeline, and the cycle drawn in its docstring, tick by tick."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtc_cli.errors import UsageError
from rtc_cli.execution.timeline import (
    HOLD,
    SCHEDULES,
    Timeline,
    cycle,
    first_inference,
    reaction_ticks,
    timeline,
)


@st.composite
def legal(draw: st.DrawFn) -> dict[str, int]:
    horizon = draw(st.integers(1, 20))
    exec_horizon = draw(st.integers(1, horizon))
    delay = draw(st.integers(0, min(exec_horizon, horizon - exec_horizon)))
    ticks = draw(st.integers(1, 80))
    return {"horizon": horizon, "exec_horizon": exec_horizon, "delay": delay, "ticks": ticks}


def starts(plan: Timeline) -> np.ndarray:
    """Tick at which index 0 of each chunk is due, ``first`` included."""
    return np.array([0, *(window.start for window in plan.inferences)])


def test_async_cycle_by_hand() -> None:
    # H = 8, s = 3, d = 2: overlap[0:2] of the old chunk, then new[2:3].
    plan = timeline(horizon=8, exec_horizon=3, delay=2, ticks=9)
    assert plan.chunk.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert plan.index.tolist() == [0, 1, 2, 3, 4, 2, 3, 4, 2]
    assert [tuple(window) for window in plan.inferences] == [(1, 0, 2), (2, 3, 5), (3, 6, 8)]
    assert plan.handovers.tolist() == [2, 5, 8]


def test_async_with_delay_equal_to_exec_horizon() -> None:
    plan = timeline(horizon=8, exec_horizon=4, delay=4, ticks=9)
    assert plan.chunk.tolist() == [0] * 4 + [1] * 4 + [2]
    assert plan.index.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 4]


def test_oracle_by_hand() -> None:
    # H = 8, s = 3, d = 2: token j of the chunk whose inference starts at t acts at t + d + j.
    plan = timeline(horizon=8, exec_horizon=3, delay=2, ticks=9, schedule="oracle")
    assert plan.chunk.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert plan.index.tolist() == [0, 1, 0, 1, 2, 0, 1, 2, 0]
    assert [tuple(window) for window in plan.inferences] == [(1, 0, 2), (2, 3, 5), (3, 6, 8)]
    assert plan.handovers.tolist() == [2, 5, 8]


def test_oracle_with_delay_equal_to_exec_horizon() -> None:
    plan = timeline(horizon=8, exec_horizon=4, delay=4, ticks=9, schedule="oracle")
    assert plan.chunk.tolist() == [0] * 4 + [1] * 4 + [2]
    assert plan.index.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0]


def test_sync_by_hand() -> None:
    plan = timeline(horizon=8, exec_horizon=3, delay=2, ticks=13, schedule="sync")
    assert plan.chunk.tolist() == [0, 0, 0, HOLD, HOLD, 1, 1, 1, HOLD, HOLD, 2, 2, 2]
    assert plan.index.tolist() == [0, 1, 2, HOLD, HOLD, 0, 1, 2, HOLD, HOLD, 0, 1, 2]
    assert [tuple(window) for window in plan.inferences] == [(1, 3, 5), (2, 8, 10)]
    assert plan.handovers.tolist() == [5, 10]
    assert plan.observed_at.tolist() == [0, 0, 0, -1, -1, 3, 3, 3, -1, -1, 8, 8, 8]


@given(legal(), st.sampled_from(SCHEDULES))
def test_every_tick_has_one_action_of_an_existing_chunk(case: dict[str, int], how: str) -> None:
    plan = timeline(**case, schedule=how)
    assert plan.chunk.shape == plan.index.shape == (case["ticks"],)
    acting = plan.chunk != HOLD
    assert ((plan.index >= 0) == acting).all()
    assert (plan.index < case["horizon"]).all()
    assert plan.chunk.max() <= len(plan.inferences)


@given(legal())
def test_async_index_counts_ticks_since_the_start_of_inference(case: dict[str, int]) -> None:
    plan = timeline(**case)
    assert (plan.index == np.arange(case["ticks"]) - starts(plan)[plan.chunk]).all()
    assert (plan.observed_at == starts(plan)[plan.chunk]).all()


@given(legal())
def test_async_prefix_is_the_running_chunk_at_the_start_of_inference(
    case: dict[str, int],
) -> None:
    """The d actions from t on are the first d of the overlap taken at t, H - s long."""
    plan = timeline(**case)
    for number, start, ready in plan.inferences:
        due = start - starts(plan)[number - 1]
        overlap = [(number - 1, due + i) for i in range(case["horizon"] - case["exec_horizon"])]
        acted = list(zip(plan.chunk.tolist(), plan.index.tolist(), strict=True))[start:ready]
        assert acted == overlap[: len(acted)]
        # Nothing beyond the overlap exists in the running chunk.
        assert all(index < case["horizon"] for _, index in overlap)


@given(legal())
def test_async_chunk_is_used_from_index_d_once_it_is_ready(case: dict[str, int]) -> None:
    plan = timeline(**case)
    for number, start, ready in plan.inferences:
        assert ready - start == case["delay"]
        if ready < case["ticks"]:
            assert (plan.chunk[ready], plan.index[ready]) == (number, case["delay"])
        assert (plan.chunk[:ready] != number).all()


@given(legal())
def test_async_observation_age(case: dict[str, int]) -> None:
    """Ages run from d to d + s - 1; their mean over a cycle is d + (s - 1) / 2."""
    s, d = case["exec_horizon"], case["delay"]
    plan = timeline(**case | {"ticks": d + 4 * s})
    age = (np.arange(d + 4 * s) - plan.observed_at)[d:]
    assert age.min() == d
    assert age.max() == d + s - 1
    assert age.mean() == pytest.approx(d + (s - 1) / 2)


@given(legal())
def test_sync_waits_for_every_chunk_but_the_first(case: dict[str, int]) -> None:
    plan = timeline(**case, schedule="sync")
    waiting = np.zeros(case["ticks"], bool)
    for _, start, ready in plan.inferences:
        waiting[start:ready] = True
    assert ((plan.chunk == HOLD) == waiting).all()
    acting = plan.index[~waiting]
    assert (acting == np.arange(len(acting)) % case["exec_horizon"]).all()


@given(legal(), st.sampled_from(SCHEDULES))
def test_inferences_follow_the_cycle(case: dict[str, int], how: str) -> None:
    plan = timeline(**case, schedule=how)
    each = cycle(case["exec_horizon"], case["delay"], how)
    first = first_inference(case["exec_horizon"], how)
    expected = list(range(first, case["ticks"], each.ticks))
    assert [window.start for window in plan.inferences] == expected
    assert each.hold + each.overlap_stop + each.new_stop - each.new_start == each.ticks


@given(legal(), st.sampled_from(SCHEDULES))
def test_reaction_is_the_first_action_that_could_depend_on_the_event(
    case: dict[str, int], how: str
) -> None:
    s, d, ticks = case["exec_horizon"], case["delay"], case["ticks"]
    plan = timeline(**case | {"ticks": ticks + 3 * (s + d)}, schedule=how)
    got = reaction_ticks(cycle(s, d, how), first_inference(s, how), d, ticks)
    for event in range(1, ticks):
        seen = plan.observed_at >= event
        assert got[event] == np.flatnonzero(seen)[0] - event


def test_unknown_schedule() -> None:
    with pytest.raises(UsageError, match=r'unknown schedule "asinc".*Did you mean "async"'):
        timeline(horizon=8, exec_horizon=2, delay=1, ticks=3, schedule="asinc")


def test_timeline_needs_neither_jax_nor_pymunk() -> None:
    code = (
        "import rtc_cli.execution.timeline, rtc_cli.execution.methods, rtc_cli.execution.metrics,"
        "sys; assert not {'jax', 'pymunk'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
