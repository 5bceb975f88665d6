"""The contract that every built-in task keeps, whatever trains on it."""

import importlib

import numpy as np
import pytest

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.scene import Role, Scene, Status

TASKS = ("cartpole_thrust", "catcher", "lunar_lander")
EPISODES = 40
TIME_CONSTANT_TICKS = 10  # about 0.3 s


@pytest.fixture(params=TASKS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return get_task(request.param)


def play(scene: Scene, act, episodes: int = EPISODES, first: int = 0):
    """Play every episode to its end: status (n,), length (n,), and all observations."""
    seen = []
    with WorldBatch(scene, episodes) as worlds:
        obs = worlds.reset(np.arange(first, first + episodes))
        length = np.zeros(episodes, int)
        status = np.zeros(episodes, int)
        while (status == Status.RUNNING).any():
            seen.append(obs)
            record = worlds.step(np.asarray(act(obs), np.float32)[:, None])
            obs, status = record.obs, record.status
            length += record.ticks
        assert worlds.invalid_count == 0
    return status, length, np.stack(seen)


def still(scene: Scene):
    return lambda obs: np.zeros((len(obs), scene.action_dim))


def uniform(scene: Scene, seed: int = 0):
    random = np.random.Generator(np.random.Philox(seed))
    size = scene.action_dim
    return lambda obs: random.uniform(scene.action_low, scene.action_high, (len(obs), size))


def test_the_standard_protocol_is_kept(scene):
    assert (scene.max_ticks, scene.control_hz, scene.action_noise) == (256, 30.0, 0.1)
    roles = {shape.role for body in scene.bodies for shape in body.shapes}
    assert {Role.GOAL, Role.TARGET, Role.HAZARD} <= roles
    assert scene.progress_terms


def test_shapes_and_dtypes(scene):
    with WorldBatch(scene, 3) as worlds:
        obs = worlds.reset([0, 1, 2])
        record = worlds.step(np.zeros((3, 2, scene.action_dim), np.float32))
    assert obs.shape == (3, scene.obs_dim)
    assert obs.dtype == np.float32
    assert scene.action_low.shape == scene.action_high.shape == (scene.action_dim,)
    assert record.obs.shape == (3, scene.obs_dim)
    assert scene.progress(obs).shape == (3,)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_observations_stay_finite_and_in_their_declared_range(scene, scale):
    act = uniform(scene)
    _, _, seen = play(scene, lambda obs: scale * (act(obs) - 0.3))
    assert np.isfinite(seen).all()
    low = np.array([c.low for c in scene.components], np.float32)
    high = np.array([c.high for c in scene.components], np.float32)
    assert (seen >= low).all()
    assert (seen <= high).all()


def test_a_seed_decides_the_episode(scene):
    one = play(scene, still(scene), 8, first=5)
    two = play(scene, still(scene), 8, first=5)
    other = play(scene, still(scene), 8, first=50)
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a, b)
    assert not np.array_equal(one[2][0], other[2][0])


def test_starts_vary_little(scene):
    with WorldBatch(scene, 256) as worlds:
        obs = worlds.reset(np.arange(256))
    spread = obs.max(axis=0) - obs.min(axis=0)
    assert spread.max() > 0.01
    assert spread.max() < 0.5


def test_the_handwritten_controller_solves_it(scene):
    status, length, _ = play(scene, get_controller(scene.name))
    assert np.mean(status == Status.SOLVED) >= 0.9
    # Long enough for delay to matter: five time constants at least.
    assert np.median(length[status == Status.SOLVED]) >= 5 * TIME_CONSTANT_TICKS


def test_progress_rises_on_the_way_to_success(scene):
    _, _, seen = play(scene, get_controller(scene.name), 8)
    start, end = scene.progress(seen[0]), scene.progress(seen[-1])
    assert (end > start + 1.0).all()


def test_doing_nothing_fails(scene):
    status, _, _ = play(scene, still(scene), 100)
    assert np.mean(status == Status.SOLVED) <= 0.03
    assert np.mean(status == Status.FAILED) >= 0.97


def test_random_actions_hardly_ever_succeed(scene):
    status, _, _ = play(scene, uniform(scene), 100)
    assert np.mean(status == Status.SOLVED) < 0.15
    assert np.mean(status == Status.FAILED) > 0.5


@pytest.mark.parametrize("sign", [-1, 1])
def test_full_thrust_on_one_side_fails(scene, sign):
    act = np.zeros(scene.action_dim)
    act[0 if sign < 0 else 1] = 1.0
    status, _, _ = play(scene, lambda obs: np.tile(act, (len(obs), 1)), 8)
    assert (status == Status.FAILED).all()


def test_the_description_names_every_observation_and_action(scene):
    text = importlib.import_module(f"rtc_cli.tasks.library.{scene.name}").__doc__
    assert scene.description == text
    for action in scene.actions:
        assert f"| {action.name} |" in text
    for entry in scene.observations:
        assert f"| {entry.label}" in text


def test_a_task_without_a_controller_is_refused():
    with pytest.raises(UsageError, match="no controller"):
        get_controller("nonsense")
