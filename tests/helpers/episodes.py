"""Episodes for tests of tasks: play them to their end, under whatever acts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import FloatArray, Scene, Status

SOLVERS = Path(__file__).parents[1] / "tasks" / "solvers"

Act = Callable[[FloatArray], np.ndarray]
"""Observations (n, O) -> physical actions (n, A)."""


@dataclass(frozen=True)
class Played:
    """n episodes: status and length (n,), seen (T, n, O) and acted (T, n, A), T the longest.

    `seen[t]` is observed before `acted[t]`; the rows of episodes that have ended repeat.
    """

    status: np.ndarray
    length: np.ndarray
    seen: FloatArray
    acted: FloatArray
    invalid: int

    @property
    def solved(self) -> float:
        return float(np.mean(self.status == Status.SOLVED))

    @property
    def failed(self) -> float:
        return float(np.mean(self.status == Status.FAILED))


def play(scene: Scene, act: Act, seeds: np.ndarray) -> Played:
    """Play one episode per seed, tick by tick, each to its end."""
    seen, acted = [], []
    with WorldBatch(scene, len(seeds)) as worlds:
        obs = np.array(worlds.reset(seeds))
        status = np.zeros(len(seeds), np.int8)
        length = np.zeros(len(seeds), int)
        while (running := np.flatnonzero(status == Status.RUNNING)).size:
            actions = np.asarray(act(obs), np.float32)
            seen.append(obs.copy())
            acted.append(actions)
            record = worlds.step(actions[running, None], worlds=running)
            obs[running], status[running] = record.obs, record.status
            length[running] += record.ticks
        seen.append(obs)
        invalid = worlds.invalid_count
    return Played(status, length, np.stack(seen), np.stack(acted), invalid)


def still(scene: Scene) -> Act:
    """Do nothing: zero, or the bound that is nearest to it."""
    action = np.clip(np.zeros(scene.action_dim), scene.action_low, scene.action_high)
    return lambda obs: np.tile(action, (len(obs), 1))


def uniform(scene: Scene, seed: int = 0) -> Act:
    """Independent uniform actions within the bounds."""
    random = np.random.Generator(np.random.Philox(seed))
    low, high = scene.action_low, scene.action_high
    return lambda obs: random.uniform(low, high, (len(obs), scene.action_dim))


def bang_bang(scene: Scene, seed: int = 0, switch: float = 0.1) -> Act:
    """Every component at one of its bounds; at each tick it changes with probability `switch`."""
    random = np.random.Generator(np.random.Philox(seed))
    high: list[np.ndarray] = []

    def act(obs: FloatArray) -> np.ndarray:
        shape = (len(obs), scene.action_dim)
        before = high.pop() if high else random.random(shape) < 0.5
        high.append(before ^ (random.random(shape) < switch))
        return np.where(high[0], scene.action_high, scene.action_low)

    return act


def replay(actions: FloatArray) -> Act:
    """Act open loop: at call t row i gets actions[t, i]; the last ones are held."""
    calls = iter(range(10**9))
    return lambda obs: actions[min(next(calls), len(actions) - 1)]


class Solver:
    """A small policy from a file that `tests/tasks/make_solver.py` wrote; NumPy only."""

    def __init__(self, scene: Scene) -> None:
        path = SOLVERS / f"{scene.name}.npz"
        if not path.exists():
            raise FileNotFoundError(f"{path}: make it with tests/tasks/make_solver.py {scene.name}")
        with np.load(path) as stored:
            self._arrays = {name: stored[name].astype(np.float32) for name in stored.files}
        self._low, self._high = scene.action_low, scene.action_high
        points, weights = np.polynomial.hermite_e.hermegauss(7)
        self._points, self._shares = points, weights / weights.sum()

    def __call__(self, obs: FloatArray) -> np.ndarray:
        """The policy's expected action (n, A) for observations (n, O).

        The average of tanh over the policy's Gaussian, by quadrature: the tanh of the average is
        another, harder policy, and solves less.
        """
        spread = np.exp(self._arrays["log_std"])[:, None] * self._points
        share = 0.5 * (np.tanh(self._mean(obs)[..., None] + spread) @ self._shares + 1.0)
        return self._low + share * (self._high - self._low)

    def sampled(self, obs: FloatArray, random: np.random.Generator) -> np.ndarray:
        """Actions (n, A) drawn from the policy, as experts act when they make data."""
        mean = self._mean(obs)
        spread = np.exp(self._arrays["log_std"]) * random.standard_normal(mean.shape)
        share = 0.5 * (np.tanh(mean + spread) + 1.0)
        return self._low + share * (self._high - self._low)

    def _mean(self, obs: FloatArray) -> np.ndarray:
        arrays = self._arrays
        x = np.clip((obs - arrays["obs_mean"]) / arrays["obs_std"], -10.0, 10.0)
        last = sum(name.startswith("weights") for name in arrays) - 1
        for layer in range(last):
            x = np.tanh(x @ arrays[f"weights{layer}"] + arrays[f"bias{layer}"])
        return x @ arrays[f"weights{last}"] + arrays[f"bias{last}"]
