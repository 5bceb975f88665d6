"""The reward that experts are trained with, and that the Gymnasium environments give."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.scene import FloatArray, Scene, Status


def shaped_reward(
    scene: Scene, before: FloatArray, after: FloatArray, status: npt.NDArray[np.int8]
) -> FloatArray:
    """Reward (n,), float32, of one control step from observations (n, O) to observations (n, O).

    progress_scale · (progress(after) − progress(before)), +1 for a solved episode, −1 for a failed
    one. The progress terms are differences of a potential, so what they add up to over an episode
    depends on its two ends only. A world that became invalid gets 0: its state means nothing.
    """
    gained = scene.progress(after) - scene.progress(before)
    gained[status == Status.INVALID] = 0.0
    outcome = (status == Status.SOLVED).astype(np.float32) - (status == Status.FAILED)
    reward: FloatArray = scene.progress_scale * gained + outcome
    return reward
