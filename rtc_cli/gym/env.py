"""One task as a Gymnasium environment.

Observations, actions and bounds are the scene's. The action gets the task's noise (σ = 0.1 in the
action's unit) and is clipped, as everywhere in this project. The reward is that of the experts,
`rtc_cli.tasks.reward.shaped_reward`. An episode terminates when it is solved or failed and is
truncated when its time is up. A world whose numbers became NaN is truncated too; its last
observation is the one before.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Space

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.drawing import draw_world
from rtc_cli.tasks.reward import shaped_reward
from rtc_cli.tasks.scene import SUBSTEP_S, SUBSTEPS, FloatArray, Scene, Status

METADATA: dict[str, Any] = {
    "render_modes": ["rgb_array"],
    "render_fps": round(1.0 / (SUBSTEPS * SUBSTEP_S)),
}
_DRAWN_SEEDS = (2**32, 2**62)  # apart from the small numbers that people and evaluations use


class TaskEnv(gymnasium.Env[FloatArray, FloatArray]):
    """A task by name, or a Scene, one episode at a time.

    `reset(seed=k)` starts episode k of the task: the same start and noise as episode k of
    `rtc tasks --episode k`. A later `reset()` draws the episode's seed from `np_random`.

    `info` holds `status` (see `rtc_cli.tasks.scene.Status`), `is_success` and `episode_seed`.
    """

    metadata = METADATA

    def __init__(
        self, task: str | Scene, render_mode: str | None = None, render_width: int = 480
    ) -> None:
        self.scene = find_scene(task)
        self.render_mode = check_render_mode(render_mode)
        self.render_width = render_width
        self.observation_space, self.action_space = spaces(self.scene)
        self._worlds = WorldBatch(self.scene, 1)
        self._status = Status.TIMEOUT
        self._seed = -1
        self._action: FloatArray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode; see the class for what the seed means. There are no options."""
        super().reset(seed=seed)
        self._seed = draw_seed(self.np_random) if seed is None else seed
        self._obs = self._worlds.reset([self._seed])[0]
        self._action = None
        self._status = Status.RUNNING
        return self._obs.copy(), self._info()

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """One control step with the physical action (A,), before noise."""
        if self._status != Status.RUNNING:
            raise ResetNeeded("There is no running episode: call reset() first.")
        self._action = np.asarray(action, np.float32)
        record = self._worlds.step(self._action[None, None])
        obs, reward, *ended = judged(self.scene, self._obs[None], record.obs, record.status)
        self._obs, self._status = obs[0], Status(int(record.status[0]))
        terminated, truncated = bool(ended[0][0]), bool(ended[1][0])
        return self._obs.copy(), float(reward[0]), terminated, truncated, self._info()

    def render(self) -> npt.NDArray[np.uint8] | None:  # type: ignore[override]
        """Picture (height, width, 3) of the world and of the action that led here."""
        if self.render_mode is None:
            return None
        image = draw_world(self.scene, self._worlds.states[0], self._action, self.render_width)
        return np.asarray(image)

    def close(self) -> None:
        """End the world; may be called twice."""
        self._worlds.close()

    def _info(self) -> dict[str, Any]:
        solved = self._status == Status.SOLVED
        return {
            "status": int(self._status),
            "is_success": solved,
            "episode_seed": self._seed,
        }


def find_scene(task: str | Scene) -> Scene:
    """The scene of that name, or the scene itself."""
    return task if isinstance(task, Scene) else get_task(task)


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a legal render mode as it is; UsageError for any other."""
    if render_mode not in (None, *METADATA["render_modes"]):
        raise UsageError(f'render_mode="{render_mode}" is unknown; "rgb_array" and None are known.')
    return render_mode


def spaces(scene: Scene) -> tuple[Space[FloatArray], Space[FloatArray]]:
    """Boxes of one observation (O,) and of one action (A,), float32."""
    low = np.array([c.low for c in scene.components], np.float32)
    high = np.array([c.high for c in scene.components], np.float32)
    actions = Box(scene.action_low, scene.action_high, dtype=np.float32)
    return Box(low, high, dtype=np.float32), actions


def draw_seed(random: np.random.Generator) -> int:
    """Seed of an episode that nobody chose."""
    return int(random.integers(*_DRAWN_SEEDS))


def judged(
    scene: Scene, before: FloatArray, after: FloatArray, status: npt.NDArray[np.int8]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Observations (n, O), rewards, terminated and truncated (n,) of one control step."""
    reward = shaped_reward(scene, before, after, status)
    obs = np.where((status == Status.INVALID)[:, None], before, after)
    terminated = (status == Status.SOLVED) | (status == Status.FAILED)
    truncated = (status == Status.TIMEOUT) | (status == Status.INVALID)
    return obs, reward, terminated, truncated
