"""Which shapes touch, where, and in which order that is solved.

Where the original computes for all pairs and masks, this looks only at pairs whose bounding boxes
meet. Sources: jax2d 1.0.1, `collision.py` and the batches of `engine.py`.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.kinetix.numerics import (
    ANGLE,
    BIAS,
    BODY_A,
    BODY_B,
    DRAG,
    KEEP,
    MANY,
    MU,
    NX,
    NY,
    ONE,
    PUSH,
    PX,
    PY,
    RANK,
    REBOUND,
    SLOT,
    SPIN,
    VX,
    VY,
    ZERO,
    Scratch,
    X,
    Y,
    clamp,
    compiled,
    or_one,
)
from rtc_cli.tasks.kinetix.packing import (
    CIRCLE_POLYGON,
    FAILURE,
    NOTHING,
    POLYGONS,
    SUCCESS,
    Bodies,
    Floats,
    Indices,
    Laws,
    Pairs,
)

NORMAL_X, NORMAL_Y, REACH, ALONG_X, ALONG_Y, LENGTH = range(6)  # of an edge
FLIP_MARGIN: Any = np.float32(0.01)  # so that the reference edge does not change sides all the time
ROUNDING_M: Any = np.float32(1e-3)  # boxes are that much larger than what they hold
HALF_TURN: Any = np.float32(math.pi)


@compiled
def place(shapes: Bodies, which: Indices, bodies: Floats, scratch: Scratch) -> None:
    """Directions, places of vertices and bounding boxes of bodies `which`."""
    turn, corners, box = scratch.turn, scratch.corners, scratch.box
    polygons = shapes.corners.shape[0]
    for k in range(which.shape[0]):
        i = which[k]
        x, y = bodies[i, X], bodies[i, Y]
        c, s = math.cos(bodies[i, ANGLE]), math.sin(bodies[i, ANGLE])
        turn[i, 0], turn[i, 1] = c, s
        if i < polygons:
            low_x, low_y, high_x, high_y = MANY, MANY, -MANY, -MANY
            for v in range(shapes.corners[i]):
                u, w = shapes.vertices[i, v, 0], shapes.vertices[i, v, 1]
                px, py = c * u - s * w + x, s * u + c * w + y
                corners[i, v, 0], corners[i, v, 1] = px, py
                low_x, high_x = min(low_x, px), max(high_x, px)
                low_y, high_y = min(low_y, py), max(high_y, py)
        else:
            r = shapes.radius[i]
            low_x, low_y, high_x, high_y = x - r, y - r, x + r, y + r
        box[i, 0], box[i, 1] = low_x - ROUNDING_M, low_y - ROUNDING_M
        box[i, 2], box[i, 3] = high_x + ROUNDING_M, high_y + ROUNDING_M


@compiled
def find_contacts(
    laws: Laws,
    shapes: Bodies,
    pairs: Pairs,
    bodies: Floats,
    impulses: Floats,
    touching: npt.NDArray[np.bool_],
    scratch: Scratch,
) -> tuple[int, int, int]:
    """Contacts that push, in the order in which they are solved: how many, batches, meaning.

    A point that was active in the last substep goes on from its impulses, any other from 0.
    """
    links, box = scratch.links, scratch.box
    found, groups, filled = 0, 0, 0
    scratch.group[0] = 0
    success, failure = False, False
    for kind in range(3):
        first, active = found, 0
        for p in range(pairs.start[kind], pairs.start[kind + 1]):
            a, b, slot = pairs.a[p], pairs.b[p], int(pairs.slot[p])
            one, two = False, False
            if (
                box[a, 0] <= box[b, 2]
                and box[b, 0] <= box[a, 2]
                and box[a, 1] <= box[b, 3]
                and box[b, 1] <= box[a, 3]
            ):
                if kind == POLYGONS:
                    one, two = _touch_polygons(shapes, scratch, bodies, a, b, found)
                elif kind == CIRCLE_POLYGON:
                    one = _touch_polygon(shapes, scratch, bodies, a, b, found)
                else:
                    one = _touch_circle(shapes, scratch, bodies, a, b, found)
            if one:
                success |= pairs.outcome[p] == SUCCESS
                failure |= pairs.outcome[p] == FAILURE
                if pairs.resolved[p] != 0:
                    for point in range(2 if two else 1):
                        _note(
                            laws, pairs, bodies, impulses, touching, scratch, p, found, slot + point
                        )
                        links[found, RANK] = active
                        found += 1
                active += 1
            touching[slot] = one
            if kind == POLYGONS:
                touching[slot + 1] = two
        # The r-th of m active pairs stands at n − m + r in a list of n that is dealt to batches.
        shift = pairs.capacity[kind] - active
        for point in range(2 if kind == POLYGONS else 1):
            for batch in range(pairs.batches[kind]):
                before = filled
                for c in range(first, found):
                    mine = kind != POLYGONS or links[c, SLOT] % 2 == point
                    if mine and (shift + links[c, RANK]) % pairs.batches[kind] == batch:
                        scratch.order[filled] = c
                        filled += 1
                if filled > before:
                    groups += 1
                    scratch.group[groups] = filled
    return found, groups, FAILURE if failure else SUCCESS if success else NOTHING


@compiled
def _note(
    laws: Laws,
    pairs: Pairs,
    bodies: Floats,
    impulses: Floats,
    touching: npt.NDArray[np.bool_],
    scratch: Scratch,
    p: int,
    c: int,
    slot: int,
) -> None:
    """Complete contact c, of which place, normal and depth (in BIAS) are known."""
    contact, links = scratch.contacts[c], scratch.links[c]
    a, b = pairs.a[p], pairs.b[p]
    links[BODY_A], links[BODY_B], links[SLOT] = a, b, slot
    deep = contact[BIAS] - laws.slop
    contact[BIAS] = laws.contact_rate * (ZERO if deep < ZERO else deep)
    ax, ay = contact[PX] - bodies[a, X], contact[PY] - bodies[a, Y]
    bx, by = contact[PX] - bodies[b, X], contact[PY] - bodies[b, Y]
    ux = bodies[b, VX] - bodies[b, SPIN] * by - bodies[a, VX] + bodies[a, SPIN] * ay
    uy = bodies[b, VY] + bodies[b, SPIN] * bx - bodies[a, VY] - bodies[a, SPIN] * ax
    contact[REBOUND] = (ux * contact[NX] + uy * contact[NY]) * pairs.restitution[p]
    contact[MU] = pairs.friction[p]
    contact[KEEP] = ZERO if pairs.forgets[p] != 0 else ONE
    contact[PUSH] = impulses[slot, 0] if touching[slot] else ZERO
    contact[DRAG] = impulses[slot, 1] if touching[slot] else ZERO


@compiled
def _touch_polygons(
    shapes: Bodies, scratch: Scratch, bodies: Floats, a: int, b: int, c: int
) -> tuple[bool, bool]:
    """Which of two points polygons a and b touch at; contacts c and c + 1 get place and normal."""
    turn, corners, contacts = scratch.turn, scratch.corners, scratch.contacts
    apart_a, edge_a, one_a, two_a = _least_penetration(shapes, turn, corners, bodies, a, b)
    if apart_a >= ZERO:
        return False, False
    apart_b, edge_b, one_b, two_b = _least_penetration(shapes, turn, corners, bodies, b, a)
    if apart_b >= ZERO:
        return False, False
    flipped = apart_a + FLIP_MARGIN < apart_b
    if flipped:
        own, other, edge, one, two = b, a, edge_b, one_b, two_b
    else:
        own, other, edge, one, two = a, b, edge_a, one_a, two_a
    after = edge + 1 if edge + 1 < shapes.corners[own] else 0
    x0, y0 = corners[own, edge, 0], corners[own, edge, 1]
    dx, dy = x0 - corners[own, after, 0], y0 - corners[own, after, 1]
    length = math.sqrt(dx * dx + dy * dy)
    # Into a frame in which the edge runs along the second axis and depth is the first.
    angle = HALF_TURN + math.atan2(dx, dy)
    tc, ts = math.cos(angle), math.sin(angle)
    ex, ey = corners[other, one, 0] - x0, corners[other, one, 1] - y0
    fx, fy = corners[other, two, 0] - x0, corners[other, two, 1] - y0
    depth_1, along_1 = tc * ex - ts * ey, clamp(ts * ex + tc * ey, ZERO, length)
    depth_2, along_2 = tc * fx - ts * fy, clamp(ts * fx + tc * fy, ZERO, length)
    both = min(depth_1, depth_2) > ZERO
    if depth_2 > depth_1:
        depth_1, along_1, depth_2, along_2 = depth_2, along_2, depth_1, along_1
    normal_x, normal_y = shapes.edges[own, edge, NORMAL_X], shapes.edges[own, edge, NORMAL_Y]
    wx = turn[own, 0] * normal_x - turn[own, 1] * normal_y
    wy = turn[own, 1] * normal_x + turn[own, 0] * normal_y
    if flipped:
        wx, wy = -wx, -wy
    deep = -max(apart_a, apart_b)
    contacts[c, PX] = tc * depth_1 + ts * along_1 + x0
    contacts[c, PY] = tc * along_1 - ts * depth_1 + y0
    contacts[c, NX], contacts[c, NY], contacts[c, BIAS] = wx, wy, deep
    if both:
        contacts[c + 1, PX] = tc * depth_2 + ts * along_2 + x0
        contacts[c + 1, PY] = tc * along_2 - ts * depth_2 + y0
        contacts[c + 1, NX], contacts[c + 1, NY], contacts[c + 1, BIAS] = wx, wy, deep
    return True, both


@compiled
def _least_penetration(
    shapes: Bodies, turn: Floats, corners: Floats, bodies: Floats, a: int, b: int
) -> tuple[float, int, int, int]:
    """Of polygon a the edge that polygon b is furthest out of, and the vertices of b next to it.

    (distance, edge, vertex, vertex); the distance is ≥ 0, and the rest without meaning, as soon as
    some edge separates the two.
    """
    x, y, c, s = bodies[a, X], bodies[a, Y], turn[a, 0], turn[a, 1]
    best, edge, one, two = -MANY, 0, 0, 0
    for k in range(shapes.corners[a]):
        nx, ny = shapes.edges[a, k, NORMAL_X], shapes.edges[a, k, NORMAL_Y]
        low, next_low, at, next_at = MANY, MANY, 0, 0
        for v in range(shapes.corners[b]):
            dx, dy = corners[b, v, 0] - x, corners[b, v, 1] - y
            along = nx * (c * dx + s * dy) + ny * (c * dy - s * dx)
            if along < low:
                low, next_low, at, next_at = along, low, v, at
            elif along < next_low:
                next_low, next_at = along, v
        apart = low - shapes.edges[a, k, REACH]
        if apart >= ZERO:
            return apart, k, at, next_at
        if apart > best:
            best, edge, one, two = apart, k, at, next_at
    return best, edge, one, two


@compiled
def _touch_polygon(
    shapes: Bodies, scratch: Scratch, bodies: Floats, a: int, b: int, contact: int
) -> bool:
    """Whether circle a touches polygon b; the contact gets place and normal."""
    c, s = scratch.turn[b, 0], scratch.turn[b, 1]
    dx, dy = bodies[a, X] - bodies[b, X], bodies[a, Y] - bodies[b, Y]
    x, y = c * dx + s * dy, c * dy - s * dx
    nearest, gx, gy = MANY, ZERO, ZERO
    inside = True
    for k in range(shapes.corners[b]):
        px, py = shapes.vertices[b, k, 0], shapes.vertices[b, k, 1]
        ux, uy = shapes.edges[b, k, ALONG_X], shapes.edges[b, k, ALONG_Y]
        length = shapes.edges[b, k, LENGTH]
        along = clamp(ux * (x - px) + uy * (y - py), ZERO, length)
        qx, qy = px + along * ux, py + along * uy
        away = math.sqrt((qx - x) * (qx - x) + (qy - y) * (qy - y))
        if away < nearest:
            nearest, gx, gy = away, qx, qy
        after = k + 1 if k + 1 < shapes.corners[b] else 0
        ex, ey = shapes.vertices[b, after, 0] - x, shapes.vertices[b, after, 1] - y
        inside &= (px - x) * ey - (py - y) * ex < ZERO
    r = shapes.radius[a]
    if not (nearest <= r or inside):
        return False
    nx, ny = x - gx, y - gy
    wx, wy = c * nx - s * ny, s * nx + c * ny
    if inside:
        wx, wy = -wx, -wy
    size = or_one(math.sqrt(wx * wx + wy * wy))
    found = scratch.contacts[contact]
    found[NX], found[NY] = -wx / size, -wy / size
    found[PX], found[PY] = c * gx - s * gy + bodies[b, X], s * gx + c * gy + bodies[b, Y]
    found[BIAS] = r if inside else r - nearest
    return True


@compiled
def _touch_circle(
    shapes: Bodies, scratch: Scratch, bodies: Floats, a: int, b: int, contact: int
) -> bool:
    """Whether circles a and b touch; the contact gets place and normal."""
    dx, dy = bodies[b, X] - bodies[a, X], bodies[b, Y] - bodies[a, Y]
    away = math.sqrt(dx * dx + dy * dy)
    reach = shapes.radius[a] + shapes.radius[b]
    if not away < reach:
        return False
    size = or_one(away)
    found = scratch.contacts[contact]
    found[NX], found[NY] = dx / size, dy / size
    found[PX] = bodies[a, X] + found[NX] * shapes.radius[a]
    found[PY] = bodies[a, Y] + found[NY] * shapes.radius[a]
    found[BIAS] = reach - away
    return True
