"""The contract that every task keeps, whatever trains on it.

What shows that a task can be solved is a small stored policy per task, `solvers/<task>.npz`; see
`make_solver.py`. Everything here is decided by seeds, so a test passes always or never.
"""

import re
from functools import cache

import numpy as np
import pytest
from episodes import Played, Solver, bang_bang, play, replay, still, uniform

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Role, Scene, Status

SEEDS = np.arange(64) + 5_000
MANY_SEEDS = np.arange(256) + 5_000  # where a share is held against a limit
OTHER_SEEDS = np.arange(64) + 6_000
LIMIT = 0.15  # of the episodes, for whoever does not look
REPLAYED = 4  # successful episodes, each repeated under a quarter of the other seeds


@pytest.fixture(params=list_tasks())
def scene(request: pytest.FixtureRequest) -> Scene:
    return get_task(request.param)


@cache
def by_solver(task: str) -> Played:
    scene = get_task(task)
    return play(scene, Solver(scene), SEEDS)


@cache
def by_nobody(task: str) -> Played:
    scene = get_task(task)
    return play(scene, still(scene), MANY_SEEDS)


@cache
def by_chance(task: str) -> Played:
    scene = get_task(task)
    return play(scene, uniform(scene), MANY_SEEDS)


@cache
def by_extremes(task: str) -> Played:
    scene = get_task(task)
    return play(scene, bang_bang(scene), SEEDS)


def test_the_standard_protocol_is_kept(scene):
    assert (scene.control_hz, scene.action_noise) == (30.0, 0.1)
    assert scene.max_ticks <= 256
    roles = {shape.role for body in scene.bodies for shape in body.shapes}
    assert {Role.GOAL, Role.TARGET} <= roles
    assert scene.progress_terms


def test_shapes_and_dtypes(scene):
    with WorldBatch(scene, 3) as worlds:
        obs = worlds.reset([0, 1, 2])
        record = worlds.step(np.zeros((3, 2, scene.action_dim), np.float32))
    assert obs.shape == record.obs.shape == (3, scene.obs_dim)
    assert obs.dtype == record.obs.dtype == np.float32
    assert (record.status.dtype, record.status.shape) == (np.int8, (3,))
    assert scene.action_low.shape == scene.action_high.shape == (scene.action_dim,)
    assert scene.action_low.dtype == scene.action_high.dtype == np.float32
    assert len(scene.components) == scene.obs_dim
    assert scene.progress(obs).shape == (3,)


