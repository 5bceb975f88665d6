"""What the modules of the compiled physics share: how they are compiled, columns, arithmetic.

Every number is float32; a literal would make numba compute in float64, so constants are named.
Comparisons are written so that NaN survives them. Small helpers are compiled into their callers.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rtc_cli.tasks.kinetix.packing import Floats

X, Y, VX, VY, ANGLE, SPIN = range(6)  # columns of a body
NUMBERS = 6

# Columns of a contact that pushes, and of what it links.
PX, PY, NX, NY, BIAS, REBOUND, MU, KEEP, PUSH, DRAG = range(10)
CONTACT_NUMBERS = 10
BODY_A, BODY_B, SLOT, RANK = range(4)
CONTACT_INDICES = 4

ZERO: Any = np.float32(0.0)
ONE: Any = np.float32(1.0)
MANY: Any = np.float32(1e30)

compiled = njit(cache=True, error_model="numpy")
inlined = njit(inline="always", error_model="numpy")


class Memory(NamedTuple):
    """What w worlds keep between substeps.

    bodies (w, n, 6); joints (w, j, 3): impulse x, y, and about the joint; impulses (w, points, 2):
    along the normal and the tangent; touching (w, points): whether the point was active.
    """

    bodies: Floats
    joints: Floats
    impulses: Floats
    touching: npt.NDArray[np.bool_]


class Scratch(NamedTuple):
    """Room for one substep; what immovable bodies need is written once, by `prepare`.

    turn (n, 2): cosine, sine; corners (p, 4, 2): places of vertices; box (n, 4): least x, least y,
    greatest x, greatest y; arms (j, 4): anchors as they stand; turned (j,): by motors; contacts
    (c, 10) and links (c, 4);
    change (c, 6): of velocities; order (c,): contacts as they are solved; group: where each batch
    of them begins.
    """

    turn: Floats
    corners: Floats
    box: Floats
    arms: Floats
    turned: Floats
    contacts: Floats
    links: npt.NDArray[np.int64]
    change: Floats
    order: npt.NDArray[np.int64]
    group: npt.NDArray[np.int64]


@inlined
def clamp(value: float, low: float, high: float) -> float:
    """The value in [low, high]; `high` wins where they cross, NaN stays."""
    raised = low if value < low else value
    return high if raised > high else raised


@inlined
def or_one(value: float) -> float:
    """The value, or 1 in place of 0: a divisor."""
    return ONE if value == ZERO else value
