"""Random numbers of an episode: functions of (task name, episode seed, tick) and nothing else."""

from __future__ import annotations

import hashlib

import numpy as np

from rtc_cli.tasks.scene import Scene, StateArray

JITTER_NUMBERS = 6


def stream(task: str, purpose: str, seed: int) -> np.random.Generator:
    """A Philox stream keyed by the task, what it is used for, and the episode's seed."""
    digest = hashlib.sha256(f"{task}/{purpose}".encode()).digest()
    key = np.array([int.from_bytes(digest[:8], "little"), seed % 2**64], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def jitter_numbers(scene: Scene, seed: int) -> StateArray:
    """Uniform numbers (jitters, 6) in [−1, 1) for the start of an episode."""
    shape = (len(scene.jitters), JITTER_NUMBERS)
    return stream(scene.name, "jitter", seed).uniform(-1.0, 1.0, shape)


def action_noise(scene: Scene, seed: int) -> StateArray:
    """Gaussian noise (max_ticks, A) in the units of the actions; row t belongs to tick t."""
    shape = (scene.max_ticks, scene.action_dim)
    return stream(scene.name, "noise", seed).standard_normal(shape) * scene.action_noise
