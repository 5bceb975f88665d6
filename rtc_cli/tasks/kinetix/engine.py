"""The simulator's physics behind the `Engine` of a batch of worlds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtc_cli.tasks.engine import Contact, Engine, Stepped
from rtc_cli.tasks.kinetix.compiling import load_physics
from rtc_cli.tasks.kinetix.packing import FAILURE, NOTHING, SUCCESS, pack
from rtc_cli.tasks.kinetix.reading import MOTOR_BINDINGS, THRUSTER_BINDINGS, Level
from rtc_cli.tasks.scene import SUBSTEPS, Role, StateArray

_MEANS = {SUCCESS: Role.TARGET, FAILURE: Role.HAZARD}


class LevelEngine:
    """n worlds of a level; states are (moving bodies, 6), float64 that hold float32.

    Of the contacts of a control step only the first that ends the episode is told: kinetix-env
    3.0.2 lets the first substep decide.
    """

    def __init__(self, level: Level, n: int) -> None:
        self._physics = load_physics()
        self._packed = packed = pack(level)
        self._memory = self._physics.make_memory(packed, n)
        self._scratch = self._physics.make_scratch(packed)
        self._bindings = [
            *level.motor_bindings,
            *(MOTOR_BINDINGS + binding for binding in level.thruster_bindings),
        ]

    def reset(self, worlds: Sequence[int], states: StateArray) -> None:
        """Place bodies and forget impulses."""
        for part in self._memory:
            part[worlds] = 0
        self._memory.bodies[worlds] = self._packed.start
        for row, world in enumerate(worlds):
            self._memory.bodies[world, self._packed.bodies.moving] = states[row]

    def run(self, worlds: Sequence[int], actions: StateArray) -> Stepped:
        """Step worlds one after the other, each through its chunk to its end at most."""
        rows, ticks = actions.shape[:2]
        packed, moving = self._packed, len(self._packed.bodies.moving)
        commands = np.zeros((rows, ticks, MOTOR_BINDINGS + THRUSTER_BINDINGS), np.float32)
        commands[:, :, self._bindings] = actions
        log = np.empty((rows, ticks, moving, packed.start.shape[1]), np.float32)
        outcome = np.empty((rows, ticks), np.int8)
        last = np.empty((rows, ticks), np.int8)
        self._physics.run(
            packed.laws,
            packed.bodies,
            packed.pairs,
            packed.joints,
            packed.thrusters,
            self._memory,
            self._scratch,
            np.asarray(worlds, np.int64),
            commands,
            SUBSTEPS,
            log,
            outcome,
            last,
        )
        contacts = [
            Contact(int(row), int(tick), _MEANS[int(outcome[row, tick])])
            for row, tick in np.argwhere(outcome != NOTHING)
        ]
        return Stepped(log.astype(np.float64), contacts, last == SUCCESS)

    def set_velocities(self, world: int, state: StateArray) -> None:
        """Overwrite velocities."""
        moving = self._packed.bodies.moving
        for column in (2, 3, 5):
            self._memory.bodies[world, moving, column] = state[:, column]

    def rebuild(self, world: int) -> None:
        """Nothing survives a reset here, so nothing has to be made anew."""

    def copy(self, source: Engine, worlds: Sequence[int]) -> bool:
        """Take over worlds exactly as they are in another engine of the same level."""
        if not isinstance(source, LevelEngine):
            return False
        for mine, theirs in zip(self._memory, source._memory, strict=True):
            mine[worlds] = theirs[worlds]
        return True
