"""Measured reaction: how many control steps pass until a push changes what the robot does.

Twin worlds run the same episode with the same noise. At a random tick one of them gets a push: all
its bodies move PUSH_M_S faster, to the left or to the right. The reaction is the number of ticks
from the first observation that could show the push to the first executed action that differs, in
one component at least, by more than EPSILON from what the undisturbed twin executes at that tick.

It is undefined (NaN) where an episode ends, in either world, before that happens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtc_cli.execution.worlds import FloatArray, IntArray, Worlds
from rtc_cli.tasks.randomness import stream
from rtc_cli.tasks.scene import Scene

PUSH_M_S = 1.0
MARGIN_HORIZONS = 2  # horizons at the end of an episode in which nothing is pushed
EPSILON = 0.1  # normalised action units: standard deviations of the actions in the data


def definition() -> dict[str, float]:
    """What decides the measured reaction of an episode, besides the cell: for a result's key."""
    return {"push_m_s": PUSH_M_S, "epsilon": EPSILON, "margin_horizons": MARGIN_HORIZONS}


@dataclass(frozen=True)
class Pushes:
    """When and how n episodes are pushed.

    Attributes:
        tick: (n,) the control tick in which the push falls; the observation of tick + 1 is the
            first to show it.
        change: (n, bodies, 3) what is added to vx, vy and spin.
    """

    tick: IntArray
    change: NDArray[np.float64]


def draw_pushes(scene: Scene, episodes: IntArray, lengths: IntArray, horizon: int) -> Pushes:
    """Draw one push per episode, functions of (task, episode) and the undisturbed length only.

    Ticks are uniform over the episode but for its last ``MARGIN_HORIZONS`` chunks of ``horizon``
    ticks, so that there is time to react; directions are left or right.
    """
    margin = MARGIN_HORIZONS * horizon
    numbers = np.array([stream(scene.name, "push", int(e)).uniform(size=2) for e in episodes])
    ticks = np.floor(numbers[:, 0] * np.maximum(lengths - margin, 1)).astype(np.int64)
    change = np.zeros((len(lengths), len(scene.bodies), 3))
    change[:, :, 0] = np.where(numbers[:, 1] < 0.5, -PUSH_M_S, PUSH_M_S)[:, None]
    return Pushes(ticks, change)


def measured_reaction(
    executed: FloatArray,
    pushed: FloatArray,
    pushes: Pushes,
    lengths: tuple[IntArray, IntArray],
) -> NDArray[np.float64]:
    """(n,) ticks of reaction, NaN where undefined.

    Args:
        executed: (n, T, A) normalised actions of the undisturbed episodes.
        pushed: (n, T', A) the same of their pushed twins.
        pushes: the pushes.
        lengths: (n,) executed ticks of each.
    """
    ticks = min(executed.shape[1], pushed.shape[1])
    change = np.abs(executed[:, :ticks].astype(np.float64) - pushed[:, :ticks]).max(axis=2)
    tick = np.arange(ticks)
    visible = pushes.tick[:, None] + 1
    defined = (tick >= visible) & (tick < np.minimum(*lengths)[:, None])
    reacts = defined & (change > EPSILON)
    first = np.argmax(reacts, axis=1)
    return np.where(reacts.any(axis=1), first - visible[:, 0], np.nan)


class PushedWorlds:
    """Worlds in which every episode is pushed once; otherwise those that are given."""

    def __init__(self, worlds: Worlds, episodes: IntArray, pushes: Pushes) -> None:
        self.n = worlds.n
        self._worlds = worlds
        self._pushes = pushes
        self._place = {int(episode): i for i, episode in enumerate(episodes)}
        self._row = np.zeros(worlds.n, np.int64)
        self._tick = np.zeros(worlds.n, np.int64)

    def reset(self, seeds: IntArray, worlds: IntArray | None = None) -> FloatArray:
        """Start episodes."""
        index = np.arange(self.n) if worlds is None else worlds
        self._row[index] = [self._place[int(seed)] for seed in seeds]
        self._tick[index] = 0
        return self._worlds.reset(seeds, worlds=index)

    def step(self, actions: FloatArray, worlds: IntArray | None = None) -> Any:
        """Step; worlds whose push falls into these ticks are pushed between them."""
        index = np.arange(self.n) if worlds is None else worlds
        before = self._pushes.tick[self._row[index]] - self._tick[index]
        self._tick[index] += actions.shape[1]
        executed = np.zeros(len(index), np.int32)
        inside = (before >= 0) & (before < actions.shape[1])
        for ticks in np.unique(before[inside]).tolist():
            rows = np.flatnonzero(inside & (before == ticks))
            executed[rows] += self._worlds.step(actions[rows, :ticks], worlds=index[rows]).ticks
            self._worlds.push(self._pushes.change[self._row[index[rows]]], worlds=index[rows])
        return self._finish(actions, index, np.where(inside, before, 0), executed)

    def _finish(
        self, actions: FloatArray, index: IntArray, done: IntArray, executed: NDArray[np.int32]
    ) -> Any:
        """Execute what is left of the actions, world by world the ticks from `done` on."""
        for ticks in np.unique(done).tolist():
            rows = np.flatnonzero(done == ticks)
            record = self._worlds.step(actions[rows, ticks:], worlds=index[rows])
            executed[rows] += record.ticks
        last = self._worlds.step(actions[:, :0], worlds=index)
        return replace(last, ticks=executed)

    def predict(self, actions: FloatArray, worlds: IntArray | None = None) -> FloatArray:
        """Look ahead; a push is not foreseen."""
        return self._worlds.predict(actions, worlds=worlds)

    def push(self, change: NDArray[np.float64], worlds: IntArray | None = None) -> None:
        """Push as well."""
        self._worlds.push(change, worlds=worlds)
