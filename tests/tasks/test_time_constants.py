"""Time constants that docstrings of tasks state, measured as they say."""

import re
from dataclasses import replace

import numpy as np
import pytest
from episodes import Solver, play

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Jitter, Scene, Status


def angles(scene: Scene, body: str, action: list[float], ticks: int) -> np.ndarray:
    """The angle of a body (ticks,) under one held action, without noise."""
    quiet = replace(scene, action_noise=0.0)
    out = []
    with WorldBatch(quiet, 1) as worlds:
        worlds.reset([0])
        for _ in range(ticks):
            worlds.step(np.array([[action]], np.float32))
            out.append(abs(worlds.states[0, scene.body_index[body], 4]))
    return np.array(out)


def test_a_tilt_of_the_unicycle_grows_by_e_in_eleven_ticks():
    scene = get_task("unicycle")
    # So small that only the growing part of the motion is left from 0.06 rad on.
    lean = Jitter(bodies=("mast",), angle=0.02, pivot=(0.0, 0.3))
    tilt = angles(replace(scene, motors=(), jitters=(lean,)), "mast", [0.0], 60)
    grows = np.flatnonzero((tilt > 0.06) & (tilt < 0.35))
    rate = np.polyfit(grows, np.log(tilt[grows]), 1)[0]
    assert 1 / rate == pytest.approx(11, abs=0.5)


def test_one_engine_topples_the_chain_lander_in_eight_ticks():
    scene = replace(get_task("chain_lander"), jitters=())
    tilt = angles(scene, "hull", [0.0, 1.0], 12)
    assert np.flatnonzero(tilt > 0.6)[0] + 1 == 8


def test_jets_pitch_the_flying_car_in_nine_ticks():
    scene = replace(get_task("car_launch"), jitters=())
    bodies = tuple(b if b.static else replace(b, position=_aloft(b.position)) for b in scene.bodies)
    joints = tuple(replace(joint, anchor=_aloft(joint.anchor)) for joint in scene.joints)
    tilt = angles(replace(scene, bodies=bodies, joints=joints), "car", [0.0, 1.0, 0.0], 12)
    assert np.flatnonzero(tilt > 0.6)[0] + 1 == 9


def _aloft(point: tuple[float, float]) -> tuple[float, float]:
    return (point[0] + 5.0, point[1] + 3.0)


def test_the_swimmer_loses_its_speed_in_sixteen_ticks():
    scene = get_task("swimmer")
    bodies = tuple(b if b.static else replace(b, velocity=(1.0, 0.0)) for b in scene.bodies)
    scene = replace(scene, bodies=bodies, action_noise=0.0, jitters=())
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        worlds.step(np.zeros((1, 16, scene.action_dim), np.float32))
        left = worlds.states[0, scene.body_index["head"], 2]
    assert left == pytest.approx(np.exp(-1.0), abs=0.02)


@pytest.mark.parametrize("task", list_tasks())
def test_a_solved_episode_takes_as_long_as_the_docstring_says(task):
    scene = get_task(task)
    text = " ".join(scene.description.split())
    stated = re.search(r"solved episode takes (?:about )?(\d+) control steps", text)
    assert stated
    solver, random = Solver(scene), np.random.default_rng(0)
    played = play(scene, lambda obs: solver.sampled(obs, random), np.arange(64) + 5_000)
    solved = played.status == Status.SOLVED
    assert solved.mean() > 0.7
    assert played.length[solved].mean() == pytest.approx(float(stated[1]), rel=0.2)
