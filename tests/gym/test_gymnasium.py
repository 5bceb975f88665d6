"""The Gymnasium environments: Gymnasium's own checks, and equality with the worlds beneath."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from level_files import hover, write_level
from toy_scenes import machine

import rtc_cli.gym
from rtc_cli.errors import UsageError
from rtc_cli.gym import TaskEnv, TaskVectorEnv, env_id
from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.scene import Status


def play(env, seed, act):
    """Observations, rewards, and the last step of an episode."""
    obs, info = env.reset(seed=seed)
    seen, rewards, last = [obs], [], (False, False, info)
    while not (last[0] or last[1]):
        obs, reward, *last = env.step(act(obs))
        seen.append(obs)
        rewards.append(reward)
    return np.stack(seen), np.array(rewards), last


@pytest.mark.parametrize("task", list_tasks())
def test_gymnasiums_checker_has_nothing_to_say(task):
    env = gymnasium.make(env_id(task), render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("task", list_tasks())
def test_observations_and_actions_stay_in_their_spaces(task):
    env = TaskEnv(task)
    env.action_space.seed(0)
    seen, rewards, _ = play(env, 0, lambda obs: env.action_space.sample())
    assert all(obs in env.observation_space for obs in seen)
    assert np.isfinite(rewards).all()


def test_ids():
    assert env_id("lunar_lander") == "rtc/LunarLander-v0"
    assert {env_id(task) for task in list_tasks()} <= set(gymnasium.registry)
    by_name = gymnasium.make("rtc/Task-v0", task="catcher")
    assert by_name.unwrapped.scene is gymnasium.make("rtc/Catcher-v0").unwrapped.scene
    assert gymnasium.make("rtc/Task-v0", task=machine()).unwrapped.scene.name == "machine"
    with pytest.raises(UsageError, match="catcher"):
        gymnasium.make("rtc/Task-v0", task="cacher")


def test_kinetix_levels_are_tasks_too(tmp_path):
    path = write_level(tmp_path, hover())
    env = gymnasium.make("rtc/Task-v0", task=f"kinetix:{path}", render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    envs = gymnasium.make_vec("rtc/Task-v0", 3, task=f"kinetix:{path}")
    obs, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(obs[0], env.reset(seed=0)[0])


def test_a_seed_is_the_number_of_the_episode():
    scene, controller = get_task("catcher"), get_controller("catcher")
    env = gymnasium.make("rtc/Catcher-v0")
    seen, rewards, (terminated, truncated, info) = play(
        env, 7, lambda obs: controller(obs[None])[0]
    )
    with WorldBatch(scene, 1) as worlds:
        obs = [worlds.reset([7])]
        for _ in rewards:
            record = worlds.step(controller(obs[-1])[:, None])
            obs.append(record.obs)
    np.testing.assert_array_equal(seen, np.concatenate(obs))
    assert record.status[0] == Status.SOLVED
    assert terminated
    assert not truncated
    assert info == {"status": Status.SOLVED, "is_success": True, "episode_seed": 7}


def test_rewards_are_progress_and_outcome():
    """The sum over an episode is the difference of the potential at its ends, plus the outcome."""
    scene, controller = get_task("catcher"), get_controller("catcher")
    env = TaskEnv("catcher")
    for act, outcome in (
        (lambda obs: controller(obs[None])[0], 1.0),
        (lambda obs: np.ones(2), -1.0),
    ):
        seen, rewards, (terminated, _, _) = play(env, 0, act)
        ends = scene.progress(seen[[0, -1]])
        assert terminated
        assert rewards.sum() == pytest.approx(0.3 * (ends[1] - ends[0]) + outcome, abs=1e-4)
        assert abs(rewards[:-1]).max() < 0.5


def short_machine():
    """A scene in which nothing but time ends an episode so early."""
    return replace(machine(), max_ticks=12)


def test_time_truncates():
    scene = short_machine()
    env = TaskEnv(scene)
    _, rewards, (terminated, truncated, info) = play(env, 0, lambda obs: np.zeros(4))
    assert len(rewards) == scene.max_ticks
    assert truncated
    assert not terminated
    assert info["status"] == Status.TIMEOUT


def test_an_ended_episode_wants_a_reset():
    env = TaskEnv(short_machine())
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4))
    play(env, 0, lambda obs: np.zeros(4))
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4))


def test_pictures():
    env = gymnasium.make("rtc/Catcher-v0", render_mode="rgb_array", render_width=200)
    env.reset(seed=0)
    before = env.render()
    assert before.shape[1:] == (200, 3)
    assert before.dtype == np.uint8
    env.step(np.array([1.0, 0.0]))
    assert (env.render() != before).any()
    with pytest.raises(UsageError, match="rgb_array"):
        TaskEnv("catcher", render_mode="human")


def assert_same(ours, theirs):
    """Equal arrays, in whatever nest of tuples, dicts and object arrays."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            assert_same(ours[key], theirs[key])
    elif isinstance(theirs, tuple) or theirs.dtype == object:
        for mine, reference in zip(ours, theirs, strict=True):
            if reference is None:
                assert mine is None
            else:
                assert_same(mine, reference)
    else:
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_vector_environment_does_what_gymnasiums_own_does(mode):
    """Gymnasium's SyncVectorEnv over single environments is the reference."""
    ours = gymnasium.make_vec(
        "rtc/LunarLander-v0", 5, vectorization_mode="vector_entry_point", autoreset_mode=mode
    )
    theirs = gymnasium.make_vec(
        "rtc/LunarLander-v0", 5, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
    )
    assert isinstance(ours, TaskVectorEnv)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata == theirs.metadata
    assert_same(ours.reset(seed=3), theirs.reset(seed=3))
    ours.action_space.seed(1)
    ends = 0
    for _ in range(120):
        actions = ours.action_space.sample()
        step = ours.step(actions)
        assert_same(step, theirs.step(actions))
        ends += int((step[2] | step[3]).sum())
    assert ends > 5


def test_without_autoreset_ended_worlds_wait_for_the_mask():
    envs = TaskVectorEnv(short_machine(), 3, autoreset_mode="Disabled")
    envs.reset(seed=[4, 5, 6])
    actions = np.zeros((3, 4), np.float32)
    for _ in range(12):
        obs, _, _, truncated, _ = envs.step(actions)
    assert truncated.all()
    with pytest.raises(ResetNeeded):
        envs.step(actions)
    mask = np.array([False, True, False])
    again, infos = envs.reset(seed=[None, 5, None], options={"reset_mask": mask})
    np.testing.assert_array_equal(again[[0, 2]], obs[[0, 2]])
    assert infos["_episode_seed"].tolist() == mask.tolist()
    with pytest.raises(UsageError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.zeros(3, bool)})


def test_what_is_returned_is_the_callers():
    envs = TaskVectorEnv("catcher", 2)
    obs, _ = envs.reset(seed=0)
    obs[:] = 99.0
    other = TaskVectorEnv("catcher", 2)
    other.reset(seed=0)
    actions = np.zeros((2, 2), np.float32)
    first, second = envs.step(actions), other.step(actions)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    first[0][:] = 99.0
    again, wanted = envs.step(actions), other.step(actions)
    np.testing.assert_array_equal(again[0], wanted[0])


def test_the_module_can_be_named_in_front_of_the_id():
    assert (
        gymnasium.make(f"{rtc_cli.gym.__name__}:rtc/Catcher-v0").unwrapped.scene.name == "catcher"
    )
