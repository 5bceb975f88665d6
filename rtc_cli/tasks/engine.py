"""What a batch asks of the physics of its worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.scene import Role, StateArray

# A run steps at most this many ticks, and at most this many world-ticks: few enough that what is
# logged is read while it is still in the cache.
MAX_CHUNK = 8
SHARD_TICKS = 512


class Contact(NamedTuple):
    """A goal object began to touch a target or a hazard in tick `tick` of row `row` of a run."""

    row: int
    tick: int
    role: Role


class Stepped(NamedTuple):
    """What m worlds did in T control steps.

    states (m, T, moving, 6), valid until the next call; contacts; solved_last (m, T): whether the
    last substep of a control step solves the episode, None where the physics has no such rule.
    """

    states: StateArray
    contacts: list[Contact]
    solved_last: npt.NDArray[np.bool_] | None = None


class Engine(Protocol):
    """Physics of n worlds of one scene; states are (moving bodies, 6), float64."""

    def reset(self, worlds: Sequence[int], states: StateArray) -> None:
        """Start worlds (m) from states (m, moving, 6), as if their Spaces were new."""

    def run(self, worlds: Sequence[int], actions: StateArray) -> Stepped:
        """Step worlds (m) under applied actions (m, T, A); T ≤ MAX_CHUNK, m · T ≤ SHARD_TICKS."""

    def set_velocities(self, world: int, state: StateArray) -> None:
        """Overwrite the velocities of a running world with those in `state`."""

    def rebuild(self, world: int) -> None:
        """Throw away what a world that broke has left behind."""

    def copy(self, source: Engine, worlds: Sequence[int]) -> bool:
        """Take over worlds exactly as they are in `source`; False where that cannot be done."""
