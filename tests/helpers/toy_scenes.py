"""Small scenes for tests of the worlds."""

from __future__ import annotations

import math

from rtc_cli.tasks.scene import (
    WORLD,
    Action,
    Body,
    Box,
    Circle,
    Distance,
    Groove,
    Jitter,
    Motor,
    Observe,
    Pivot,
    Polygon,
    Role,
    Rope,
    Scene,
    Segment,
    Spring,
    Thruster,
)


def machine() -> Scene:
    """Six moving bodies, five joints, two motors, two thrusters, a pile of boxes in contact."""
    floor = Body(
        name="floor",
        static=True,
        shapes=(
            Segment(start=(-4.0, 0.0), end=(4.0, 0.0), radius=0.05, restitution=0.3),
            Segment(start=(-4.0, 0.0), end=(-4.0, 3.0), radius=0.05),
            Segment(start=(4.0, 0.0), end=(4.0, 3.0), radius=0.05),
        ),
    )
    hull = Body(
        name="hull",
        position=(0.0, 1.2),
        shapes=(
            Polygon(vertices=((-0.4, -0.15), (0.4, -0.15), (0.2, 0.3), (-0.2, 0.2)), group=1),
            Circle(radius=0.1, offset=(0.0, 0.3), density=0.4, group=1, role=Role.GOAL),
        ),
    )
    legs = tuple(
        Body(
            name=f"leg{i}",
            position=(x, 0.9),
            angle=0.1 * i,
            shapes=(Box(width=0.12, height=0.5, group=1, friction=0.9, restitution=0.2),),
        )
        for i, x in enumerate((-0.4, 0.4))
    )
    boxes = tuple(
        Body(
            name=f"box{i}",
            position=(1.2 + 0.02 * i, 0.2 + 0.32 * i),
            shapes=(Box(width=0.3, height=0.3, density=0.3),),
        )
        for i in range(2)
    )
    ball = Body(
        name="ball",
        position=(-1.5, 1.0),
        shapes=(Circle(radius=0.2, restitution=0.8, density=0.5),),
    )
    target = Body(
        name="target",
        static=True,
        position=(2.6, 1.5),
        angle=0.3,
        shapes=(Box(width=0.4, height=0.4, role=Role.TARGET),),
    )
    hazard = Body(
        name="hazard",
        static=True,
        position=(-2.8, 1.2),
        shapes=(Polygon(vertices=((-0.3, 0.0), (0.3, 0.0), (0.0, 0.6)), role=Role.HAZARD),),
    )
    group = ("hull", "leg0", "leg1")
    return Scene(
        name="machine",
        bodies=(floor, hull, *legs, *boxes, ball, target, hazard),
        joints=(
            Pivot(a="hull", b="leg0", anchor=(-0.4, 1.1), limits=(-0.8, 0.8)),
            Pivot(a="hull", b="leg1", anchor=(0.4, 1.1), limits=(-0.8, 0.8)),
            Spring(
                a="leg0",
                b="leg1",
                anchor_a=(-0.4, 0.8),
                anchor_b=(0.4, 0.8),
                rest_length=0.8,
                stiffness=3.0,
                damping=0.1,
            ),
            Rope(
                a="hull",
                b="ball",
                anchor_a=(0.0, 1.2),
                anchor_b=(-1.5, 1.0),
                length=1.8,
                collide=True,
            ),
            Rope(a=WORLD, b="box1", anchor_a=(1.2, 2.0), anchor_b=(1.22, 0.52), length=1.7),
        ),
        actions=(
            Action(name="leg0"),
            Action(name="leg1"),
            Action(name="left", low=0.0),
            Action(name="right", low=0.0),
        ),
        motors=(
            Motor(a="hull", b="leg0", action="leg0", max_rate=4.0, max_torque=1.0),
            Motor(a="hull", b="leg1", action="leg1", max_rate=4.0, max_torque=1.0),
        ),
        thrusters=(
            Thruster(body="hull", action="left", max_force=6.0, point=(-0.3, -0.1)),
            Thruster(body="hull", action="right", max_force=6.0, point=(0.3, -0.1)),
        ),
        jitters=(
            Jitter(bodies=group, position=(0.3, 0.1), angle=0.2, velocity=(1.0, 0.5)),
            Jitter(bodies=("ball",), velocity=(2.0, 1.0), angular_velocity=3.0),
        ),
        observations=(
            Observe(kind="position", body="hull", scale=3.0),
            Observe(kind="velocity", body="hull", scale=3.0),
            Observe(kind="angle", body="hull"),
            Observe(kind="angular_velocity", body="hull", scale=5.0),
            Observe(kind="relative_angle", body="hull", other="leg0"),
            Observe(kind="relative_position", body="hull", other="target", scale=3.0),
            Observe(kind="local_position", body="hull", other="ball", scale=3.0),
        ),
        progress_terms=(Distance(observation="hull.relative_position.target"),),
        bounds=(-3.9, -1.0, 3.9, 6.0),
    )


def ball(
    *bodies: Body,
    position: tuple[float, float] = (0.0, 1.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    restitution: float = 0.0,
    **settings: object,
) -> Scene:
    """A goal disc of radius 0.1 and density 1 with a sideways thruster, and other bodies."""
    disc = Circle(radius=0.1, role=Role.GOAL, restitution=restitution, friction=0.0)
    moving = Body(name="ball", shapes=(disc,), position=position, velocity=velocity)
    values: dict[str, object] = {
        "name": "ball",
        "bodies": (moving, *bodies),
        "actions": (Action(name="push"),),
        "thrusters": (Thruster(body="ball", action="push", max_force=2.0, direction=(1.0, 0.0)),),
        "observations": (
            Observe(kind="position", body="ball"),
            Observe(kind="velocity", body="ball"),
        ),
        "action_noise": 0.0,
    }
    return Scene(**{**values, **settings})  # type: ignore[arg-type]


def wall(x: float, role: Role = Role.NONE, name: str = "wall", sensor: bool = False) -> Body:
    """A static box whose left side is at `x`."""
    shape = Box(width=1.0, height=20.0, role=role, restitution=1.0, friction=0.0, sensor=sensor)
    return Body(name=name, static=True, position=(x + 0.5, 0.0), shapes=(shape,))


BALL_MASS_KG = math.pi * 0.1**2
__all__ = ["BALL_MASS_KG", "Groove", "ball", "machine", "wall"]
