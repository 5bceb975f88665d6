"""Physics and episode rules against closed forms."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from toy_scenes import BALL_MASS_KG, ball, machine, wall

from rtc_cli.errors import UsageError
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import (
    SUBSTEP_S,
    WORLD,
    Action,
    Body,
    Box,
    Circle,
    Groove,
    Motor,
    Observe,
    Pivot,
    Role,
    Scene,
    Status,
    Thruster,
)

FREE: dict[str, Any] = {"gravity": (0.0, 0.0)}


def run(scene: Scene, action: list[float], ticks: int, chunk: int = 8) -> tuple[Any, np.ndarray]:
    """Last record with running sum of ticks, and final states (bodies, 6), of one episode."""
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        done = 0
        for first in range(0, ticks, chunk):
            count = min(chunk, ticks - first)
            record = worlds.step(np.tile(np.array(action, np.float32), (1, count, 1)))
            done += int(record.ticks[0])
        total = dataclasses.replace(record, ticks=np.array([done], np.int32))
        return total, worlds.states[0]


def test_free_fall() -> None:
    # Semi-implicit Euler: positions use the velocity of the previous substep.
    _, states = run(ball(), [0.0], 15)
    steps = 30
    assert states[0, 3] == pytest.approx(-9.81 * steps * SUBSTEP_S, rel=1e-12)
    fall = 9.81 * SUBSTEP_S**2 * steps * (steps - 1) / 2
    assert states[0, 1] == pytest.approx(1.0 - fall, rel=1e-12)


def test_thruster_acceleration() -> None:
    _, states = run(ball(**FREE), [0.5], 10)
    assert states[0, 2] == pytest.approx(0.5 * 2.0 / BALL_MASS_KG * 20 * SUBSTEP_S, rel=1e-12)


def test_thruster_off_centre_turns_with_the_body() -> None:
    disc = Body(name="disc", shapes=(Circle(radius=0.5, density=2.0),), angle=math.pi / 2)
    push = Thruster(body="disc", action="u", max_force=3.0, point=(0.5, 0.0), direction=(0.0, 2.0))
    scene = Scene(
        name="disc",
        bodies=(disc,),
        actions=(Action(name="u"),),
        thrusters=(push,),
        observations=(Observe(kind="angle", body="disc"),),
        action_noise=0.0,
        **FREE,
    )
    mass = 2.0 * math.pi * 0.25
    moment = mass * 0.25 / 2
    _, states = run(scene, [1.0], 1)
    spin = 3.0 * 0.5 / moment * SUBSTEP_S
    assert states[0, 5] == pytest.approx(2 * spin, rel=1e-9)
    # A quarter turn: the local +y force points to world −x.
    assert states[0, 2] == pytest.approx(-2 * 3.0 / mass * SUBSTEP_S, rel=1e-3)


@pytest.mark.parametrize("action", [1.0, -0.5])
def test_motor_reaches_its_rate(action: float) -> None:
    arm = Body(name="arm", shapes=(Box(width=1.0, height=0.1),))
    scene = Scene(
        name="arm",
        bodies=(arm,),
        joints=(Pivot(a=WORLD, b="arm", anchor=(0.0, 0.0)),),
        motors=(Motor(a=WORLD, b="arm", action="u", max_rate=3.0, max_torque=0.05),),
        actions=(Action(name="u"),),
        observations=(Observe(kind="angle", body="arm"),),
        action_noise=0.0,
        **FREE,
    )
    _, early = run(scene, [action], 1)
    moment = 0.1 * (1.0 + 0.01) / 12
    assert abs(early[0, 5]) == pytest.approx(0.05 / moment * 2 * SUBSTEP_S, rel=1e-6)
    _, late = run(scene, [action], 60)
    assert late[0, 5] == pytest.approx(3.0 * action, rel=1e-6)


def test_elastic_bounce() -> None:
    scene = ball(wall(1.0), velocity=(2.0, 0.0), restitution=1.0, **FREE)
    _, states = run(scene, [0.0], 30)
    assert states[0, 2] == pytest.approx(-2.0, rel=1e-6)


def test_cart_stays_on_its_rail() -> None:
    cart = Body(name="cart", rotates=False, shapes=(Box(width=0.4, height=0.2, role=Role.GOAL),))
    scene = Scene(
        name="cart",
        bodies=(cart,),
        joints=(Groove(a=WORLD, b="cart", start=(-1, 0), end=(1, 0), anchor=(0, 0)),),
        thrusters=(
            Thruster(body="cart", action="u", max_force=1.0, point=(0, 0.1), direction=(1, 0)),
        ),
        actions=(Action(name="u"),),
        observations=(Observe(kind="x", body="cart"),),
        action_noise=0.0,
    )
    _, states = run(scene, [1.0], 120)
    assert states[0, 4] == 0.0
    assert abs(states[0, 1]) < 0.01
    assert states[0, 0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("sensor", [False, True])
@pytest.mark.parametrize(
    ("role", "status"), [(Role.TARGET, Status.SOLVED), (Role.HAZARD, Status.FAILED)]
)
def test_contact_ends_the_episode_at_its_tick(role: Role, status: Status, sensor: bool) -> None:
    # The gap of 0.5 m at 3 m/s is closed after 1/6 s: ten substeps, five control steps.
    scene = ball(wall(0.6, role, sensor=sensor), velocity=(3.0, 0.0), **FREE)
    for chunk in (1, 8):
        record, _ = run(scene, [0.0], 16, chunk)
        assert record.status[0] == status
        assert 5 <= record.ticks[0] <= 6
        assert record.obs[0, 0] == pytest.approx(3.0 * record.ticks[0] / 30, abs=0.1)


def test_untouched_roles_and_role_zero_do_not_end_it() -> None:
    scene = ball(wall(0.6, Role.NONE), velocity=(3.0, 0.0), **FREE)
    record, _ = run(scene, [0.0], 16)
    assert record.status[0] == Status.RUNNING


def test_failure_wins_a_tie() -> None:
    both = (wall(0.6, Role.TARGET, "target"), wall(0.6, Role.HAZARD, "hazard"))
    for bodies in (both, both[::-1]):
        record, _ = run(ball(*bodies, velocity=(3.0, 0.0), **FREE), [0.0], 16)
        assert record.status[0] == Status.FAILED


def test_leaving_the_bounds_fails() -> None:
    scene = ball(velocity=(2.9, 0.0), bounds=(-1.0, 0.0, 1.0, 2.0), **FREE)
    record, states = run(scene, [0.0], 24)
    assert record.status[0] == Status.FAILED
    assert record.ticks[0] == 11
    assert states[0, 0] == pytest.approx(2.9 * 11 / 30)


@pytest.mark.parametrize("chunk", [1, 7, 40])
def test_timeout(chunk: int) -> None:
    scene = ball(max_ticks=30, **FREE)
    record, _ = run(scene, [0.0], 40, chunk)
    assert record.status[0] == Status.TIMEOUT
    assert record.ticks[0] == 30


def test_finished_worlds_ignore_actions() -> None:
    scene = ball(wall(0.6, Role.TARGET), velocity=(3.0, 0.0), **FREE)
    with WorldBatch(scene, 2) as worlds:
        worlds.reset([0, 1])
        first = worlds.step(np.zeros((2, 12, 1)))
        second = worlds.step(np.ones((2, 12, 1)))
        np.testing.assert_array_equal(first.obs, second.obs)
        np.testing.assert_array_equal(second.ticks, 0)
        obs = worlds.reset([0], worlds=[1])
        again = worlds.step(np.zeros((2, 2, 1)))
        assert obs[0, 0] == 0.0
        np.testing.assert_array_equal(again.ticks, [0, 2])


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("engine", ["fast", "public"])
def test_a_nan_world_is_marked_counted_and_rebuilt(engine: Any, workers: int) -> None:
    scene = machine()
    zeros = np.zeros((2, 12, 4), np.float32)
    bad = zeros.copy()
    bad[1, 5] = np.nan
    with WorldBatch(scene, 2, workers, engine) as worlds:
        worlds.reset([0, 1])
        record = worlds.step(bad)
        np.testing.assert_array_equal(record.status, [Status.RUNNING, Status.INVALID])
        np.testing.assert_array_equal(record.ticks, [12, 6])
        assert worlds.invalid_count == 1
        assert np.isfinite(record.obs).all()
        worlds.reset([0, 1])
        record = worlds.step(zeros)
        after = worlds.states
    with WorldBatch(scene, 2) as worlds:
        worlds.reset([0, 1])
        worlds.step(zeros)
        np.testing.assert_array_equal(after, worlds.states)


@pytest.mark.parametrize("engine", ["fast", "public"])
def test_nan_after_the_end_of_an_episode_does_not_reach_the_next(engine: Any) -> None:
    scene = machine()
    flying = {"hull", "leg0", "leg1"}
    bodies = [
        dataclasses.replace(body, velocity=(2.0, 0.0)) if body.name in flying else body
        for body in scene.bodies
    ]
    place = scene.body_index["target"]
    bodies[place] = dataclasses.replace(bodies[place], position=(0.325, 1.5), angle=0.0)
    scene = dataclasses.replace(scene, bodies=tuple(bodies), action_noise=0.0, jitters=())
    zeros = np.zeros((1, 8, 4), np.float32)
    bad = zeros.copy()
    bad[0, 5] = np.nan
    with WorldBatch(scene, 1, 1, engine) as worlds:
        ends = []
        for actions in (zeros, bad, zeros):
            worlds.reset([0])
            record = worlds.step(actions)
            ends.append((record.status[0], record.ticks[0], worlds.states))
    assert ends[0][0] == Status.SOLVED
    assert ends[0][1] <= 5
    for status, ticks, states in ends[1:]:
        assert (status, ticks) == ends[0][:2]
        np.testing.assert_array_equal(states, ends[0][2])


def test_actions_are_clipped_after_noise() -> None:
    # Noise of σ = 5 around 0: most sums leave [−1, 1] and must push with the full force.
    scene = ball(action_noise=5.0, **FREE)
    with WorldBatch(scene, 32) as worlds:
        worlds.reset(range(32))
        worlds.step(np.zeros((32, 1, 1)))
        change = np.abs(worlds.states[:, 0, 2]) / (2.0 / BALL_MASS_KG * 2 * SUBSTEP_S)
    assert change.max() == pytest.approx(1.0)
    assert np.mean(change > 0.999) > 0.6


def test_seeds_decide_jitter_and_noise() -> None:
    scene = machine()
    with WorldBatch(scene, 4) as worlds:
        obs = worlds.reset([5, 5, 6, -7])
        record = worlds.step(np.zeros((4, 8, 4)))
    np.testing.assert_array_equal(obs[0], obs[1])
    np.testing.assert_array_equal(record.obs[0], record.obs[1])
    assert not np.array_equal(obs[0], obs[2])
    assert not np.array_equal(obs[2], obs[3])


def test_jitter_keeps_joints_satisfied() -> None:
    scene = machine()
    states = scene.initial_states(np.random.default_rng(0).uniform(-1, 1, (50, 2, 6)))
    hull, leg = (states[:, scene.body_index[name]] for name in ("hull", "leg0"))
    points = []
    for body, local in ((hull, (-0.4, -0.1)), (leg, (0.0, 0.2))):
        c, s = np.cos(body[:, 4]), np.sin(body[:, 4])
        x, y = local
        points.append(body[:, 0:2] + np.stack([c * x - s * y, s * x + c * y], axis=1))
    np.testing.assert_allclose(points[0], points[1], atol=1e-12)


@pytest.mark.parametrize(
    ("call", "part"),
    [
        (lambda w: w.reset([1, 2, 3]), "3 seeds for 2 worlds"),
        (lambda w: w.reset([1], worlds=[2]), "0 to 1"),
        (lambda w: w.reset([1, 2], worlds=[0, 0]), "once"),
        (lambda w: w.step(np.zeros((2, 4, 3))), r"\(2, T, 1\)"),
        (lambda w: w.step(np.zeros((2, 4, 1))), "reset"),
    ],
)
def test_bad_calls_name_value_and_rule(call: Any, part: str) -> None:
    with WorldBatch(ball(), 2) as worlds, pytest.raises(UsageError, match=part):
        call(worlds)
