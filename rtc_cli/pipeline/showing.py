"""One episode of a method with a run's checkpoint, recorded so that it can be drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.execution.methods import get_method
from rtc_cli.execution.rollout import evaluate_cell
from rtc_cli.execution.timeline import timeline
from rtc_cli.levels import short_name
from rtc_cli.runs import Run
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status
from rtc_cli.tasks.trace import Trace


def record_method(
    run: Run,
    scene: Scene,
    method_name: str,
    train_seed: int | None,
    exec_horizon: int,
    delay: int,
    episode: int,
) -> Trace:
    """Run one episode as an evaluation would, and keep what a picture needs.

    Raises UsageError for a task or geometry that the run's recipe does not have, StateError for a
    missing checkpoint.
    """
    from rtc_cli.training.checkpoints import Expected, load_policy

    names = [short_name(task) for task in run.recipe.tasks]
    if scene.name not in names:
        raise UsageError(
            f'run {run.folder} has no task "{scene.name}".' + did_you_mean(scene.name, names)
        )
    method = get_method(method_name)
    seed = run.recipe.train.seeds[0] if train_seed is None else train_seed
    geometry = ChunkGeometry(horizon=run.recipe.horizon, exec_horizon=exec_horizon, delay=delay)
    folder = run.checkpoint(scene.name, seed, method.checkpoint)
    policy = load_policy(folder, expect=Expected(scene_digest=scene.digest))
    with WorldBatch(scene, 1) as worlds:
        recorder = _Recorder(worlds)
        evaluate_cell(
            scene,
            policy,
            method,
            geometry,
            flow_steps=run.recipe.eval.flow_steps,
            episodes=[episode],
            eval_seed=run.recipe.eval.seed,
            worlds=recorder,
        )
    plan = timeline(
        horizon=geometry.horizon,
        exec_horizon=exec_horizon,
        delay=delay,
        ticks=len(recorder.actions),
        schedule=method.schedule,
    )
    return Trace(
        states=np.stack(recorder.states),
        actions=np.stack(recorder.actions),
        status=recorder.status,
        chunk=plan.chunk,
        inferences=tuple((window.start, window.ready) for window in plan.inferences),
        caption=f"{method.name}, delay d = {delay}, s = {exec_horizon}",
    )


class _Recorder:
    """A batch of one world that keeps every state and action, stepped one tick at a time."""

    n = 1

    def __init__(self, worlds: WorldBatch) -> None:
        self._worlds = worlds
        self.states: list[npt.NDArray[np.float64]] = []
        self.actions: list[npt.NDArray[np.float32]] = []
        self.status = Status.RUNNING

    def reset(self, seeds: Any, worlds: Any = None) -> Any:
        """Start the episode; its state is the first picture."""
        obs = self._worlds.reset(seeds, worlds)
        self.states, self.actions = [self._worlds.states[0]], []
        return obs

    def step(self, actions: npt.NDArray[np.float32], worlds: Any = None) -> Any:
        """Run the actions (1, T, A) until the episode ends; T ticks become T pictures."""
        executed = 0
        for tick in range(actions.shape[1]):
            record = self._worlds.step(actions[:, tick : tick + 1], worlds)
            executed += int(record.ticks[0])
            if record.ticks[0]:
                self.states.append(self._worlds.states[0])
                self.actions.append(actions[0, tick])
            self.status = Status(int(record.status[0]))
            if self.status != Status.RUNNING:
                break
        return replace(record, ticks=np.array([executed], np.int32))

    def predict(self, actions: npt.NDArray[np.float32], worlds: Any = None) -> Any:
        """Look ahead; nothing of it is shown."""
        return self._worlds.predict(actions, worlds)

    def push(self, change: npt.NDArray[np.float64], worlds: Any = None) -> None:
        """Change velocities."""
        self._worlds.push(change, worlds)
