"""What the tasks with a controller written by hand keep beyond the common contract."""

import numpy as np
import pytest
from episodes import play, still

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.scene import Scene, Status

TASKS = ("cartpole_thrust", "catcher", "lunar_lander")
TIME_CONSTANT_TICKS = 10  # about 0.3 s


@pytest.fixture(params=TASKS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return get_task(request.param)


def test_starts_vary_little(scene):
    with WorldBatch(scene, 256) as worlds:
        obs = worlds.reset(np.arange(256))
    spread = obs.max(axis=0) - obs.min(axis=0)
    assert spread.max() > 0.01
    assert spread.max() < 0.5


def test_the_handwritten_controller_solves_it(scene):
    played = play(scene, get_controller(scene.name), np.arange(40))
    assert played.solved >= 0.9
    # Long enough for delay to matter: five time constants at least.
    solved = played.status == Status.SOLVED
    assert np.median(played.length[solved]) >= 5 * TIME_CONSTANT_TICKS


def test_progress_rises_by_a_metre_and_more(scene):
    played = play(scene, get_controller(scene.name), np.arange(8))
    start, end = scene.progress(played.seen[0]), scene.progress(played.seen[-1])
    assert (end > start + 1.0).all()


def test_doing_nothing_fails(scene):
    assert play(scene, still(scene), np.arange(100)).failed >= 0.97


@pytest.mark.parametrize("sign", [-1, 1])
def test_full_thrust_on_one_side_fails(scene, sign):
    act = np.zeros(scene.action_dim)
    act[0 if sign < 0 else 1] = 1.0
    assert play(scene, lambda obs: np.tile(act, (len(obs), 1)), np.arange(8)).failed == 1.0


@pytest.mark.parametrize("name", ["nonsense", "no such module", "chipmunk"])
def test_a_task_without_a_controller_is_refused(name):
    with pytest.raises(UsageError, match="no controller"):
        get_controller(name)


def test_a_built_in_task_may_lack_a_controller(monkeypatch):
    monkeypatch.delattr("rtc_cli.tasks.library.catcher.controller")
    with pytest.raises(UsageError, match='"catcher" has no controller'):
        get_controller("catcher")
