"""Training an expert on a point mass."""

import dataclasses

import numpy as np
import pytest
from pointmass import PointScene, PointWorlds

from rtc_cli.errors import DivergedError
from rtc_cli.experts.ppo import _Sampler, train_expert
from rtc_cli.recipe import ExpertsConfig
from rtc_cli.tasks.reward import shaped_reward
from rtc_cli.tasks.scene import Status

CONFIG = ExpertsConfig(
    worlds=64, rollout_ticks=32, max_steps=60_000, target_success=0.9, hidden=(32, 32)
)


def train(seed=0, scene=None, progress=None, workers=1, **changes):
    config = CONFIG.model_copy(update=changes)
    scene = PointScene() if scene is None else scene
    return train_expert(scene, config, seed, progress, workers, make_worlds=PointWorlds)


def test_ppo_solves_a_point_mass_and_stops_early():
    records = []
    result = train(progress=records.append)
    assert result.success >= 0.75
    assert result.steps < CONFIG.max_steps
    assert records[0]["success"] is None or records[0]["success"] < 0.5
    assert records[-1]["success"] >= 0.9
    assert [record["steps"] for record in records] == [2048 * (i + 1) for i in range(len(records))]


def test_quick_successes_alone_do_not_end_training():
    # A quarter of the episodes cannot be solved and lasts 400 ticks: nearly all of the first to
    # finish are solved, though no policy solves more than three quarters.
    records = []
    scene = PointScene(max_ticks=400, hopeless_every=4)
    result = train(scene=scene, progress=records.append, max_steps=32_000)
    assert max(record["success"] or 0.0 for record in records) >= 0.9
    assert result.steps >= 32_000
    assert result.success <= 0.75


def test_the_result_depends_on_the_seed_only():
    short = {"max_steps": 6000, "target_success": 1.0}
    first, again = train(seed=1, **short), train(seed=1, workers=2, **short)
    other = train(seed=2, **short)
    assert first.policy.digest == again.policy.digest
    assert first.success == again.success
    assert first.policy.digest != other.policy.digest


def test_training_ends_at_max_steps():
    assert train(max_steps=5000, target_success=1.0).steps == 3 * 2048


def test_invalid_worlds_teach_nothing_but_do_not_stop_training():
    broken = tuple(range(900_000_000, 900_006_000, 3))
    result = train(scene=PointScene(broken_seeds=broken), max_steps=6000, target_success=1.0)
    assert np.isfinite(np.asarray(result.policy.log_std)).all()


def test_nan_stops_with_the_task_and_the_seed_named():
    @dataclasses.dataclass(frozen=True)
    class Broken(PointScene):
        def progress(self, obs):
            return np.full(len(obs), np.nan, np.float32)

    with pytest.raises(DivergedError, match="pointmass, seed 4"):
        train(seed=4, scene=Broken())


def test_episode_seeds_of_experts_are_their_own():
    seen = []

    class Watched(PointWorlds):
        def reset(self, seeds, worlds=None):
            seen.extend(np.asarray(seeds).tolist())
            return super().reset(seeds, worlds)

    config = CONFIG.model_copy(update={"max_steps": 4096, "target_success": 1.0})
    train_expert(PointScene(), config, 3, make_worlds=Watched)
    assert len(set(seen)) == len(seen)
    assert min(seen) == 930_000_000
    assert max(seen) < 940_000_000


def test_reward_follows_the_settings():
    scene = PointScene()
    before, after = np.zeros((4, 4), np.float32), np.zeros((4, 4), np.float32)
    before[:, 0], after[:, 0] = 1.0, 0.5
    status = np.array([Status.RUNNING, Status.SOLVED, Status.FAILED, Status.INVALID], np.int8)
    gained = scene.progress(after[:1]) - scene.progress(before[:1])
    settings = {"progress_scale": 2.0, "solved_reward": 11.0, "failure_cost": 0.25}
    found = shaped_reward(scene, before, after, status, **settings)
    np.testing.assert_allclose(
        found, [2 * gained[0], 2 * gained[0] + 11, 2 * gained[0] - 0.25, 0.0], rtol=1e-6
    )
    own = shaped_reward(scene, before, after, status)
    step = scene.progress_scale * gained[0]
    np.testing.assert_allclose(own, [step, step + 1, step - 1, 0.0], rtol=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_exploration_noise_is_standard_normal_and_correlated_as_asked(correlation):
    config = CONFIG.model_copy(update={"noise_correlation": correlation})
    random = np.random.Generator(np.random.Philox(3))
    scene = PointScene()
    sampler = _Sampler(scene, PointWorlds(scene, 64), config, 0, random)
    noise = np.concatenate([sampler._explore(100) for _ in range(20)])  # goes on between calls
    assert abs(noise.mean()) < 0.03
    assert noise.std() == pytest.approx(1.0, abs=0.02)
    for lag in (1, 2, 10):
        found = np.mean(noise[lag:] * noise[:-lag])
        assert found == pytest.approx(correlation**lag, abs=0.03)


def test_settings_of_one_task_change_that_task_only():
    config = ExpertsConfig.model_validate(
        {"entropy": 0.5, "by_task": {"catcher": {"noise_correlation": 0.9, "max_steps": 7}}}
    )
    assert config.of("walker") is config
    mine = config.of("catcher")
    assert (mine.noise_correlation, mine.max_steps, mine.entropy) == (0.9, 7, 0.5)