def table(text: str, title: str) -> list[tuple[str, str, float, float]]:
    """Rows (name, unit, low, high) of the docstring's table whose first heading is `title`."""
    rows = re.search(rf"^\| {title} \|.*\n\|[ -|]*\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert rows, f"the docstring has no table of {title}s"
    out = []
    for line in rows[1].splitlines():
        names, unit, span = (cell.strip() for cell in line.strip("|").split("|"))
        low, high = (float(number) for number in span.replace("−", "-").split(" to "))
        first, *others = names.split(", ")
        stem = first.rpartition(".")[0]
        out += [(name, unit, low, high) for name in (first, *(f"{stem}.{o}" for o in others))]
    return out


def test_the_docstring_lists_every_observation(scene):
    rows = table(scene.description, "observation")
    assert [row[0] for row in rows] == [component.name for component in scene.components]
    for (name, unit, low, high), component in zip(rows, scene.components, strict=True):
        assert unit.split(",")[0] == component.unit, name
        assert (low, high) == pytest.approx((component.low, component.high)), name


def test_the_docstring_lists_every_action(scene):
    rows = table(scene.description, "action")
    found = [(name, low, high) for name, _, low, high in rows]
    assert found == [(action.name, action.low, action.high) for action in scene.actions]


def test_the_docstring_names_the_time_constant(scene):
    assert "\nTime constant: " in scene.description
    assert scene.description.partition("\n")[0].endswith(".")


def check_numbers(scene: Scene, played: Played) -> None:
    """Nothing is NaN or outside the declared range."""
    assert played.invalid == 0
    assert np.isfinite(played.seen).all()
    assert (played.seen >= np.array([c.low for c in scene.components], np.float32)).all()
    assert (played.seen <= np.array([c.high for c in scene.components], np.float32)).all()


def test_observations_stay_finite_and_in_their_declared_range(scene):
    for played in (by_chance(scene.name), by_extremes(scene.name), by_solver(scene.name)):
        check_numbers(scene, played)


def test_absurd_actions_do_no_harm(scene):
    act = uniform(scene, seed=1)
    check_numbers(scene, play(scene, lambda obs: 1e6 * (act(obs) - 0.3), SEEDS[:16]))


def test_velocities_keep_below_their_limits(scene):
    act = bang_bang(scene, seed=1, switch=0.3)
    with WorldBatch(scene, 16) as worlds:
        obs = worlds.reset(SEEDS[:16])
        for _ in range(4):
            chunk = np.stack([act(obs) for _ in range(8)], axis=1)
            worlds.step(chunk.astype(np.float32))
            states = worlds.states
            assert np.hypot(states[..., 2], states[..., 3]).max() <= scene.max_speed + 1e-6
            assert np.abs(states[..., 5]).max() <= scene.max_spin + 1e-6


def test_a_seed_decides_the_episode_whatever_the_batch(scene):
    random = np.random.Generator(np.random.Philox(3))
    actions = random.uniform(scene.action_low, scene.action_high, (6, 24, scene.action_dim))
    ends = []
    for size, rows in ((6, [0, 1, 2, 3, 4, 5]), (6, [0, 1, 2, 3, 4, 5]), (2, [4, 1])):
        with WorldBatch(scene, size) as worlds:
            start = worlds.reset(SEEDS[rows])
            record = worlds.step(actions[rows].astype(np.float32))
            ends.append((start, record.obs, record.status, record.ticks))
    for one, two, few in zip(*ends, strict=True):
        assert np.array_equal(one, two)
        assert np.array_equal(one[[4, 1]], few)
    assert len(np.unique(ends[0][0], axis=0)) == 6


def test_it_can_be_solved(scene):
    played = by_solver(scene.name)
    assert played.solved >= 0.6
    # Long enough for delay to matter, and no longer than evaluations can afford.
    assert 45 <= np.median(played.length[played.status == Status.SOLVED]) <= 150


def test_progress_rises_on_the_way_to_success(scene):
    played = by_solver(scene.name)
    solved = played.status == Status.SOLVED
    gained = scene.progress(played.seen[-1]) - scene.progress(played.seen[0])
    assert np.mean(gained[solved] > 0) > 0.9


def test_failure_is_reachable(scene):
    hazards = [s for body in scene.bodies for s in body.shapes if s.role == Role.HAZARD]
    if not hazards and scene.bounds is None:
        pytest.skip("has neither a hazard nor bounds")
    assert max(by(scene.name).failed for by in (by_nobody, by_chance, by_extremes)) > 0.0


def test_doing_nothing_does_not_solve_it(scene):
    assert by_nobody(scene.name).solved < LIMIT


def test_random_actions_do_not_solve_it(scene):
    assert by_chance(scene.name).solved < LIMIT


def test_repeating_successful_actions_does_not_solve_it(scene):
    played = by_solver(scene.name)
    chosen = np.flatnonzero(played.status == Status.SOLVED)[:REPLAYED]
    actions = np.tile(played.acted[:, chosen], (1, len(OTHER_SEEDS) // REPLAYED, 1))
    # What follows an episode's end in the record is no part of it: its last action is held.
    last = np.tile(played.length[chosen] - 1, len(OTHER_SEEDS) // REPLAYED)
    tick = np.minimum(np.arange(len(actions))[:, None], last)
    held = actions[tick, np.arange(len(OTHER_SEEDS))]
    assert play(scene, replay(held), OTHER_SEEDS).solved < 0.5
