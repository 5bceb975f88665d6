"""Looking ahead without noise, and pushing bodies: against worlds that were simply stepped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy_scenes import ball, machine

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

N = 6


def actions_of(scene: Scene, ticks: int, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(3)
    shape = (N, ticks, scene.action_dim)
    return (scale * rng.uniform(scene.action_low, scene.action_high, shape)).astype(np.float32)


@pytest.mark.parametrize("scene", [get_task("lunar_lander"), get_task("catcher"), machine()])
@pytest.mark.parametrize("ticks", [0, 1, 4, 11])
def test_without_noise_the_prediction_is_what_happens(scene: Scene, ticks: int) -> None:
    scene = replace(scene, action_noise=0.0)
    past, future = np.split(actions_of(scene, 13 + ticks), [13], axis=1)
    with WorldBatch(scene, N) as worlds:
        worlds.reset(range(N))
        worlds.step(past)
        predicted = worlds.predict(future)
        happened = worlds.step(future).obs
    np.testing.assert_array_equal(predicted, happened)


def test_worlds_that_were_pushed_or_are_of_different_ages_are_predicted() -> None:
    scene = replace(machine(), action_noise=0.0)
    past, future = np.split(actions_of(scene, 14), [10], axis=1)
    change = np.zeros((1, len(scene.bodies), 3))
    change[:, list(scene.moving), 0] = 0.2
    with WorldBatch(scene, N) as worlds:
        worlds.reset(range(N))
        worlds.step(past)
        worlds.push(change, [2])
        worlds.reset([7, 8], [4, 5])
        worlds.step(past[4:5, :3], [4])
        predicted = worlds.predict(future)
        happened = worlds.step(future).obs
    np.testing.assert_array_equal(np.delete(predicted, 2, axis=0), np.delete(happened, 2, axis=0))
    np.testing.assert_allclose(predicted[2], happened[2], atol=0.05)


@pytest.mark.parametrize("workers", [1, 2])
def test_looking_ahead_changes_nothing(workers: int) -> None:
    scene = machine()
    actions = actions_of(scene, 20)
    seen = []
    for look in (False, True):
        with WorldBatch(scene, N, workers=workers) as worlds:
            worlds.reset(range(N))
            worlds.step(actions[:, :10])
            if look:
                worlds.predict(actions[:, 10:14])
            seen.append((worlds.step(actions[:, 10:]).obs, worlds.states))
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


def test_the_prediction_stops_where_the_episode_would_end() -> None:
    scene = replace(get_task("lunar_lander"), action_noise=0.0)
    falling = np.zeros((N, 120, scene.action_dim), np.float32)
    with WorldBatch(scene, N) as worlds:
        worlds.reset(range(N))
        predicted = worlds.predict(falling)
        record = worlds.step(falling)
        np.testing.assert_array_equal(record.status, Status.FAILED)
        np.testing.assert_allclose(predicted, record.obs, atol=2e-3)
        np.testing.assert_array_equal(worlds.predict(falling), record.obs)  # finished worlds


@pytest.mark.parametrize("workers", [1, 2])
def test_a_push_adds_to_the_velocities_of_its_world_only(workers: int) -> None:
    scene = ball()
    change = np.zeros((1, len(scene.bodies), 3))
    change[0, scene.moving[0]] = (0.5, 0.25, 1.0)
    with WorldBatch(scene, N, workers=workers) as worlds:
        worlds.reset(range(N))
        before = worlds.states
        worlds.push(change, [2])
        np.testing.assert_allclose(
            (worlds.states - before)[2, scene.moving[0]], [0, 0, 0.5, 0.25, 0, 1.0], atol=1e-12
        )
        np.testing.assert_array_equal(np.delete(worlds.states - before, 2, axis=0), 0.0)
        still = np.zeros((N, 3, scene.action_dim), np.float32)
        worlds.step(still)
        moved = worlds.states[2, scene.moving[0]]
    with WorldBatch(scene, N) as worlds:
        worlds.reset(range(N))
        worlds.step(still)
        drift = moved - worlds.states[2, scene.moving[0]]
    # Three control steps of free flight with the extra velocity.
    np.testing.assert_allclose(drift[[0, 1]], [0.05, 0.025], atol=1e-9)


def test_a_push_needs_one_velocity_per_body() -> None:
    with WorldBatch(ball(), 2) as worlds:
        worlds.reset(range(2))
        with pytest.raises(UsageError, match="push of shape"):
            worlds.push(np.zeros((2, 3)))
