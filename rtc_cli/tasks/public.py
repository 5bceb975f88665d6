"""Physics through pymunk's public interface only, a new Space at every reset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtc_cli.tasks.engine import Contact, Engine, Stepped
from rtc_cli.tasks.scene import STATE_SIZE, Role, Scene, StateArray
from rtc_cli.tasks.world import Drives, World


class PublicEngine:
    """The `Engine` that needs nothing private of pymunk: slow, and the truth for tests."""

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
