"""Many worlds of one scene: the public way to run episodes.

Example::

    scene = get_task("catcher")
    with WorldBatch(scene, 64) as worlds:
        obs = worlds.reset(range(64))
        record = worlds.step(actions)  # (64, T, A)
"""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType

import numpy as np
import numpy.typing as npt

from rtc_cli.errors import UsageError
from rtc_cli.tasks.local import EngineName, Index, LocalBatch, Record, check_worlds
from rtc_cli.tasks.scene import FloatArray, Scene, StateArray
from rtc_cli.tasks.workers import ProcessBatch


class WorldBatch:
    """n worlds of a scene, in this process or shared out to worker processes.

    An episode is a function of (scene, seed, actions) only, bit for bit: batch size, order of
    worlds, cutting into chunks, engine and number of workers do not matter. `engine` is "fast",
    "public" (slow, pymunk's own interface only) or "auto": fast where this pymunk allows it.
    """

    def __init__(self, scene: Scene, n: int, workers: int = 1, engine: EngineName = "auto") -> None:
        if n < 1 or workers < 1:
            raise UsageError(f"{n} worlds with {workers} workers: both must be at least 1.")
        scene.prepare()
        self.scene = scene
        self.n = n
        workers = min(workers, n)
        self._batch: LocalBatch | ProcessBatch
        if workers == 1:
            self._batch = LocalBatch(scene, n, engine)
        else:
            self._batch = ProcessBatch(scene, n, workers, engine)
        self._started = np.zeros(n, bool)

    @property
    def invalid_count(self) -> int:
        """Worlds that became NaN and were rebuilt, over the life of the batch."""
        return self._batch.invalid_count

    @property
    def states(self) -> StateArray:
        """Body states (n, bodies, 6) as of the last call: x, y, vx, vy, angle, spin. A copy."""
        return self._batch.states.copy()

    def reset(
        self, seeds: Iterable[int] | npt.ArrayLike, worlds: npt.ArrayLike | None = None
    ) -> FloatArray:
        """Start episodes with `seeds` (m,) in `worlds` (m,; all by default): obs (m, O)."""
        index = check_worlds(self.n, worlds)
        if not isinstance(seeds, np.ndarray):
            seeds = np.array(list(seeds) if isinstance(seeds, Iterable) else [seeds], np.int64)
        if seeds.shape != index.shape:
            raise UsageError(f"{seeds.size} seeds for {index.size} worlds: give one per world.")
        if not len(index):
            return np.empty((0, self.scene.obs_dim), np.float32)
        self._started[index] = True
        return self._batch.reset(seeds.astype(np.int64), index)

    def step(self, actions: npt.ArrayLike, worlds: npt.ArrayLike | None = None) -> Record:
        """Run `worlds` (m,; all by default) through actions (m, T, A) open loop.

        Actions are physical and without noise: noise is added and the sum clipped to the bounds
        here. Finished worlds ignore their actions (0 ticks, last observation).
        """
        return self._batch.step(*self._checked(actions, worlds))

    def predict(self, actions: npt.ArrayLike, worlds: npt.ArrayLike | None = None) -> FloatArray:
        """Observations (m, O) that `worlds` would show after actions (m, T, A) without noise.

        The worlds stay as they are. A scratch world repeats the episode so far and goes on without
        noise, so the prediction is exact, at the price of stepping the episode again. After a push
        or a clamped velocity it starts from the bodies' states without the solver's cached
        impulses, and is close only. Finished worlds show their last observation.
        """
        return self._batch.predict(*self._checked(actions, worlds))

    def push(self, change: npt.ArrayLike, worlds: npt.ArrayLike | None = None) -> None:
        """Add `change` (m, bodies, 3) to the velocities vx, vy (m/s) and spin (rad/s) of `worlds`.

        Entries of static bodies and finished worlds are ignored.
        """
        index = check_worlds(self.n, worlds)
        array = np.asarray(change, np.float64)
        wanted = (len(index), len(self.scene.bodies), 3)
        if array.shape != wanted:
            raise UsageError(f"a push of shape {array.shape}: {wanted} is needed.")
        self._check_started(index)
        self._batch.push(array, index)

    def _checked(
        self, actions: npt.ArrayLike, worlds: npt.ArrayLike | None
    ) -> tuple[FloatArray, Index]:
        """Actions (m, T, A) and the worlds (m,) they are for, of the shapes that are needed."""
        index = check_worlds(self.n, worlds)
        array = np.asarray(actions, np.float32)
        if array.ndim != 3 or array.shape[::2] != (len(index), self.scene.action_dim):
            wanted = f"({len(index)}, T, {self.scene.action_dim})"
            raise UsageError(f"actions of shape {array.shape}: {wanted} is needed.")
        self._check_started(index)
        return array, index

    def _check_started(self, index: Index) -> None:
        if not self._started[index].all():
            missing = index[~self._started[index]].tolist()
            raise UsageError(f"worlds {missing} have no episode yet: call reset first.")

    def close(self) -> None:
        """End worker processes, if there are any; may be called twice."""
        self._batch.close()

    def __enter__(self) -> WorldBatch:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
