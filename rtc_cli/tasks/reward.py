"""The reward that experts are trained with, and that the Gymnasium environments give."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.scene import FloatArray, Scene, Status


def shaped_reward(
    scene: Scene,
    before: FloatArray,
    after: FloatArray,
    status: npt.NDArray[np.int8],
    *,
    progress_scale: float | None = None,
    solved_reward: float = 1.0,
    failure_cost: float = 1.0,
) -> FloatArray:
    """Reward (n,), float32, of one control step from observations (n, O) to observations (n, O).

    progress_scale · (progress(after) − progress(before)), with the scene's own scale if None is
    given, plus `solved_reward` for a solved episode, minus `failure_cost` for a failed one. The
    progress terms are differences of a potential, so what they add up to over an episode depends on
    its two ends only. A world that became invalid gets 0: its state means nothing.
    """
    gained = scene.progress(after) - scene.progress(before)
    gained[status == Status.INVALID] = 0.0
    scale = scene.progress_scale if progress_scale is None else progress_scale
    outcome = np.float32(solved_reward) * (status == Status.SOLVED)
    outcome -= np.float32(failure_cost) * (status == Status.FAILED)
    reward: FloatArray = scale * gained + outcome
    return reward
