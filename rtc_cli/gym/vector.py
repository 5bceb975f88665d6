"""Many episodes of one task at once, as a Gymnasium vector environment over `WorldBatch`.

World i does exactly what a single environment would do that was reset with the same seed: rewards,
ends, observations and the seeds of later episodes are equal bit for bit, whatever `num_envs` is.

What happens when an episode ends depends on `autoreset_mode` (also in `metadata`, where Gymnasium
looks for it): `NEXT_STEP`, the default, ignores the world's next action, starts its next episode
instead and gives reward 0; `SAME_STEP` starts the next episode at once and puts the last
observation and info into `infos["final_obs"]` and `infos["final_info"]`; `DISABLED` waits for
`reset(options={"reset_mask": ended})`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from rtc_cli.errors import UsageError
from rtc_cli.gym.env import METADATA, check_render_mode, draw_seed, find_scene, judged, spaces
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.drawing import draw_world
from rtc_cli.tasks.scene import FloatArray, Scene, Status

Flags = npt.NDArray[np.bool_]
StepResult = tuple[FloatArray, npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]


class TaskVectorEnv(VectorEnv[FloatArray, FloatArray, npt.NDArray[Any]]):
    """`num_envs` worlds of a task by name, or of a Scene, over `workers` processes."""

    def __init__(
        self,
        task: str | Scene,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        render_width: int = 480,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        workers: int = 1,
    ) -> None:
        self.scene = find_scene(task)
        self.num_envs = num_envs
        self.render_mode = check_render_mode(render_mode)
        self.render_width = render_width
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(self.scene)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = WorldBatch(self.scene, num_envs, workers)
        self._random = [seeding.np_random()[0] for _ in range(num_envs)]
        self._seeds = np.full(num_envs, -1, np.int64)
        self._status = np.full(num_envs, Status.TIMEOUT, np.int8)
        self._obs = np.zeros((num_envs, self.scene.obs_dim), np.float32)
        self._actions: FloatArray | None = None

    def reset(  # type: ignore[override]  # Gymnasium's own vector environments take lists too
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start episodes in all worlds, or in those of `options["reset_mask"]` (n,), bool.

        An int k means seeds k, k + 1, …; a list has one seed per world, None for a random one.
        """
        mask = self._reset_mask(options)
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UsageError(f"{len(seed)} seeds for {self.num_envs} worlds: give one per world.")
        worlds = np.flatnonzero(mask)
        for i in worlds.tolist():
            if seed[i] is not None:
                self._random[i] = seeding.np_random(seed[i])[0]
        self._start(worlds, [seed[i] for i in worlds.tolist()])
        self._actions = None
        return self._obs.copy(), self._info(mask)

    def step(self, actions: FloatArray) -> StepResult:
        """One control step with physical actions (n, A), before noise."""
        asleep = self._status != Status.RUNNING
        if asleep.any() and self.autoreset_mode == AutoresetMode.DISABLED:
            raise ResetNeeded(f"Worlds {np.flatnonzero(asleep).tolist()} have ended: reset them.")
        self._actions = np.asarray(actions, np.float32)
        record = self._worlds.step(self._actions[:, None])
        # Worlds that had ended before ignore their action and show what they showed.
        judgement = judged(self.scene, self._obs, record.obs, record.status)
        self._obs, reward, terminated, truncated = judgement
        self._status = record.status.copy()
        reward[asleep], terminated[asleep], truncated[asleep] = 0.0, False, False
        final = self._restart(asleep, terminated | truncated)
        infos = {**self._info(np.ones(self.num_envs, bool)), **final}
        return self._obs.copy(), reward.astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """One picture (height, width, 3) per world."""
        if self.render_mode is None:
            return None
        actions = [None] * self.num_envs if self._actions is None else self._actions
        pairs = zip(self._worlds.states, actions, strict=True)
        return tuple(
            np.asarray(draw_world(self.scene, state, action, self.render_width))
            for state, action in pairs
        )

    def close_extras(self, **kwargs: Any) -> None:
        """End the worlds and their processes."""
        self._worlds.close()

    def _restart(self, asleep: Flags, ended: Flags) -> dict[str, Any]:
        """Start the next episodes that are due; the final infos, if the mode has them."""
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            self._start(np.flatnonzero(asleep))
        if self.autoreset_mode != AutoresetMode.SAME_STEP or not ended.any():
            return {}
        last = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            last[i] = self._obs[i].copy()
        final = {"final_obs": last, "final_info": self._info(ended)}
        self._start(np.flatnonzero(ended))
        return final | {f"_{key}": ended.copy() for key in final}

    def _start(self, worlds: npt.NDArray[np.intp], seeds: Sequence[int | None] = ()) -> None:
        """Start episodes in `worlds`; a seed that is None or not given is drawn."""
        if not len(worlds):
            return
        chosen = [
            draw_seed(self._random[i]) if seed is None else seed
            for i, seed in zip(worlds.tolist(), seeds or [None] * len(worlds), strict=True)
        ]
        self._seeds[worlds] = chosen
        self._obs[worlds] = self._worlds.reset(chosen, worlds)
        self._status[worlds] = Status.RUNNING

    def _reset_mask(self, options: dict[str, Any] | None) -> Flags:
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise UsageError(
                f'options["reset_mask"] is {mask.dtype} of shape {mask.shape}: it must be bool of '
                f"shape ({self.num_envs},), with at least one True."
            )
        return mask

    def _info(self, mask: Flags) -> dict[str, Any]:
        """The infos of the worlds in `mask`, as Gymnasium lays them out: a mask beside each."""
        facts = {
            "status": self._status.astype(np.int64),
            "is_success": self._status == Status.SOLVED,
            "episode_seed": self._seeds,
        }
        infos: dict[str, Any] = {key: np.where(mask, value, 0) for key, value in facts.items()}
        infos["is_success"] = infos["is_success"].astype(bool)
        return infos | {f"_{key}": mask.copy() for key in facts}
