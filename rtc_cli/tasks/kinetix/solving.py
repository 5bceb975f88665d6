"""Impulses of joints and contacts: warm start, and one iteration over each.

Sources: jax2d 1.0.1, `joint.py`, `collision.py` (`resolve_*`) and the batches of `engine.py`.
"""

import math

from rtc_cli.tasks.kinetix.numerics import (
    ANGLE,
    BIAS,
    BODY_A,
    BODY_B,
    DRAG,
    KEEP,
    MU,
    NX,
    NY,
    ONE,
    PUSH,
    PX,
    PY,
    REBOUND,
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
from rtc_cli.tasks.kinetix.packing import Bodies, Floats, Joints, Laws


@compiled
def reach(joints: Joints, turn: Floats, arms: Floats) -> None:
    """Anchors of joints, turned with their bodies."""
    for j in range(joints.a.shape[0]):
        for side in range(2):
            i = joints.b[j] if side else joints.a[j]
            u, v = joints.anchors[j, 2 * side], joints.anchors[j, 2 * side + 1]
            arms[j, 2 * side] = turn[i, 0] * u - turn[i, 1] * v
            arms[j, 2 * side + 1] = turn[i, 1] * u + turn[i, 0] * v


@compiled
def start_warm(
    shapes: Bodies, joints: Joints, bodies: Floats, pull: Floats, scratch: Scratch, found: int
) -> None:
    """Apply the impulses of the last substep: of contacts, then of joints."""
    for c in range(found):
        contact = scratch.contacts[c]
        a, b = scratch.links[c, BODY_A], scratch.links[c, BODY_B]
        jx = contact[PUSH] * contact[NX] + contact[DRAG] * contact[NY]
        jy = contact[PUSH] * contact[NY] - contact[DRAG] * contact[NX]
        ax, ay = contact[PX] - bodies[a, X], contact[PY] - bodies[a, Y]
        bx, by = contact[PX] - bodies[b, X], contact[PY] - bodies[b, Y]
        bodies[a, VX] -= jx * shapes.inverse_mass[a]
        bodies[a, VY] -= jy * shapes.inverse_mass[a]
        bodies[a, SPIN] -= shapes.inverse_inertia[a] * (ax * jy - ay * jx)
        bodies[b, VX] += jx * shapes.inverse_mass[b]
        bodies[b, VY] += jy * shapes.inverse_mass[b]
        bodies[b, SPIN] += shapes.inverse_inertia[b] * (bx * jy - by * jx)
    arms = scratch.arms
    for j in range(joints.a.shape[0]):
        a, b = joints.a[j], joints.b[j]
        jx, jy, twist = pull[j, 0], pull[j, 1], pull[j, 2]
        bodies[a, VX] += jx * shapes.inverse_mass[a]
        bodies[a, VY] += jy * shapes.inverse_mass[a]
        bodies[a, SPIN] += shapes.inverse_inertia[a] * (arms[j, 0] * jy - arms[j, 1] * jx + twist)
        bodies[b, VX] -= jx * shapes.inverse_mass[b]
        bodies[b, VY] -= jy * shapes.inverse_mass[b]
        bodies[b, SPIN] -= shapes.inverse_inertia[b] * (arms[j, 2] * jy - arms[j, 3] * jx + twist)


@compiled
def solve_joints(
    laws: Laws, shapes: Bodies, joints: Joints, bodies: Floats, pull: Floats, arms: Floats
) -> None:
    """One iteration over all joints, one by one: velocities, places, angles."""
    for j in range(joints.a.shape[0]):
        a, b = joints.a[j], joints.b[j]
        wa, wb = shapes.inverse_mass[a], shapes.inverse_mass[b]
        ia, ib = shapes.inverse_inertia[a], shapes.inverse_inertia[b]
        ax, ay, bx, by = arms[j, 0], arms[j, 1], arms[j, 2], arms[j, 3]
        pax, pay = bodies[a, X] + ax, bodies[a, Y] + ay
        pbx, pby = bodies[b, X] + bx, bodies[b, Y] + by
        gap_x, gap_y = pbx - pax, pby - pay
        if wa == ZERO:
            px, py = pax, pay
        elif wb == ZERO:
            px, py = pbx, pby
        else:
            total = ONE / wa + ONE / wb
            px, py = (pax / wa + pbx / wb) / total, (pay / wa + pby / wb) / total
        spin_a, spin_b = bodies[a, SPIN], bodies[b, SPIN]
        ux = (bodies[b, VX] - spin_b * (py - bodies[b, Y])) - (
            bodies[a, VX] - spin_a * (py - bodies[a, Y])
        )
        uy = (bodies[b, VY] + spin_b * (px - bodies[b, X])) - (
            bodies[a, VY] + spin_a * (px - bodies[a, X])
        )
        speed = or_one(math.sqrt(ux * ux + uy * uy))
        ex, ey = ux / speed, uy / speed
        mass = or_one(wa + wb)
        lever_a, lever_b = ax * ey - ay * ex, bx * ey - by * ex
        weight = or_one(mass + (lever_a * lever_a * ia + lever_b * lever_b * ib))
        jx = (ux + laws.joint_velocity * gap_x) / weight * laws.joint_stiffness
        jy = (uy + laws.joint_velocity * gap_y) / weight * laws.joint_stiffness
        pull[j, 0] += jx
        pull[j, 1] += jy
        bodies[a, VX] += wa * jx
        bodies[a, VY] += wa * jy
        bodies[b, VX] -= wb * jx
        bodies[b, VY] -= wb * jy
        spin_a += (ax * jy - ay * jx) * ia
        spin_b -= (bx * jy - by * jx) * ib
        step_x, step_y = gap_x / mass * laws.joint_position, gap_y / mass * laws.joint_position
        bodies[a, X] += step_x * wa
        bodies[a, Y] += step_y * wa
        bodies[b, X] -= step_x * wb
        bodies[b, Y] -= step_y * wb
        at = bodies[b, ANGLE] - bodies[a, ANGLE] - joints.angles[j, 0]
        twist = ZERO
        if joints.fixed[j] != 0:
            twist = (spin_b - spin_a + at * laws.weld_rate) / or_one(ia + ib)
            pull[j, 2] += twist
        elif joints.limited[j] != 0:
            beyond = at - clamp(at, joints.angles[j, 1], joints.angles[j, 2])
            lag = spin_b - spin_a
            if (beyond > ZERO and lag > ZERO) or (beyond < ZERO and lag < ZERO):
                twist = (lag + beyond * laws.limit_rate) / or_one(ia + ib)
        bodies[a, SPIN] = spin_a + twist * ia
        bodies[b, SPIN] = spin_b - twist * ib


@compiled
def solve_contacts(shapes: Bodies, bodies: Floats, scratch: Scratch, groups: int) -> None:
    """One iteration over all batches; inside one, impulses follow from the same velocities."""
    contacts, links, change = scratch.contacts, scratch.links, scratch.change
    for g in range(groups):
        first, end = scratch.group[g], scratch.group[g + 1]
        for k in range(first, end):
            c = scratch.order[k]
            a, b = links[c, BODY_A], links[c, BODY_B]
            wa, wb = shapes.inverse_mass[a], shapes.inverse_mass[b]
            ia, ib = shapes.inverse_inertia[a], shapes.inverse_inertia[b]
            nx, ny = contacts[c, NX], contacts[c, NY]
            ax, ay = contacts[c, PX] - bodies[a, X], contacts[c, PY] - bodies[a, Y]
            bx, by = contacts[c, PX] - bodies[b, X], contacts[c, PY] - bodies[b, Y]
            vax, vay, spin_a = bodies[a, VX], bodies[a, VY], bodies[a, SPIN]
            vbx, vby, spin_b = bodies[b, VX], bodies[b, VY], bodies[b, SPIN]
            mass = wa + wb
            far_a, far_b = ax * ax + ay * ay, bx * bx + by * by
            # Along the normal.
            ux, uy = vbx - spin_b * by - vax + spin_a * ay, vby + spin_b * bx - vay - spin_a * ax
            along_a, along_b = ax * nx + ay * ny, bx * nx + by * ny
            weight = mass + ia * (far_a - along_a * along_a) + ib * (far_b - along_b * along_b)
            wanted = contacts[c, BIAS] - (ux * nx + uy * ny) - contacts[c, REBOUND]
            push = contacts[c, PUSH] + wanted / or_one(weight)
            push = ZERO if push < ZERO else push
            more = push - contacts[c, PUSH]
            jx, jy = more * nx, more * ny
            # Along the tangent (ny, −nx), with the new velocities.
            turn_a, turn_b = ia * (ax * jy - ay * jx), ib * (bx * jy - by * jx)
            sa, sb = spin_a - turn_a, spin_b + turn_b
            ux = (vbx + wb * jx) - sb * by - (vax - wa * jx) + sa * ay
            uy = (vby + wb * jy) + sb * bx - (vay - wa * jy) - sa * ax
            along_a, along_b = ax * ny - ay * nx, bx * ny - by * nx
            weight = mass + ia * (far_a - along_a * along_a) + ib * (far_b - along_b * along_b)
            most = contacts[c, MU] * push
            drag = contacts[c, DRAG] - (ux * ny - uy * nx) / or_one(weight)
            drag = clamp(drag, -most, most)
            more = drag - contacts[c, DRAG]
            tx, ty = more * ny, -more * nx
            change[k, 0], change[k, 1] = -wa * jx - wa * tx, -wa * jy - wa * ty
            change[k, 2] = -turn_a - ia * (ax * ty - ay * tx)
            change[k, 3], change[k, 4] = wb * jx + wb * tx, wb * jy + wb * ty
            change[k, 5] = turn_b + ib * (bx * ty - by * tx)
            contacts[c, PUSH], contacts[c, DRAG] = (
                push * contacts[c, KEEP],
                drag * contacts[c, KEEP],
            )
        for k in range(first, end):
            c = scratch.order[k]
            a, b = links[c, BODY_A], links[c, BODY_B]
            bodies[a, VX] += change[k, 0]
            bodies[a, VY] += change[k, 1]
            bodies[a, SPIN] += change[k, 2]
            bodies[b, VX] += change[k, 3]
            bodies[b, VY] += change[k, 4]
            bodies[b, SPIN] += change[k, 5]
