"""Recording on real worlds with a mixture of real experts: still a function of the numbers only."""

import numpy as np
import pytest

from rtc_cli.data.collect import collect
from rtc_cli.experts.policy import mixture_actor
from rtc_cli.experts.ppo import train_expert
from rtc_cli.recipe import ExpertsConfig
from rtc_cli.tasks import get_task, list_tasks


@pytest.fixture(scope="module")
def demonstrators():
    """Two experts that have learnt next to nothing; enough to act."""
    scene = get_task(list_tasks()[0])
    config = ExpertsConfig(
        worlds=16, rollout_ticks=8, minibatches=2, epochs=1, max_steps=256, hidden=(16,)
    )
    return scene, [train_expert(scene, config, seed).policy for seed in (0, 1)]


def record(demonstrators, folder, **options):
    scene, experts = demonstrators
    actor = mixture_actor(experts, seed=2)
    return collect(scene, actor, 400, first_episode=1_000_000, seed=2, folder=folder, **options)


@pytest.mark.parametrize(
    "options", [{"worlds": 3}, pytest.param({"worlds": 24, "workers": 2}, marks=pytest.mark.slow)]
)
def test_worlds_and_workers_do_not_matter(demonstrators, tmp_path, options):
    one = record(demonstrators, tmp_path / "one", worlds=32)
    other = record(demonstrators, tmp_path / "other", **options)
    for name in ("observations", "actions", "lengths", "episodes", "status", "expert"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.manifest["expert_ids"] == [expert.digest for expert in demonstrators[1]]
