"""Training an expert on a point mass."""

import dataclasses

import numpy as np
import pytest
from pointmass import PointScene, PointWorlds

from rtc_cli.errors import DivergedError
from rtc_cli.experts.ppo import train_expert
from rtc_cli.recipe import ExpertsConfig

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
