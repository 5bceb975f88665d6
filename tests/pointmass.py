"""A point mass on a plane with the interface of a scene and a world batch; no physics engine.

It must come within 0.4 of the origin and fails beyond 3 from it. Noise is a function of (episode
seed, tick), as in the real worlds.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

RUNNING, SOLVED, FAILED, TIMEOUT, INVALID = range(5)


@dataclass(frozen=True)
class PointScene:
    name: str = "pointmass"
    obs_dim: int = 4
    action_dim: int = 2
    max_ticks: int = 64
    progress_scale: float = 0.3
    action_noise: float = 0.1
    digest: str = "pointmass-1"
    broken_seeds: tuple[int, ...] = ()  # these episodes turn invalid at tick 3
    hopeless_every: int = 0  # of these seeds every n-th cannot be solved and lasts to the end

    @property
    def action_low(self) -> np.ndarray:
        return np.array([-1.0, -0.5], np.float32)

    @property
    def action_high(self) -> np.ndarray:
        return np.array([1.0, 0.5], np.float32)

    def progress(self, obs: np.ndarray) -> np.ndarray:
        return -np.linalg.norm(obs[:, :2], axis=-1).astype(np.float32)


@dataclass
class Record:
    obs: np.ndarray
    status: np.ndarray
    ticks: np.ndarray
    solved_last: np.ndarray


class PointWorlds:
    def __init__(self, scene: PointScene, count: int, workers: int = 1) -> None:
        self.scene, self.count, self.workers = scene, count, workers
        self.state = np.zeros((count, 4), np.float32)
        self.status = np.full(count, TIMEOUT, np.int8)
        self.tick = np.zeros(count, np.int64)
        self.seed = np.zeros(count, np.int64)
        self.noise = np.zeros((count, scene.max_ticks, 2), np.float32)

    def __enter__(self) -> "PointWorlds":
        return self

    def __exit__(self, *error: Any) -> None:
        return None

    def reset(self, seeds: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        worlds = np.arange(self.count) if worlds is None else worlds
        for world, seed in zip(worlds, seeds, strict=True):
            random = np.random.Generator(np.random.Philox(key=int(seed)))
            angle = random.uniform(0.0, 2.0 * np.pi)
            self.state[world] = [np.cos(angle), np.sin(angle), 0.0, 0.0]
            self.noise[world] = random.normal(size=self.noise.shape[1:])
            self.seed[world], self.status[world], self.tick[world] = seed, RUNNING, 0
        return self.state[worlds].copy()

    def step(self, actions: np.ndarray, worlds: np.ndarray | None = None) -> Record:
        worlds = np.arange(self.count) if worlds is None else worlds
        assert actions.shape == (len(worlds), 1, 2)
        running = self.status[worlds] == RUNNING
        moved = worlds[running]
        noise = self.scene.action_noise * self.noise[moved, self.tick[moved]]
        push = np.clip(actions[running, 0] + noise, self.scene.action_low, self.scene.action_high)
        self.state[moved, 2:] = 0.8 * self.state[moved, 2:] + 0.2 * push
        self.state[moved, :2] += 0.3 * self.state[moved, 2:]
        self.tick[moved] += 1
        self._judge(moved)
        status = self.status[worlds].copy()
        ticks = running.astype(np.int32)
        return Record(self.state[worlds].copy(), status, ticks, status == SOLVED)

    def _judge(self, moved: np.ndarray) -> None:
        distance = np.linalg.norm(self.state[moved, :2], axis=-1)
        self.status[moved[self.tick[moved] >= self.scene.max_ticks]] = TIMEOUT
        every = self.scene.hopeless_every
        hopeless = self.seed[moved] % every == 0 if every else np.zeros(len(moved), bool)
        self.status[moved[(distance < 0.4) & ~hopeless]] = SOLVED
        self.status[moved[distance > 3.0]] = FAILED
        broken = np.isin(self.seed[moved], self.scene.broken_seeds) & (self.tick[moved] == 3)
        self.status[moved[broken]] = INVALID
        self.state[moved[broken]] = np.nan
