"""Results of worlds do not depend on how they are computed: bit for bit, over many resets."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toy_scenes import machine

from rtc_cli.tasks import chipmunk, get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.local import EngineName, LocalBatch

SCENE = machine()
TICKS = 64


def actions_of(seeds: np.ndarray) -> np.ndarray:
    """Actions (n, TICKS, A) that belong to the seeds, wherever these are run."""
    draws = [np.random.default_rng(int(s)).uniform(-1, 1, (TICKS, 4)) for s in seeds]
    return np.array(draws, np.float32)


def rollout(
    seeds: np.ndarray, chunk: int = 8, engine: EngineName = "auto", workers: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Final states, statuses and lengths of episodes."""
    actions = actions_of(seeds)
    with WorldBatch(SCENE, len(seeds), workers=workers, engine=engine) as worlds:
        worlds.reset(seeds)
        ticks = np.zeros(len(seeds), int)
        for first in range(0, TICKS, chunk):
            record = worlds.step(actions[:, first : first + chunk])
            ticks += record.ticks
        return worlds.states, record.status, ticks


def same(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> None:
    for left, right in zip(one, other, strict=True):
        np.testing.assert_array_equal(left, right)


def test_this_pymunk_has_what_the_fast_engine_needs() -> None:
    assert chipmunk.MISSING == ()


@pytest.mark.parametrize("chunk", [8, 3, 1])
def test_fast_engine_equals_the_public_interface(chunk: int) -> None:
    seeds = np.arange(12)
    same(rollout(seeds, chunk, "fast"), rollout(seeds, 8, "public"))


def test_many_resets_equal_new_spaces() -> None:
    used = LocalBatch(SCENE, 4, "fast")
    worlds = np.arange(4)
    for first in range(0, 60, 4):
        seeds = np.arange(first, first + 4)
        actions = actions_of(seeds)
        new = LocalBatch(SCENE, 4, "public")
        for batch in (used, new):
            batch.reset(seeds, worlds)
            batch.step(actions[:, :40], worlds)
        np.testing.assert_array_equal(used.states, new.states)


@pytest.mark.parametrize("n", [1, 7, 30])
def test_batch_size_does_not_matter(n: int) -> None:
    seeds = np.arange(30)
    whole = rollout(seeds)
    same(tuple(part[:n] for part in whole), rollout(seeds[:n]))


def test_order_of_worlds_and_partial_calls_do_not_matter() -> None:
    seeds = np.arange(10)
    actions = actions_of(seeds)
    states, status, _ = rollout(seeds)
    order = np.array([3, 9, 0, 5, 1, 8, 2, 7, 6, 4])
    with WorldBatch(SCENE, 10) as worlds:
        worlds.reset(seeds[order], worlds=order)
        for first in range(0, TICKS, 8):
            for part in (order[:3], order[3:]):
                record = worlds.step(actions[part, first : first + 8], worlds=part)
                assert record.obs.shape == (len(part), SCENE.obs_dim)
        np.testing.assert_array_equal(worlds.states, states)
        np.testing.assert_array_equal(record.status, status[order[3:]])


def test_workers_do_not_matter() -> None:
    seeds = np.arange(9)
    one = rollout(seeds)
    same(one, rollout(seeds, workers=2))
    same(one, rollout(seeds, chunk=48, workers=2))


def test_a_speed_limit_inside_a_chunk_is_chunk_invariant(monkeypatch: pytest.MonkeyPatch) -> None:
    limited = dataclasses.replace(SCENE, max_speed=1.6, max_spin=5.0, bounds=None)
    monkeypatch.setitem(globals(), "SCENE", limited)
    seeds = np.arange(6)
    slow = rollout(seeds, 1, "public")
    same(slow, rollout(seeds, 8, "fast"))
    same(slow, rollout(seeds, 32, "fast"))
    velocities = slow[0][:, :, 2:4]
    assert np.linalg.norm(velocities, axis=2).max() <= 1.6 + 1e-12
    assert np.abs(slow[0][:, :, 5]).max() <= 5.0


def test_observations_at_the_start_equal_across_engines_and_are_finite() -> None:
    seeds = np.arange(5)
    with WorldBatch(SCENE, 5) as fast, WorldBatch(SCENE, 5, engine="public") as public:
        one, other = fast.reset(seeds), public.reset(seeds)
    np.testing.assert_array_equal(one, other)
    assert one.dtype == np.float32
    assert np.isfinite(one).all()


@pytest.mark.parametrize("task", ["cartpole_thrust", "catcher", "lunar_lander"])
def test_built_in_tasks_reset_and_step_alike_in_both_engines(task: str) -> None:
    scene = get_task(task)
    worlds = np.arange(4)
    used = LocalBatch(scene, 4, "fast")
    draws = np.random.default_rng(3).uniform(
        scene.action_low, scene.action_high, (4, 40, scene.action_dim)
    )
    for first in range(0, 24, 4):
        new = LocalBatch(scene, 4, "public")
        for batch in (used, new):
            batch.reset(first + worlds, worlds)
            record = batch.step(draws.astype(np.float32), worlds)
        np.testing.assert_array_equal(used.states, new.states)
        np.testing.assert_array_equal(used.status, new.status)
        assert np.isfinite(record.obs).all()
