"""Soft motors: a torque that follows from the velocities at the start of every substep.

Chipmunk's own motors are constraints of its solver and cannot follow such a law, so both engines
compute it here, with the same arithmetic in the same order: their results are equal bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.scene import Scene, StateArray, TanhMotor

Index = npt.NDArray[np.intp]


@dataclass(frozen=True)
class SoftDrives:
    """The soft motors of a scene; arrays have one entry per motor (M,).

    `a`, `b`: places among the moving bodies; what does not move has the place after the last.
    `bodies`: the moving bodies that these motors turn.
    """

    a: Index
    b: Index
    bodies: tuple[int, ...]
    action: Index
    rate: StateArray
    torque: StateArray
    softness: StateArray
    low: StateArray
    high: StateArray
    fade: StateArray

    @staticmethod
    def of(scene: Scene, moments: Sequence[float]) -> SoftDrives | None:
        """The tables of a scene, given the moving bodies' moments of inertia; None without any."""
        motors = [m for m in scene.motors if isinstance(m, TanhMotor)]
        if not motors:
            return None
        moving = [scene.bodies[i].name for i in scene.moving]
        place = {name: i for i, name in enumerate(moving)}
        action = {each.name: i for i, each in enumerate(scene.actions)}
        fixed = len(moving)
        a = [place.get(m.a, fixed) for m in motors]
        b = [place.get(m.b, fixed) for m in motors]
        inverse = [*(1.0 / moment for moment in moments), 0.0]
        effective = [1.0 / (inverse[i] + inverse[k] or 1.0) for i, k in zip(a, b, strict=True)]
        limits = [m.limits or (-np.inf, np.inf) for m in motors]
        return SoftDrives(
            a=np.array(a, np.intp),
            b=np.array(b, np.intp),
            bodies=tuple(sorted({i for i in (*a, *b) if i < fixed})),
            action=np.array([action[m.action] for m in motors], np.intp),
            rate=np.array([m.max_rate for m in motors], np.float64),
            torque=np.array([m.gain for m in motors]) * np.array(effective),
            softness=np.array([m.softness for m in motors], np.float64),
            low=np.array([low for low, _ in limits], np.float64),
            high=np.array([high for _, high in limits], np.float64),
            fade=np.array([m.fade for m in motors], np.float64),
        )

    def torques(self, states: StateArray, actions: StateArray) -> StateArray:
        """Torques (n, moving) on bodies in states (n, moving, 6) under actions (n, A)."""
        angle, spin = _with_fixed(states[:, :, 4]), _with_fixed(states[:, :, 5])
        command = actions[:, self.action]
        wanted = command * self.rate
        turn = spin[:, self.b] - spin[:, self.a] - wanted
        strength = self.torque * np.tanh(self.softness * turn)
        strength *= self._left(angle[:, self.b] - angle[:, self.a], wanted)
        strength *= command != 0.0
        out = np.zeros_like(spin)
        for k, (a, b) in enumerate(zip(self.a.tolist(), self.b.tolist(), strict=True)):
            out[:, a] += strength[:, k]
            out[:, b] -= strength[:, k]
        return out[:, :-1]

    def _left(self, angle: StateArray, wanted: StateArray) -> StateArray:
        """Share (n, M) of the torque that is left near the limit that a command points to."""
        room = np.where(wanted > 0.0, self.high - angle, angle - self.low)
        return np.clip(room / self.fade, 0.0, 1.0)


def _with_fixed(column: StateArray) -> StateArray:
    """Values (n, moving) with a zero behind: the angle and spin of what does not move."""
    return np.concatenate([column, np.zeros((len(column), 1))], axis=1)
