"""What happened in an episode, tick by tick: all that a picture needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import FloatArray, Scene, StateArray, Status

Feedback = Callable[[FloatArray, int], npt.ArrayLike]


@dataclass(frozen=True)
class Trace:
    """An episode of T control steps.

    states (T + 1, bodies, 6), as `WorldBatch.states`; actions (T, A) physical, before noise;
    chunk (T,) number of the chunk that acts, −1 while holding still, all 0 without chunks;
    inferences: (start, ready) control steps of every inference, the k-th making chunk k + 1;
    caption: who acts.
    """

    states: StateArray
    actions: FloatArray
    status: Status
    chunk: npt.NDArray[np.int64]
    inferences: tuple[tuple[int, int], ...] = ()
    caption: str = ""

    @property
    def ticks(self) -> int:
        """T, the number of control steps."""
        return len(self.actions)

    @property
    def chunked(self) -> bool:
        """Whether whoever acts computes chunks, so that there is something to show."""
        return bool(self.inferences) or bool(self.chunk.any())


def record_episode(scene: Scene, seed: int, act: Feedback, caption: str = "") -> Trace:
    """Run one episode of a feedback law: `act(observation (O,), tick)` gives one action (A,)."""
    states: list[StateArray] = []
    actions: list[FloatArray] = []
    with WorldBatch(scene, 1) as worlds:
        obs = worlds.reset([seed])[0]
        states.append(worlds.states[0])
        status = Status.RUNNING
        while status == Status.RUNNING:
            action = np.asarray(act(obs, len(actions)), np.float32).reshape(scene.action_dim)
            record = worlds.step(action[None, None])
            obs, status = record.obs[0], Status(int(record.status[0]))
            states.append(worlds.states[0])
            actions.append(action)
    chunk = np.zeros(len(actions), np.int64)
    return Trace(np.stack(states), np.stack(actions), status, chunk, (), caption)
