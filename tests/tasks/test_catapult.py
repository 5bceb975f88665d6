"""The numbers that the docstring of `catapult` gives in place of a time constant."""

from dataclasses import replace

import numpy as np
import pytest

from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.library.catapult import BALL_RADIUS, BASKET_X, BASKET_Y, SWING_RANGE

WORLDS = 256
FALL = -9.81 / 30  # m/s per control step
LEVEL = BASKET_Y + 0.04 + BALL_RADIUS  # of the ball when it meets the basket


def thrown() -> tuple[np.ndarray, np.ndarray]:
    """Flights (n,), control steps, and places (n,), m, where full swings bring the ball down."""
    scene = get_task("catapult")
    ball, path = scene.body_index["ball"], []
    action = np.tile(np.array([SWING_RANGE, 0.0, 0.0], np.float32), (WORLDS, 1, 1))
    with WorldBatch(scene, WORLDS) as worlds:
        worlds.reset(np.arange(WORLDS))
        for _ in range(90):
            worlds.step(action)
            path.append(worlds.states[:, ball])
    flights, places = [], []
    for x, y, vx, vy in np.stack(path, axis=1)[..., :4].transpose(0, 2, 1):
        down = np.flatnonzero((y[1:] < LEVEL) & (y[:-1] >= LEVEL) & (vy[1:] < 0))
        if len(down):
            free = (abs(np.diff(vy) - FALL) < 1e-3) & (abs(np.diff(vx)) < 1e-3)
            flights.append(np.argmin(free[: down[-1]][::-1]))
            places.append(x[down[-1]])
    return np.array(flights), np.array(places)


def test_noise_decides_where_the_ball_comes_down():
    flights, places = thrown()
    assert len(flights) > 0.7 * WORLDS
    assert flights.mean() == pytest.approx(9, abs=0.5)
    assert places.mean() == pytest.approx(0.77, abs=0.05)
    assert places.std() == pytest.approx(0.26, abs=0.04)


@pytest.mark.parametrize(("steps", "way"), [(9, 0.40), (5, 0.14)])
def test_a_basket_at_rest_gets_as_far_as_the_docstring_says(steps, way):
    scene = replace(get_task("catapult"), action_noise=0.0, jitters=())
    push = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (1, steps, 1))
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        worlds.step(push)
        reached = worlds.states[0, scene.body_index["basket"], 0]
    assert reached - BASKET_X == pytest.approx(way, abs=0.01)


def test_the_speed_of_the_basket_decays_in_seven_and_a_half_steps():
    calm = replace(get_task("catapult"), action_noise=0.0, jitters=())
    bodies = tuple(
        replace(body, velocity=(1.0, 0.0)) if body.name == "basket" else body
        for body in calm.bodies
    )
    scene = replace(calm, bodies=bodies)
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        worlds.step(np.zeros((1, 15, scene.action_dim), np.float32))
        left = worlds.states[0, scene.body_index["basket"], 2]
    assert left == pytest.approx(np.exp(-2.0), abs=0.02)
