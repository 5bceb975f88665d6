"""What a batch asks of the physics of its worlds, and the plain answer through pymunk's own API."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.scene import STATE_SIZE, Role, Scene, StateArray
from rtc_cli.tasks.world import Drives, World

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


class PublicEngine:
    """Pymunk's public interface only, a new Space at every reset. Slow; the truth for tests."""

    def __init__(self, scene: Scene, n: int) -> None:
        self._scene = scene
        self._drives = Drives.of(scene)
        self._touched: list[Role] = []
        self._worlds = [self._new() for _ in range(n)]

    def _new(self) -> World:
        return World(self._scene, self._touched.append)

    def reset(self, worlds: Sequence[int], states: StateArray) -> None:
        """Build new Spaces and place the bodies."""
        for world, state in zip(worlds, states, strict=True):
            self._worlds[world] = self._new()
            self._worlds[world].place(state)

    def run(self, worlds: Sequence[int], actions: StateArray) -> Stepped:
        """Step world by world, tick by tick."""
        rates = self._drives.rates(actions).tolist()
        forces = self._drives.forces(actions).tolist()
        moving = len(self._worlds[0].bodies)
        log = np.empty((*actions.shape[:2], moving, STATE_SIZE))
        contacts: list[Contact] = []
        for row, index in enumerate(worlds):
            world = self._worlds[index]
            for tick in range(actions.shape[1]):
                self._touched.clear()
                world.tick(rates[row][tick], forces[row][tick])
                world.read(log[row, tick])
                contacts += [Contact(row, tick, role) for role in self._touched]
        return Stepped(log, contacts)

    def set_velocities(self, world: int, state: StateArray) -> None:
        """Overwrite velocities."""
        self._worlds[world].set_velocities(state)

    def rebuild(self, world: int) -> None:
        """Make a new Space."""
        self._worlds[world] = self._new()

    def copy(self, source: Engine, worlds: Sequence[int]) -> bool:
        """Pymunk cannot: a Space keeps more than can be read from it."""
        return False
