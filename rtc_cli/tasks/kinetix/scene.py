"""The scene of a level: like any other scene, but with physics of its own."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from rtc_cli.levels import Observation
from rtc_cli.tasks.engine import Engine
from rtc_cli.tasks.kinetix.reading import Level
from rtc_cli.tasks.kinetix.symbolic import SymbolicView
from rtc_cli.tasks.scene import Component, FloatArray, Role, Scene, StateArray

RULES = "jax2d 1.0.1, kinetix-env 3.0.2"


@dataclass(frozen=True, kw_only=True)
class LevelScene(Scene):
    """A Kinetix level. What moves how follows from `level`, not from joints, motors and the like.

    `observation`: "compact", what `observations` declare, or "symbolic", the simulator's own flat
    vector (`SYMBOLIC_FLAT`). `rules` names the physics and the rule of ends that are followed; it
    is part of the digest. Speeds are limited by the physics itself. Progress is the sum, over
    goal objects and targets, of how near they are, as in the simulator's own shaping.
    """

    level: Level
    observation: Observation = "compact"
    rules: str = RULES
    max_speed: float = math.inf
    max_spin: float = math.inf

    last_substep_rule: ClassVar[bool] = True

    def prepare(self) -> None:
        """Compile the physics, which takes some seconds the first time; UsageError without numba.

        Says so on standard error where it has to.
        """
        from rtc_cli.tasks.kinetix.compiling import is_compiled

        if is_compiled():
            return
        note = "compiling the physics of Kinetix levels (once, about 15 s)"
        print(note, file=sys.stderr, flush=True)
        self.own_engine(1).run([0], np.zeros((1, 1, self.action_dim)))

    def own_engine(self, n: int) -> Engine:
        """The simulator's physics for n worlds; UsageError where numba is missing."""
        from rtc_cli.tasks.kinetix.engine import LevelEngine

        return LevelEngine(self.level, n)

    def observe(self, states: StateArray) -> FloatArray:
        """Observations (n, O), float32, of body states (n, bodies, 6); always finite."""
        if self.observation == "compact":
            return super().observe(states)
        return self._symbolic.observe(states)

    @property
    def obs_dim(self) -> int:
        """Length of the observation vector."""
        return super().obs_dim if self.observation == "compact" else self._symbolic.size

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """Name, unit and range of every number in the observation vector."""
        if self.observation == "symbolic":
            return self._symbolic.components
        return super().components

    def progress(self, observations: npt.ArrayLike) -> FloatArray:
        """Potential (n,), float32, of observations (n, O): minus the distances, in metres."""
        obs = np.asarray(observations, np.float64)
        total = np.zeros(len(obs))
        for goal, target in self._ways():
            way = self._places(obs, goal) - self._places(obs, target)
            total -= np.hypot(way[:, 0], way[:, 1])
        return total.astype(np.float32)

    def _ways(self) -> Iterator[tuple[int, int]]:
        """Goal objects and targets, by their places in `bodies`."""
        goals, targets = (
            [i for i, shape in enumerate(self.level.shapes) if shape.role == role]
            for role in (Role.GOAL, Role.TARGET)
        )
        return itertools.product(goals, targets)

    def _places(self, obs: StateArray, body: int) -> StateArray:
        """Places (n or 1, 2) of a body that observations tell."""
        if self.bodies[body].static:
            return self.declared_states[body : body + 1, :2]
        if self.observation == "symbolic":
            return obs[:, self._symbolic.place_columns(body)]
        columns = self.columns(f"{self.bodies[body].name}.position")
        return obs[:, columns] * self._scales[columns] + self._offsets[columns]

    @cached_property
    def _symbolic(self) -> SymbolicView:
        return SymbolicView(self.level)
