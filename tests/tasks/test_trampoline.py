"""The numbers that the docstring of `trampoline` gives in place of a time constant."""

from dataclasses import replace

import numpy as np
import pytest

from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene

FLIGHT = 9.5  # control steps


@pytest.fixture
def calm() -> Scene:
    """The task without noise and jitter, its ball dropped straight down."""
    scene = get_task("trampoline")
    bodies = tuple(replace(b, velocity=(0.0, 0.0)) for b in scene.bodies)
    return replace(scene, bodies=bodies, action_noise=0.0, jitters=())


def speeds(scene: Scene, worlds: int, ticks: int) -> np.ndarray:
    """Velocities (worlds, ticks + 1, 2) of the ball while nobody acts."""
    ball, seen = scene.body_index["ball"], []
    with WorldBatch(scene, worlds) as batch:
        batch.reset(np.arange(worlds))
        seen.append(batch.states[:, ball, 2:4])
        for _ in range(ticks):
            batch.step(np.zeros((worlds, 1, scene.action_dim), np.float32))
            seen.append(batch.states[:, ball, 2:4])
    return np.stack(seen, axis=1)


def test_a_flight_lasts_nine_or_ten_steps(calm):
    rises = np.flatnonzero(np.diff(speeds(calm, 1, 60)[0, :, 1]) > 0)
    flights = np.diff(rises)
    assert len(flights) >= 5
    assert flights.mean() == pytest.approx(FLIGHT, abs=0.2)


def test_a_cart_at_rest_gets_as_far_as_the_docstring_says(calm):
    push = np.zeros((1, 9, calm.action_dim), np.float32)
    push[..., [a.name for a in calm.actions].index("push_right")] = 1.0
    with WorldBatch(calm, 1) as batch:
        batch.reset([0])
        batch.step(push)
        assert batch.states[0, calm.body_index["cart"], 0] == pytest.approx(0.13, abs=0.01)
        batch.reset([0])
        batch.step(push[:, :5])
        assert batch.states[0, calm.body_index["cart"], 0] == pytest.approx(0.04, abs=0.01)


def test_noise_decides_where_a_bounce_goes():
    ball = speeds(get_task("trampoline"), 512, 12)
    bounced = (np.diff(ball[..., 1]) > 0).argmax(axis=1)
    rows = np.arange(len(ball))
    kick = ball[rows, bounced + 1, 0] - ball[rows, bounced, 0]
    assert kick.std() == pytest.approx(0.36, abs=0.03)
