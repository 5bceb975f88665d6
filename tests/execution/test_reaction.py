"""Measured reaction: twin worlds, and what a policy of known reaction gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtc_cli.execution.reaction import (
    EPSILON,
    PUSH_M_S,
    PushedWorlds,
    Pushes,
    draw_pushes,
    measured_reaction,
)
from rtc_cli.execution.timeline import timeline
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch

N = 12
SCENE = get_task("cartpole_thrust")


def balance(obs: np.ndarray) -> np.ndarray:
    """Some feedback: actions (n, 2) that react to every component of (n, O)."""
    drive = np.tanh(obs @ np.linspace(-1.0, 1.0, obs.shape[1]))
    return np.stack([drive, -drive], axis=1).astype(np.float32)


def run(worlds: Any, s: int, d: int, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Executed actions (N, ticks, A) of feedback computed at t, used from t + d on for s ticks."""
    plan = timeline(horizon=16, exec_horizon=s, delay=d, ticks=ticks)
    starts = {window.start: window.chunk for window in plan.inferences}
    obs = worlds.reset(np.arange(N))
    chunks, lengths, executed = [balance(obs)], np.zeros(N, np.int64), []
    for tick in range(ticks):
        if tick in starts:
            chunks.append(balance(obs))
        executed.append(chunks[plan.chunk[tick]])
        record = worlds.step(executed[-1][:, None])
        obs, lengths = record.obs, lengths + record.ticks
    return np.stack(executed, axis=1), lengths


@pytest.mark.parametrize(("s", "d"), [(1, 0), (1, 1), (4, 0), (4, 3)])
def test_a_feedback_without_memory_reacts_when_the_timeline_says(s: int, d: int) -> None:
    """From the first observation that shows the push: the wait for an inference, plus d."""
    ticks = 24
    change = np.zeros((N, len(SCENE.bodies), 3))
    change[:, :, 0] = 3.0  # large, so that the first action that can differ does
    pushes = Pushes(np.arange(N, dtype=np.int64) % 5 + 1, change)
    with WorldBatch(SCENE, N) as worlds:
        calm, calm_lengths = run(worlds, s, d, ticks)
        pushed, lengths = run(PushedWorlds(worlds, np.arange(N), pushes), s, d, ticks)
    got = measured_reaction(calm, pushed, pushes, (calm_lengths, lengths))
    observed_at = timeline(horizon=16, exec_horizon=s, delay=d, ticks=64).observed_at
    for row in range(N):
        visible = int(pushes.tick[row]) + 1
        assert got[row] == np.flatnonzero(observed_at >= visible)[0] - visible
    for row in range(N):  # and nothing differs before
        np.testing.assert_array_equal(
            calm[row, : pushes.tick[row] + 1], pushed[row, : pushes.tick[row] + 1]
        )


def test_one_chunk_or_many_pieces_push_alike() -> None:
    change = np.zeros((N, len(SCENE.bodies), 3))
    change[:, :, 0] = PUSH_M_S
    pushes = Pushes(np.arange(N, dtype=np.int64), change)
    actions = np.full((N, 12, SCENE.action_dim), 0.5, np.float32)
    with WorldBatch(SCENE, N) as worlds:
        whole = PushedWorlds(worlds, np.arange(N), pushes)
        whole.reset(np.arange(N))
        first = whole.step(actions)
        pieces = PushedWorlds(worlds, np.arange(N), pushes)
        pieces.reset(np.arange(N))
        total = sum(pieces.step(actions[:, i : i + 1]).ticks for i in range(12))
        last = pieces.step(actions[:, :0])
    np.testing.assert_array_equal(first.ticks, total)
    np.testing.assert_array_equal(first.obs, last.obs)
    np.testing.assert_array_equal(first.status, last.status)


def test_pushes_belong_to_the_episode_and_leave_time_to_react() -> None:
    lengths = np.array([100, 40, 10, 70])
    several = draw_pushes(SCENE, np.array([5, 6, 7, 8]), lengths, 8)
    alone = draw_pushes(SCENE, np.array([7, 8]), lengths[2:], 8)
    np.testing.assert_array_equal(several.tick[2:], alone.tick)
    np.testing.assert_array_equal(several.change[2:], alone.change)
    assert ((several.tick >= 0) & (several.tick <= np.maximum(lengths - 16, 0))).all()
    many = draw_pushes(SCENE, np.arange(2000), np.full(2000, 66), 8)
    assert np.mean(many.tick) == pytest.approx(24.5, abs=1.0)  # uniform on 0..49
    assert np.mean(many.change[:, 0, 0] > 0) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    ("difference", "lengths", "expected"),
    [
        (lambda tick: 2.0 * EPSILON * (tick >= 9), (20, 20), 6.0),
        (lambda tick: 0.5 * EPSILON * (tick >= 9), (20, 20), np.nan),
        (lambda tick: 2.0 * EPSILON * (tick >= 9), (20, 9), np.nan),  # the twin ended before
        (lambda tick: 2.0 * EPSILON * (tick >= 3), (20, 20), 0.0),
    ],
)
def test_definition(
    difference: Callable[[np.ndarray], np.ndarray], lengths: tuple[int, int], expected: float
) -> None:
    calm = np.zeros((1, 20, 2), np.float32)
    pushed = calm.copy()
    pushed[0, :, 1] = difference(np.arange(20))
    pushes = Pushes(np.array([2]), np.zeros((1, 1, 3)))
    both = (np.array([lengths[0]]), np.array([lengths[1]]))
    np.testing.assert_array_equal(measured_reaction(calm, pushed, pushes, both), [expected])
