"""Random numbers of an episode: functions of (task name, episode seed, tick) and nothing else."""

from __future__ import annotations

import hashlib
from functools import cache

import numpy as np

from rtc_cli.tasks.scene import Scene, StateArray

JITTER_NUMBERS = 6


def stream(task: str, purpose: str, seed: int) -> np.random.Generator:
    """A Philox stream keyed by the task, what it is used for, and the episode's seed."""
    key = np.array([_hash(f"{task}/{purpose}"), seed % 2**64], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


@cache
def _hash(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")


def jitter_numbers(scene: Scene, seed: int) -> StateArray:
    """Uniform numbers (jitters, 6) in [−1, 1) for the start of an episode."""
    shape = (len(scene.jitters), JITTER_NUMBERS)
    return stream(scene.name, "jitter", seed).uniform(-1.0, 1.0, shape)


def action_noise(scene: Scene, seed: int) -> StateArray:
    """Gaussian noise (max_ticks, A) in the units of the actions; row t belongs to tick t."""
    shape = (scene.max_ticks, scene.action_dim)
    return stream(scene.name, "noise", seed).standard_normal(shape) * scene.action_noise
