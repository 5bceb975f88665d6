"""Worlds of a Kinetix level: independent of how they are computed, and ended by both rules."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from golden_levels import paper_folder
from level_files import Content, hover, write_level

from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix import load_level
from rtc_cli.tasks.kinetix.packing import pack
from rtc_cli.tasks.scene import Scene, Status

TICKS, SEEDS = 48, np.arange(64)


class Ended(NamedTuple):
    """Where worlds are after TICKS control steps, or at their ends."""

    states: np.ndarray
    status: np.ndarray
    obs: np.ndarray
    solved_last: np.ndarray
    ticks: np.ndarray


def rubble() -> Content:
    """A hull too heavy to fly, on a floor that harms nobody: it lies and slides on it."""
    content = hover()
    content["env_state"]["polygon"][0]["role"] = 0
    for thruster in content["env_state"]["thruster"]:
        thruster["power"] = 0.04
    return content


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_level(write_level(tmp_path, rubble()))


@pytest.fixture
def quiet(scene: Scene) -> Scene:
    return dataclasses.replace(scene, action_noise=0.0)


@pytest.fixture(params=["rubble", "grasp_easy", "car_launch"])
def any_scene(request: pytest.FixtureRequest, scene: Scene) -> Scene:
    """Our own level, and two originals: with the most joints, and with the most contacts."""
    if request.param == "rubble":
        return scene
    return get_task(f"kinetix:{paper_folder()}/{request.param}.json")


def actions_of(scene: Scene, seeds: np.ndarray, ticks: int = TICKS) -> np.ndarray:
    """Actions (n, T, A) at the ends of their ranges that belong to the seeds, wherever run."""
    size = (ticks, scene.action_dim)
    ends = np.array([np.random.default_rng(int(seed)).random(size) < 0.5 for seed in seeds])
    return np.where(ends, scene.action_low, scene.action_high)


def rollout(scene: Scene, seeds: np.ndarray, chunk: int = 8, workers: int = 1) -> Ended:
    actions, ticks = actions_of(scene, seeds), np.zeros(len(seeds), int)
    with WorldBatch(scene, len(seeds), workers=workers) as worlds:
        worlds.reset(seeds)
        for first in range(0, TICKS, chunk):
            record = worlds.step(actions[:, first : first + chunk])
            ticks += record.ticks
        return Ended(worlds.states, record.status, record.obs, record.solved_last, ticks)


def same(one: Ended, other: Ended) -> None:
    for left, right in zip(one, other, strict=True):
        np.testing.assert_array_equal(left, right)


def test_neither_size_of_batch_nor_chunks_nor_workers_matter(any_scene: Scene) -> None:
    whole = rollout(any_scene, SEEDS)
    assert np.isfinite(whole.states).all()
    assert len(np.unique(whole.states[:, any_scene.moving[0], 0])) > 32  # all go their own ways
    for n in (1, 7):
        same(Ended(*(part[:n] for part in whole)), rollout(any_scene, SEEDS[:n]))
    for chunk in (1, 3):
        same(whole, rollout(any_scene, SEEDS, chunk))
    same(whole, rollout(any_scene, SEEDS, workers=2))


@pytest.mark.slow
def test_four_workers_do_not_matter_either(any_scene: Scene) -> None:
    same(rollout(any_scene, SEEDS), rollout(any_scene, SEEDS, chunk=3, workers=4))


def test_used_worlds_in_any_order_are_as_good_as_new_ones(scene: Scene) -> None:
    new = rollout(scene, SEEDS[:8])
    order = np.array([3, 0, 5, 1, 7, 2, 6, 4])
    with WorldBatch(scene, 8) as worlds:
        for seeds in (SEEDS[8:16], SEEDS[:8]):
            worlds.reset(seeds[order], worlds=order)
            for part in (order[:3], order[3:]):
                worlds.step(actions_of(scene, seeds[part]), worlds=part)
        np.testing.assert_array_equal(worlds.states, new.states)


def test_a_prediction_is_what_a_world_without_noise_shows(any_scene: Scene) -> None:
    quiet = dataclasses.replace(any_scene, action_noise=0.0)
    actions = actions_of(quiet, SEEDS[:6])
    with WorldBatch(quiet, 6) as worlds:
        worlds.reset(SEEDS[:6])
        for first, last in ((0, 3), (3, 24), (24, TICKS)):
            worlds.predict(actions[::-1, :TICKS])  # leaves nothing behind
            predicted = worlds.predict(actions[:, first:last])
            np.testing.assert_array_equal(predicted, worlds.step(actions[:, first:last]).obs)


def test_a_prediction_knows_no_noise_and_leaves_worlds_alone(scene: Scene, quiet: Scene) -> None:
    seeds = SEEDS[:6]
    actions, wanted = actions_of(scene, seeds), rollout(scene, seeds)
    with WorldBatch(scene, 6) as noisy, WorldBatch(quiet, 6) as worlds:
        worlds.reset(seeds)
        noisy.reset(seeds)
        shown = worlds.step(actions[:, :16]).obs
        np.testing.assert_array_equal(noisy.predict(actions[:, :16]), shown)
        for first in range(0, TICKS, 8):
            noisy.predict(actions[::-1, :20])
            noisy.step(actions[:, first : first + 8])
        np.testing.assert_array_equal(noisy.states, wanted.states)
        # Of half of the worlds only, in another order.
        part = np.array([4, 0, 2])
        ahead = worlds.predict(actions[part, 16:32], worlds=part)
        np.testing.assert_array_equal(ahead, worlds.step(actions[:, 16:32]).obs[part])


def test_a_push_changes_velocities_of_the_worlds_asked_only(scene: Scene, quiet: Scene) -> None:
    actions = actions_of(quiet, SEEDS[:5])
    pushed, bodies = np.array([3, 1]), len(scene.bodies)
    change = np.zeros((2, bodies, 3))
    change[:, 1:3] = [[1.0, 0.5, -2.0], [0.0, -0.25, 4.0]]
    change[:, 0] = 7.0  # the floor, which does not move
    with WorldBatch(quiet, 5) as worlds, WorldBatch(quiet, 5) as others:
        for batch in (worlds, others):
            batch.reset(SEEDS[:5])
            batch.step(actions[:, :16])
        before = worlds.states
        worlds.push(change, worlds=pushed)
        gained = worlds.states - before
        np.testing.assert_allclose(gained[pushed][:, 1:3][..., [2, 3, 5]], change[:, 1:3])
        gained[np.ix_(pushed, [1, 2], [2, 3, 5])] = 0.0
        assert not gained.any()

        ahead = worlds.predict(actions[:, 16:40])
        obs, unpushed = (batch.step(actions[:, 16:40]).obs for batch in (worlds, others))
        np.testing.assert_array_equal(ahead, obs)
        assert (obs == unpushed).all(axis=1).tolist() == [True, False, True, False, True]


def test_a_world_that_became_nan_hurts_nobody_and_starts_anew(scene: Scene) -> None:
    actions, wanted = actions_of(scene, SEEDS[:3]), rollout(scene, SEEDS[:3])
    with WorldBatch(scene, 3) as worlds:
        worlds.reset(SEEDS[:3])
        worlds.push(np.full((1, len(scene.bodies), 3), np.nan), worlds=[1])
        record = worlds.step(actions)
        assert record.status[1] == Status.INVALID
        assert worlds.invalid_count == 1
        assert np.isfinite(record.obs).all()
        assert np.isfinite(worlds.predict(actions)).all()
        np.testing.assert_array_equal(worlds.states[[0, 2]], wanted.states[[0, 2]])
        worlds.reset(SEEDS[1:2], worlds=[1])
        worlds.step(actions[1:2], worlds=[1])
        np.testing.assert_array_equal(worlds.states, wanted.states)


# Ends. A probe without mass goes 1 m per substep through what it meets.

SOLVED, FAILED = Status.SOLVED, Status.FAILED


def flight(target: int | None, hazard: int | None) -> Content:
    """A probe that meets a target and a hazard in a substep each (from 1), or never (None)."""
    content = hover()
    polygons, circles = content["env_state"]["polygon"], content["env_state"]["circle"]
    polygons[0]["role"] = polygons[1]["role"] = 0
    polygons[3] |= {"active": True, "role": 3, "n_vertices": 4, "position": along(hazard)}
    polygons[3]["vertices"] = {
        str(i): {"0": x, "1": y}
        for i, (x, y) in enumerate([(0.1, 0.1), (0.1, -0.1), (-0.1, -0.1), (-0.1, 0.1)])
    }
    circles[1] |= {"position": along(target)}
    circles[2] |= {"active": True, "role": 1, "radius": 0.05}
    circles[2] |= {"position": along(1), "velocity": {"0": 60.0, "1": 0.0}}
    return content


def along(substep: int | None) -> Content:
    """Where the probe is in a substep; for None far away from its way."""
    return {"0": -5.0, "1": -5.0} if substep is None else {"0": -3.0 + substep, "1": 4.0}


@pytest.mark.parametrize(
    ("target", "hazard", "status", "solved_last"),
    [
        (3, None, SOLVED, False),  # (+1, 0): solved in kinetix-env 3.0.2, not in the paper's commit
        (4, None, SOLVED, True),  # (0, +1)
        (None, 3, FAILED, False),  # (−1, 0)
        (None, 4, FAILED, False),  # (0, −1)
        (3, 4, SOLVED, False),  # (+1, −1): the first that is not 0 decides
        (4, 3, FAILED, True),  # (−1, +1): the other way round
        (3, 3, FAILED, False),  # in one substep the hazard wins
        (4, 4, FAILED, False),
    ],
)
@pytest.mark.parametrize("chunk", [1, 8])
def test_the_first_substep_decides_and_by_another_rule_the_last(
    target: int, hazard: int, status: Status, solved_last: bool, chunk: int, tmp_path: Path
) -> None:
    scene = load_level(write_level(tmp_path, flight(target, hazard)))
    with WorldBatch(scene, 2, workers=1) as worlds:
        worlds.reset([0, 1])
        ticks = 0
        for first in range(0, 8, chunk):
            actions = actions_of(scene, SEEDS[:2], 8)[:, first : first + chunk]
            record = worlds.step(actions)
            ticks += record.ticks
    assert (record.status == status).all()
    assert (record.solved_last == solved_last).all()
    assert (ticks == 2).all()


def test_an_episode_without_end_times_out_unsolved(tmp_path: Path) -> None:
    scene = load_level(write_level(tmp_path, flight(None, None)))
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        record = worlds.step(np.zeros((1, 300, scene.action_dim)))
        np.testing.assert_array_equal(worlds.states[0, -1, :2], [15.0, 4.0])  # clip_position
    assert (record.status, record.ticks) == (Status.TIMEOUT, 256)
    assert not record.solved_last


# Sizes of lists. They decide how contacts are shared out to batches, and nothing else.


def sized(size: str) -> Content:
    """`hover` in the lists of a size of Kinetix' own: four surroundings, then free polygons.

    In the small size there is room for the hull, the target and one thruster only.
    """
    content = hover()
    state, static = content["env_state"], content["static_env_params"]
    floor, hull, arm, unused = state["polygon"]
    numbers = {"s": (5, 2, 1, 1), "m": (6, 3, 2, 2), "l": (12, 4, 6, 2)}[size]
    polygons, circles, joints, thrusters = numbers
    around = [floor, unused, unused, unused, hull]
    if size == "s":
        state["polygon"], state["circle"] = around, state["circle"][1:]
        state["joint"] = state["joint"][2:]
        state["thruster"] = [state["thruster"][0] | {"object_index": 4, "power": 0.3}]
        state["thruster"][0]["relative_position"]["0"] = 0.0
    else:
        spare = polygons - len(around) - 1
        state["polygon"] = [*around, arm, *[unused] * spare]
        state["circle"] += [state["circle"][2]] * (circles - 3)
        hinge, weld, free = state["joint"]
        hinge |= {"a_index": 4, "b_index": 5}
        weld |= {"a_index": 5, "b_index": polygons}
        state["joint"] = [hinge, weld] + [free] * (joints - 2)
        for thruster in state["thruster"]:
            thruster["object_index"] = 4
    static |= {"num_polygons": polygons, "num_circles": circles, "num_static_fixated_polys": 4}
    static |= {"num_joints": joints, "num_thrusters": thrusters}
    return content


@pytest.mark.parametrize(
    ("size", "pairs"), [("s", (4, 10, 1)), ("m", (9, 18, 3)), ("l", (60, 48, 6))]
)
def test_thrust_solves_levels_of_every_size(
    size: str, pairs: tuple[int, ...], tmp_path: Path
) -> None:
    scene = load_level(write_level(tmp_path, sized(size)))
    assert tuple(pack(scene.level).pairs.capacity) == pairs  # of polygons, mixed, of circles
    scene = dataclasses.replace(scene, action_noise=0.0)
    actions = np.zeros((2, 64, scene.action_dim))
    actions[0, :, -scene.level.capacity.thrusters :] = 1.0
    with WorldBatch(scene, 2) as worlds:
        worlds.reset([0, 1])
        record = worlds.step(actions)
        assert np.isfinite(worlds.states).all()
    assert record.status.tolist() == [Status.SOLVED, Status.FAILED]


def test_the_size_of_the_lists_matters_where_contacts_share_batches(tmp_path: Path) -> None:
    ends = []
    for size in ("m", "l"):
        content = sized(size)
        content["env_state"]["polygon"][0]["role"] = 0
        content["env_state"]["polygon"][4]["position"]["1"] = 2.1
        content["env_state"]["joint"][0]["active"] = False  # the hull falls on the arm
        scene = load_level(write_level(tmp_path, content))
        with WorldBatch(dataclasses.replace(scene, action_noise=0.0), 1) as worlds:
            worlds.reset([0])
            for ticks in (8, 24):  # in flight, then one on the other on the floor
                worlds.step(np.zeros((1, ticks, scene.action_dim)))
                ends.append(worlds.states)
    in_flight_m, fallen_m, in_flight_l, fallen_l = ends
    np.testing.assert_array_equal(in_flight_m, in_flight_l)
    assert not np.array_equal(fallen_m, fallen_l)
