"""The tasks on legs: how fast they topple, and what their hazards are."""

import math
from dataclasses import replace

import numpy as np
import pytest
from episodes import play, still

from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.legs import Leg
from rtc_cli.tasks.library import half_cheetah, walker
from rtc_cli.tasks.scene import Body, Box, Circle, Role, Status

G = 9.81


def parts(body: Body) -> list[tuple[float, float, np.ndarray]]:
    """Mass, moment about its own centre, and centre in the world of every shape of a body."""
    out = []
    c, s = math.cos(body.angle), math.sin(body.angle)
    turn = np.array([[c, -s], [s, c]])
    for shape in body.shapes:
        mass = shape.density * shape.area
        if isinstance(shape, Box):
            moment = mass * (shape.width**2 + shape.height**2) / 12
        else:
            assert isinstance(shape, Circle)
            moment = mass * shape.radius**2 / 2
        out.append((mass, moment, np.array(body.position) + turn @ np.array(shape.centroid)))
    return out


def toppling_time(torso: Body, stands: Leg, other: Leg) -> float:
    """Seconds in which a tilt grows by e: a stiff body balanced on one round foot that rolls.

    (J + m l²) θ'' = m g (l − r) θ, with l the height of the centre of gravity above the ground
    and r the foot's radius.
    """
    height = torso.position[1]
    bodies = (torso, *stands.bodies(height), *other.bodies(height))
    every = [part for body in bodies for part in parts(body)]
    mass, moment, centre = (np.array(x) for x in zip(*every, strict=True))
    middle = mass @ centre / mass.sum()
    about = moment.sum() + mass @ np.sum((centre - middle) ** 2, axis=1)
    shin = stands.bodies(height)[1]
    ankle = np.array(shin.position) + stands.bone * np.array(
        [math.sin(shin.angle), -math.cos(shin.angle)]
    )
    above = float(np.linalg.norm(middle - ankle))  # balanced: straight above the foot
    reach = above + stands.foot_radius
    return math.sqrt((about + mass.sum() * reach**2) / (mass.sum() * G * above))


def test_time_constants_of_the_docstrings():
    lifted = replace(walker.RIGHT, thigh=0.0, knee=-1.2)
    standing = replace(walker.LEFT, thigh=0.3, knee=-0.6)
    assert toppling_time(walker._torso(), standing, lifted) == pytest.approx(0.35, abs=0.015)
    lifted = replace(half_cheetah.FRONT, knee=-1.2)
    assert toppling_time(half_cheetah._torso(), half_cheetah.HIND, lifted) == pytest.approx(
        0.27, abs=0.015
    )


@pytest.mark.parametrize("task", ["walker", "half_cheetah"])
def test_who_stands_still_is_caught_by_the_wall(task):
    scene = replace(get_task(task), action_noise=0.0, jitters=())
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        status, length = [Status.RUNNING], 0
        while status[0] == Status.RUNNING:
            record = worlds.step(np.zeros((1, 8, scene.action_dim), np.float32))
            status, length = record.status, length + int(record.ticks[0])
        torso = worlds.states[0, scene.body_index["torso"]]
        wall = worlds.states[0, scene.body_index["wall"]]
    assert status[0] == Status.FAILED
    assert length > 90  # a standing machine stands: it neither falls nor touches the bar
    assert wall[0] < torso[0]
    assert play(get_task(task), still(scene), np.arange(40)).failed > 0.8


@pytest.mark.parametrize("task", ["walker", "half_cheetah"])
def test_legs_touch_nothing_but_the_ground(task):
    scene = get_task(task)
    moving = {b.name: b.shapes for b in scene.bodies if not b.static}
    around = [s for b in scene.bodies for s in b.shapes if s.role in (Role.HAZARD, Role.TARGET)]
    assert around
    for name, shapes in moving.items():
        meets = [bool(a.mask & s.category and s.mask & a.category) for s in shapes for a in around]
        assert any(meets) == (name == "torso"), name
