"""The numbers that the docstring of `grasp` gives for its time constant."""

from dataclasses import replace

import numpy as np
import pytest

from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.library.grasp import HAND_X
from rtc_cli.tasks.scene import Scene, Status


@pytest.fixture
def calm() -> Scene:
    return replace(get_task("grasp"), action_noise=0.0, jitters=())


def test_the_speed_of_the_cart_decays_in_ten_steps(calm):
    hand = ("cart", "left_finger", "right_finger")
    bodies = tuple(replace(b, velocity=(1.0, 0.0)) if b.name in hand else b for b in calm.bodies)
    scene = replace(calm, bodies=bodies)
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        worlds.step(np.zeros((1, 10, scene.action_dim), np.float32))
        left = worlds.states[0, scene.body_index["cart"], 2]
    assert left == pytest.approx(np.exp(-1.0), abs=0.02)


@pytest.mark.parametrize(("steps", "way"), [(6, 0.32), (2, 0.03)])
def test_a_cart_at_rest_gets_as_far_as_the_docstring_says(calm, steps, way):
    push = np.zeros((1, steps, calm.action_dim), np.float32)
    push[..., [a.name for a in calm.actions].index("push_right")] = 1.0
    with WorldBatch(calm, 1) as worlds:
        worlds.reset([0])
        worlds.step(push)
        reached = worlds.states[0, calm.body_index["cart"], 0]
    assert reached - HAND_X == pytest.approx(way, abs=0.01)


def test_a_hand_that_does_not_move_catches_a_third():
    scene = get_task("grasp")
    with WorldBatch(scene, 256) as worlds:
        worlds.reset(np.arange(256))
        record = worlds.step(np.zeros((256, 60, scene.action_dim), np.float32))
    assert np.mean(record.status == Status.RUNNING) == pytest.approx(0.33, abs=0.05)
