"""Soft motors: the law by hand, conserved quantities, limits, and both engines alike."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from toy_scenes import machine

from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.local import LocalBatch
from rtc_cli.tasks.motors import SoftDrives
from rtc_cli.tasks.scene import (
    SUBSTEP_S,
    Action,
    Body,
    Circle,
    Observe,
    Pivot,
    Scene,
    TanhMotor,
    Thruster,
    Weighed,
)

SOFT_MACHINE = dataclasses.replace(
    machine(),
    motors=(
        machine().motors[0],
        TanhMotor(a="hull", b="leg1", action="leg1", max_rate=6.0, gain=900.0, limits=(-0.8, 0.8)),
        TanhMotor(a="floor", b="ball", action="leg1", max_rate=-9.0, gain=300.0),
        TanhMotor(a="hull", b="leg0", action="left", max_rate=3.0, gain=2000.0),
    ),
)
ENGINES = ("fast", "public")


def two_discs(**motor: object) -> Scene:
    """Two free discs without gravity, of moments 0.02 and 0.05, and one motor from a to b."""
    discs = tuple(
        Weighed(
            name=name,
            shapes=(Circle(radius=0.1),),
            position=(x, 0.0),
            mass=1.0,
            moment=moment,
        )
        for name, x, moment in (("a", 0.0, 0.02), ("b", 1.0, 0.05))
    )
    settings: dict[str, object] = {"max_rate": 6.0, "gain": 300.0, **motor}
    return Scene(
        name="discs",
        bodies=(*discs, Body(name="rest", static=True, shapes=())),
        actions=(Action(name="drive"),),
        motors=(TanhMotor(**{"a": "a", "b": "b", "action": "drive", **settings}),),  # type: ignore[arg-type]
        observations=(Observe(kind="angle", body="b"),),
        gravity=(0.0, 0.0),
        action_noise=0.0,
    )


def spins(scene: Scene, action: float, ticks: int, engine: str = "fast") -> np.ndarray:
    """Angular velocities (ticks, bodies) under one constant action."""
    batch = LocalBatch(scene, 1, engine)  # type: ignore[arg-type]
    world = np.array([0])
    batch.reset(np.array([0]), world)
    out = []
    for _ in range(ticks):
        batch.step(np.full((1, 1, 1), action, np.float32), world)
        out.append(batch.states[0, :, 5].copy())
    return np.array(out)


@pytest.mark.parametrize("engine", ENGINES)
def test_spin_up_follows_the_law_step_by_step(engine: str) -> None:
    found = spins(two_discs(), 0.5, 30, engine)
    relative, wanted = 0.0, []
    for _ in range(30):
        for _ in range(2):
            # m/I_a + m/I_b = 1: the relative speed changes by gain · dt · tanh.
            relative -= 300.0 * SUBSTEP_S * math.tanh(0.1 * (relative - 3.0))
        wanted.append(relative)
    np.testing.assert_allclose(found[:, 1] - found[:, 0], wanted, rtol=1e-12)
    np.testing.assert_allclose(wanted[-1], 3.0, atol=1e-6)
    # Nothing else turns them: angular momentum stays 0.
    np.testing.assert_allclose(0.02 * found[:, 0] + 0.05 * found[:, 1], 0.0, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_against_what_never_moves_the_whole_change_goes_to_one_body(engine: str) -> None:
    found = spins(two_discs(a="rest"), -1.0, 1, engine)[0]
    one = 300.0 * SUBSTEP_S * math.tanh(-0.6)
    wanted = one - 300.0 * SUBSTEP_S * math.tanh(0.1 * (one + 6.0))
    assert found[0] == 0.0
    assert found[1] == pytest.approx(wanted, rel=1e-12)


def test_no_action_leaves_the_bodies_free() -> None:
    turning = dataclasses.replace(two_discs().bodies[1], angular_velocity=7.0)
    scene = two_discs()
    scene = dataclasses.replace(scene, bodies=(scene.bodies[0], turning, scene.bodies[2]))
    np.testing.assert_array_equal(spins(scene, 0.0, 5)[:, 1], 7.0)


def test_torque_fades_out_towards_the_limit_that_the_command_points_to() -> None:
    drives = SoftDrives.of(two_discs(limits=(-1.0, 2.0), fade=0.1), [0.02, 0.05])
    assert drives is not None

    def share(angle: float, action: float) -> float:
        states = np.zeros((1, 2, 6))
        states[0, 1, 4] = angle
        full = abs(drives.torques(np.zeros((1, 2, 6)), np.array([[action]]))[0, 1])
        return float(abs(drives.torques(states, np.array([[action]]))[0, 1]) / full)

    for angle, action, wanted in (
        (1.9, 1.0, 1.0),
        (1.95, 1.0, 0.5),
        (2.0, 1.0, 0.0),
        (2.2, 1.0, 0.0),
        (1.95, -1.0, 1.0),
        (-0.97, -1.0, 0.3),
        (-0.97, 1.0, 1.0),
    ):
        assert share(angle, action) == pytest.approx(wanted, abs=1e-9), (angle, action)


def test_motors_that_share_an_action_add_their_torques() -> None:
    scene = two_discs()
    twice = dataclasses.replace(scene, motors=scene.motors * 2)
    state, action = np.zeros((3, 2, 6)), np.array([[1.0], [0.2], [-0.4]])
    one, both = (SoftDrives.of(each, [0.02, 0.05]) for each in (scene, twice))
    assert one is not None
    assert both is not None
    np.testing.assert_allclose(both.torques(state, action), 2 * one.torques(state, action))
    # By hand: gain · m · tanh(0.1 · 6), m = 1 / (1/0.02 + 1/0.05).
    wanted = 300.0 * 0.02 * 0.05 / 0.07 * math.tanh(0.6)
    np.testing.assert_allclose(one.torques(state, action)[0], [-wanted, wanted])


def test_a_weighed_body_has_the_mass_and_moment_that_it_declares() -> None:
    lever = Weighed(
        name="lever", shapes=(Circle(radius=0.1, offset=(0.3, 0.0)),), mass=2.0, moment=0.4
    )
    scene = Scene(
        name="lever",
        bodies=(lever,),
        actions=(Action(name="push"),),
        thrusters=(Thruster(body="lever", action="push", max_force=3.0, point=(0.5, 0.0)),),
        observations=(Observe(kind="velocity", body="lever"),),
        gravity=(0.0, 0.0),
        action_noise=0.0,
    )
    with WorldBatch(scene, 1) as worlds:
        for _ in range(2):  # after a reset too
            worlds.reset([0])
            worlds.step(np.ones((1, 1, 1)))
            _, _, _, vy, _, spin = worlds.states[0, 0]
            assert vy == pytest.approx(3.0 / 2.0 / 30, rel=1e-3)
            assert spin == pytest.approx(3.0 * 0.5 / 0.4 / 30, rel=1e-3)


@pytest.mark.parametrize("chunk", [8, 3, 1])
def test_both_engines_give_the_same_bits(chunk: int) -> None:
    seeds = np.arange(12)
    draws = [np.random.default_rng(int(s)).uniform(-1, 1, (40, 4)) for s in seeds]
    actions = np.array(draws, np.float32)
    actions[:, 3] = 0.0
    results = []
    for engine, piece in (("fast", chunk), ("public", 8)):
        with WorldBatch(SOFT_MACHINE, 12, engine=engine) as worlds:  # type: ignore[arg-type]
            worlds.reset(seeds + 1)
            worlds.step(actions[:, :8])
            worlds.reset(seeds)
            for first in range(0, 40, piece):
                record = worlds.step(actions[:, first : first + piece])
            results.append((worlds.states, record.status, record.obs))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(set(results[0][1].tolist())) > 1  # some episodes ended, some did not


def test_batch_size_workers_and_limits_do_not_matter() -> None:
    scene = dataclasses.replace(SOFT_MACHINE, max_speed=1.6, max_spin=5.0, bounds=None)
    seeds = np.arange(11)
    draws = [np.random.default_rng(int(s)).uniform(-1, 1, (24, 4)) for s in seeds]
    actions = np.array(draws, np.float32)
    found = []
    for rows, workers, piece in ((11, 1, 24), (5, 1, 1), (11, 2, 8)):
        with WorldBatch(scene, rows, workers=workers) as worlds:
            worlds.reset(seeds[:rows])
            for first in range(0, 24, piece):
                worlds.step(actions[:rows, first : first + piece])
            found.append(worlds.states)
    np.testing.assert_array_equal(found[0][:5], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    assert np.abs(found[0][:, :, 5]).max() <= 5.0


def test_a_motor_holds_a_hinged_load_up() -> None:
    """A pendulum on a motor told not to turn (action ε) sinks far slower than a free one."""
    rod = Weighed(
        name="rod", shapes=(Circle(radius=0.05),), position=(1.0, 0.0), mass=1.0, moment=0.1
    )
    scene = Scene(
        name="crane",
        bodies=(Body(name="rest", static=True, shapes=()), rod),
        joints=(Pivot(a="rest", b="rod", anchor=(0.0, 0.0)),),
        actions=(Action(name="drive"),),
        motors=(TanhMotor(a="rest", b="rod", action="drive", max_rate=6.0, gain=900.0),),
        observations=(Observe(kind="angle", body="rod"),),
        action_noise=0.0,
    )
    held, free = spins(scene, 1e-6, 15)[-1, 1], spins(scene, 0.0, 15)[-1, 1]
    assert free < -2.0
    assert -0.8 > held > -1.4  # tanh(0.1 ω) · 900 · 0.1 = m · g · 1 m at ω = 1.09 rad/s
