"""From declared quantities to numbers: observation entries of body states, jittered starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from rtc_cli.tasks.scene import Jitter, Observe, Scene

StateArray = npt.NDArray[np.float64]

# Kind of observation -> names of its components, unit.
COMPONENTS: dict[str, tuple[tuple[str, ...], str]] = {
    "position": (("x", "y"), "m"),
    "x": (("x",), "m"),
    "y": (("y",), "m"),
    "velocity": (("vx", "vy"), "m/s"),
    "vx": (("vx",), "m/s"),
    "vy": (("vy",), "m/s"),
    "angle": (("cos", "sin"), "1"),
    "angular_velocity": (("w",), "rad/s"),
    "relative_position": (("dx", "dy"), "m"),
    "relative_velocity": (("dvx", "dvy"), "m/s"),
    "relative_angle": (("cos", "sin"), "1"),
    "local_position": (("lx", "ly"), "m"),
}


def values(scene: Scene, entry: Observe, states: StateArray) -> StateArray:
    """Physical values (n, size) of one observation entry."""
    body = states[:, scene.body_index[entry.body]]
    other = states[:, scene.body_index[entry.other]] if entry.other else body
    difference = other - body
    match entry.kind:
        case "position":
            return body[:, 0:2]
        case "x":
            return body[:, 0:1]
        case "y":
            return body[:, 1:2]
        case "velocity":
            return body[:, 2:4]
        case "vx":
            return body[:, 2:3]
        case "vy":
            return body[:, 3:4]
        case "angle":
            return _cos_sin(body[:, 4])
        case "angular_velocity":
            return body[:, 5:6]
        case "relative_position":
            return difference[:, 0:2]
        case "relative_velocity":
            return difference[:, 2:4]
        case "relative_angle":
            return _cos_sin(difference[:, 4])
        case "local_position":
            turn = _cos_sin(body[:, 4])
            c, s = turn[:, 0], turn[:, 1]
            dx, dy = difference[:, 0], difference[:, 1]
            return np.stack([c * dx + s * dy, c * dy - s * dx], axis=1)


def _cos_sin(angle: StateArray) -> StateArray:
    return np.stack([np.cos(angle.copy()), np.sin(angle.copy())], axis=1)


def apply_jitter(scene: Scene, jitter: Jitter, u: StateArray, states: StateArray) -> None:
    """Move a group rigidly, in place; u (n, 6) in [−1, 1]."""
    index = [scene.body_index[name] for name in jitter.bodies]
    first = states[:, index[0], 0:2].copy()
    pivot = first
    if jitter.pivot is not None:
        declared = np.array(scene.bodies[index[0]].position)
        pivot = first + (np.array(jitter.pivot) - declared)
    shift = u[:, 0:2] * np.array(jitter.position)
    speed = u[:, 2:4] * np.array(jitter.velocity)
    angle, spin = u[:, 4] * jitter.angle, u[:, 5] * jitter.angular_velocity
    for i in index:
        arm = _turned(states[:, i, 0:2] - pivot, angle)
        states[:, i, 0:2] = pivot + arm + shift
        states[:, i, 4] += angle
        states[:, i, 5] += spin
        centre = np.broadcast_to(np.array(scene.bodies[i].centre), arm.shape)
        lever = arm + _turned(centre, states[:, i, 4])
        states[:, i, 2] += speed[:, 0] - spin * lever[:, 1]
        states[:, i, 3] += speed[:, 1] + spin * lever[:, 0]


def _turned(vectors: StateArray, angle: StateArray) -> StateArray:
    """Vectors (n, 2) turned by angles (n,)."""
    c, s = np.cos(angle.copy()), np.sin(angle.copy())
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=1)
