"""One recorded episode of a method is the episode that an evaluation would count."""

import numpy as np
import pytest
from untrained_runs import untrained_policy, untrained_run

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.errors import StateError, UsageError
from rtc_cli.execution.methods import get_method
from rtc_cli.execution.rollout import evaluate_cell
from rtc_cli.pipeline.showing import record_method
from rtc_cli.tasks import get_task


@pytest.fixture(scope="module")
def scene():
    return get_task("catcher")


@pytest.fixture(scope="module")
def policy():
    return untrained_policy("catcher")


@pytest.fixture
def run(tmp_path):
    return untrained_run(tmp_path / "run", "quickstart", ['tasks=["catcher"]'], ["base"])


@pytest.mark.parametrize(("method", "s", "d"), [("naive", 3, 2), ("pinv", 4, 4), ("sync", 4, 2)])
def test_the_recorded_episode_is_the_evaluated_one(run, scene, policy, method, s, d):
    trace = record_method(run, scene, method, 0, s, d, episode=3)
    rows = evaluate_cell(
        scene,
        policy,
        get_method(method),
        ChunkGeometry(horizon=8, exec_horizon=s, delay=d),
        flow_steps=run.recipe.eval.flow_steps,
        episodes=[3],
        eval_seed=run.recipe.eval.seed,
    )
    assert trace.ticks == rows.length[0]
    assert trace.status == rows.status[0]
    assert len(trace.chunk) == len(trace.actions) == len(trace.states) - 1
    assert all(ready - start == d for start, ready in trace.inferences)
    assert np.isfinite(trace.states).all()


def test_a_missing_checkpoint_and_a_foreign_task_are_refused(run, scene):
    with pytest.raises(StateError):
        record_method(run, scene, "prefix", 0, 2, 2, episode=0)
    with pytest.raises(UsageError, match="has no task"):
        record_method(run, get_task("lunar_lander"), "naive", 0, 2, 2, episode=0)
