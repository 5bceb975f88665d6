"""What tasks with something on a rail share."""

from __future__ import annotations

from rtc_cli.tasks.scene import WORLD, Spring, Thruster, Vec


def side_thrusters(body: str, half_width: float, max_force: float) -> tuple[Thruster, Thruster]:
    """Thrusters (N at most) at both sides of a body: actions "push_right" and "push_left".

    Each is on one side, `half_width` (m) from the body's origin, and pushes to the other side.
    """
    return (
        _thruster(body, "push_right", -1.0, half_width, max_force),
        _thruster(body, "push_left", 1.0, half_width, max_force),
    )


def rail_friction(body: str, place: Vec, damping: float) -> Spring:
    """Viscous friction (N·s/m) along x for a body on a level rail that starts at `place`.

    A damper whose other end is so far away that it lies along the rail wherever the body is.
    """
    return Spring(
        a=WORLD,
        b=body,
        anchor_a=(-100.0, place[1]),
        anchor_b=place,
        rest_length=100.0,
        stiffness=0.0,
        damping=damping,
    )


def _thruster(body: str, action: str, side: float, half_width: float, force: float) -> Thruster:
    return Thruster(
        body=body,
        action=action,
        max_force=force,
        point=(side * half_width, 0.0),
        direction=(-side, 0.0),
    )
