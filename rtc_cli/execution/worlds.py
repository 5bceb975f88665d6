"""What a rollout needs of a batch of worlds, so that others can stand in for it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.int64]


class Worlds(Protocol):
    """What a rollout needs of a ``WorldBatch``."""

    n: int

    def reset(self, seeds: IntArray, worlds: IntArray | None = None) -> FloatArray: ...

    def step(self, actions: FloatArray, worlds: IntArray | None = None) -> Any: ...

    def predict(self, actions: FloatArray, worlds: IntArray | None = None) -> FloatArray: ...

    def push(self, change: NDArray[np.float64], worlds: IntArray | None = None) -> None: ...
