"""Declarations: names, observations, progress, digest, refusals, the registry of tasks."""

from __future__ import annotations

import dataclasses
import math
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
from toy_scenes import ball, machine, wall

import rtc_cli.tasks as tasks
from rtc_cli.errors import UsageError
from rtc_cli.tasks.scene import (
    Along,
    Body,
    Box,
    Circle,
    Distance,
    Jitter,
    Motor,
    Observe,
    Polygon,
    Scene,
    Segment,
    Thruster,
)


def two_bodies(**settings: Any) -> Scene:
    return ball(wall(3.0), **settings)


STATES = np.array([[[1.0, 2.0, 3.0, 4.0, math.pi / 2, 5.0], [3.0, 2.5, 0.0, 0.0, 0.0, 0.0]]])


@pytest.mark.parametrize(
    ("kind", "other", "wanted"),
    [
        ("position", "", [1.0, 2.0]),
        ("x", "", [1.0]),
        ("y", "", [2.0]),
        ("velocity", "", [3.0, 4.0]),
        ("vx", "", [3.0]),
        ("vy", "", [4.0]),
        ("angle", "", [0.0, 1.0]),
        ("angular_velocity", "", [5.0]),
        ("relative_position", "wall", [2.0, 0.5]),
        ("relative_velocity", "wall", [-3.0, -4.0]),
        ("relative_angle", "wall", [0.0, -1.0]),
        ("local_position", "wall", [0.5, -2.0]),
    ],
)
def test_observation_kinds(kind: Any, other: str, wanted: list[float]) -> None:
    scene = two_bodies(observations=(Observe(kind=kind, body="ball", other=other, scale=2.0),))
    assert len(scene.components) == scene.obs_dim == len(wanted)
    np.testing.assert_allclose(scene.observe(STATES)[0] * 2.0, wanted, atol=1e-6)


def test_observations_are_finite_and_bounded() -> None:
    wild = STATES.copy()
    wild[0, 0, :4] = [np.nan, np.inf, -np.inf, 1e9]
    np.testing.assert_array_equal(two_bodies().observe(wild), [[0.0, 10.0, -10.0, 10.0]])


def test_progress_undoes_scale_and_offset() -> None:
    entry = Observe(kind="position", body="ball", scale=4.0, offset=(1.0, -1.0))
    terms = (
        Distance(observation="ball.position", target=(4.0, 6.0), weight=2.0),
        Along(observation="ball.position", points=((0, 0), (2, 0), (2, 5))),
    )
    scene = two_bodies(observations=(entry,), progress_terms=terms)
    obs = scene.observe(STATES)
    # At (1, 2): 5 m to (4, 6); the second leg is nearest, 1 m away, with 3 m of it left.
    np.testing.assert_allclose(scene.progress(obs), [-2.0 * 5.0 - 4.0], rtol=1e-6)


def test_shapes_know_area_and_centroid() -> None:
    triangle = Polygon(vertices=((1, 1), (4, 1), (1, 7)))
    assert triangle.area == pytest.approx(9.0)
    assert triangle.centroid == pytest.approx((2.0, 3.0))
    turned = Box(width=2, height=1, offset=(1, 0), angle=math.pi / 2)
    assert min(x for x, _ in turned.vertices) == pytest.approx(0.5)
    body = Body(
        name="b", shapes=(Circle(radius=1, offset=(3, 0)), Circle(radius=1, density=2), triangle)
    )
    mass = 3 * math.pi + 9
    assert body.centre == pytest.approx(((3 * math.pi + 18) / mass, 27 / mass))
    assert Segment(start=(0, 0), end=(2, 0), radius=0.5).area == pytest.approx(2 + math.pi / 4)


def test_digest_follows_what_matters_only() -> None:
    scene = machine()
    assert scene.digest == machine().digest
    assert dataclasses.replace(scene, description="other", view=(0, 0, 1, 1)).digest == scene.digest
    assert dataclasses.replace(scene, damping=0.9).digest != scene.digest


@pytest.mark.parametrize(
    ("settings", "part"),
    [
        ({"thrusters": (Thruster(body="bal", action="push", max_force=1),)}, 'mean "ball"'),
        ({"motors": (Motor(a="wall", b="world", action="push", max_rate=1, max_torque=1),)}, "mov"),
        ({"observations": (Observe(kind="relative_angle", body="ball"),)}, "needs `other`"),
        ({"observations": (Observe(kind="x", body="ball", other="wall"),)}, "takes no"),
        ({"observations": (Observe(kind="x", body="ball", scale=0.0),)}, "positive scale"),
        ({"progress_terms": (Distance(observation="ball.positon"),)}, 'mean "ball.position"'),
        ({"jitters": (Jitter(bodies=("wall",)),)}, "jitter"),
        ({"observations": (Observe(kind="X", body="ball"),)}, "Allowed"),  # type: ignore[arg-type]
        ({"bodies": (wall(1.0), wall(2.0))}, "twice"),
    ],
)
def test_bad_scenes_are_refused(settings: dict[str, Any], part: str) -> None:
    with pytest.raises(UsageError, match=part):
        two_bodies(**settings)


def test_unknown_task_is_refused_with_a_suggestion() -> None:
    name = tasks.list_tasks()[0]
    with pytest.raises(UsageError, match=f'mean "{name}"'):
        tasks.get_task(name[:-1])


def test_plugins_add_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {
        "mine": EntryPoint("mine", "toy_scenes:machine", "rtc_cli.tasks"),
        "wrong": EntryPoint("wrong", "math:pi", "rtc_cli.tasks"),
    }
    monkeypatch.setattr(tasks, "_plugins", lambda: entries)
    assert "mine" in tasks.list_tasks()
    assert tasks.get_task("mine") == machine()
    with pytest.raises(UsageError, match="float"):
        tasks.get_task("wrong")
    tasks._named.cache_clear()
