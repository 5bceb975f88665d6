"""Kinetix levels as scenes: a small one of our own, and the paper's where they are at hand."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from golden_levels import PAPER_LEVELS, paper_folder
from level_files import Content, hover, write_level

from rtc_cli.errors import UsageError
from rtc_cli.levels import Observation, expand, short_name
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix import LevelScene, load_level
from rtc_cli.tasks.render import draw_world
from rtc_cli.tasks.scene import Fixed, Motor, Pivot, Role, Status


@pytest.fixture
def level(tmp_path: Path) -> LevelScene:
    return load_level(write_level(tmp_path, hover()))


@pytest.fixture
def symbolic(tmp_path: Path) -> LevelScene:
    return load_level(write_level(tmp_path, hover()), "symbolic")


def crowd() -> Content:
    """Two goal objects, hull and arm, and two targets, of which one moves."""
    content = hover()
    content["env_state"]["polygon"][2]["role"] = 1
    content["env_state"]["circle"][0]["role"] = 2
    return content


OWN = {"hover": hover, "crowd": crowd}


@pytest.fixture(params=[*OWN, *PAPER_LEVELS])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Our own levels, and each of the paper's."""
    if request.param in OWN:
        return write_level(tmp_path, OWN[request.param]())
    return paper_folder() / f"{request.param}.json"


def extreme(scene: LevelScene, n: int, ticks: int) -> np.ndarray:
    """Actions at the ends of their ranges, chosen at random."""
    ends = np.random.default_rng(7).random((n, ticks, scene.action_dim)) < 0.5
    return np.where(ends, scene.action_low, scene.action_high)


def test_bodies_have_the_files_places_roles_and_outlines(level: LevelScene) -> None:
    bodies = {body.name: body for body in level.bodies}
    assert list(bodies) == ["polygon0", "polygon1", "polygon2", "circle0", "circle1"]
    assert [body.static for body in level.bodies] == [True, False, False, False, True]
    roles = [body.shapes[0].role for body in level.bodies]
    assert roles == [Role.HAZARD, Role.GOAL, Role.NONE, Role.NONE, Role.TARGET]
    assert bodies["polygon1"].position == (2.0, 2.0)
    assert bodies["polygon1"].shapes[0].area == pytest.approx(0.4 * 0.2)  # anticlockwise again


def test_joints_motors_and_thrusters_follow_the_laws_of_the_file(level: LevelScene) -> None:
    hinge, weld = level.joints
    assert isinstance(hinge, Pivot)
    assert isinstance(weld, Fixed)
    assert (hinge.a, hinge.b, hinge.anchor) == ("polygon1", "polygon2", (2.0, 1.9))
    motor = Motor(a="polygon1", b="polygon2", action="motor2", max_rate=6.0, max_torque=900.0)
    assert level.motors == (motor,)
    assert [t.max_force for t in level.thrusters] == pytest.approx([1.5, 1.5])
    np.testing.assert_allclose([t.direction for t in level.thrusters], [[0, 1]] * 2, atol=1e-12)


def test_only_bindings_that_do_something_are_actions(level: LevelScene) -> None:
    names = [(action.name, action.low, action.high) for action in level.actions]
    assert names == [("motor2", -1.0, 1.0), ("thruster0", 0.0, 1.0), ("thruster1", 0.0, 1.0)]


def unbound(content: Content) -> None:
    """Two thrusters of one binding, a motor that turns nothing, and one that is off."""
    state = content["env_state"]
    state["thruster"][1]["thruster_binding"] = 0
    state["joint"][0]["motor_on"] = False
    between_walls = {"active": True, "a_index": 0, "b_index": 5, "motor_on": True}
    state["joint"][2] |= between_walls


def test_bindings_that_do_nothing_are_left_out(tmp_path: Path) -> None:
    content = hover()
    unbound(content)
    level = load_level(write_level(tmp_path, content))
    assert [action.name for action in level.actions] == ["thruster0"]


def test_thrust_up_solves_it_and_doing_nothing_fails(level: LevelScene) -> None:
    up = np.tile([0.0, 1.0, 1.0], (4, 64, 1))
    with WorldBatch(level, 4) as worlds:
        for actions, status in ((up, Status.SOLVED), (0.0 * up, Status.FAILED)):
            worlds.reset(range(4))
            assert (worlds.step(actions).status == status).all()


def test_compact_observations_are_the_state_of_what_moves(level: LevelScene) -> None:
    with WorldBatch(level, 1) as worlds:
        obs = worlds.reset([3])[0]
    assert level.obs_dim == 3 * 7
    names = [component.name for component in level.components[:7]]
    assert names[0] == "polygon1.position.x"
    np.testing.assert_allclose(obs[:7], [-0.2, -0.2, 0, 0, 1, 0, 0], atol=1e-6)


def test_symbolic_observations_are_rows_of_all_that_the_lists_hold(symbolic: LevelScene) -> None:
    with WorldBatch(symbolic, 1) as worlds:
        obs = worlds.reset([3])[0]
    # 7 shapes; a joint names two of them, a thruster one.
    assert symbolic.obs_dim == len(obs) == 4 * 26 + 3 * 18 + 3 * (22 + 2 * 7) + 2 * (8 + 7) + 1
    named = {c.name: float(x) for c, x in zip(symbolic.components, obs, strict=True)}
    assert len(named) == symbolic.obs_dim
    for name, value in {
        "polygon1.x": 2.0,
        "polygon1.inverse mass": 10.0,  # 12.5, but nothing is above 10
        "polygon1.vertex 0 x": 0.2,
        "polygon0.role 3": 1.0,
        "circle1.y": 3.0,
        "circle1.radius": 0.2,
        "circle1.circle": 1.0,
        "joint0.a is shape 1": 1.0,
        "joint0.b is shape 2": 1.0,
        "joint0.motor binding 2": 1.0,
        "joint0.lower": -1.0,
        "joint1.fixed": 1.0,
        "joint1.motor power": 0.0,  # of a weld nothing is told
        "thruster1.x": 0.15,
        "thruster1.on shape 1": 1.0,
        "gravity.y / 10": -0.981,
    }.items():
        assert named[name] == pytest.approx(value), name
    unused = ("polygon3.", "circle2.", "joint2.")
    assert not any(value for name, value in named.items() if name.startswith(unused))


@pytest.mark.parametrize("observation", ["compact", "symbolic"])
def test_progress_is_minus_the_distance(path: Path, observation: Observation) -> None:
    scene = load_level(path, observation)
    roles = [body.shapes[0].role for body in scene.bodies]
    goals = [i for i, role in enumerate(roles) if role == Role.GOAL]
    targets = [i for i, role in enumerate(roles) if role == Role.TARGET]
    with WorldBatch(scene, 4) as worlds:
        obs = worlds.reset(range(4))
        for _ in range(3):
            places = worlds.states[:, :, :2]
            ways = [places[:, i] - places[:, k] for i, k in itertools.product(goals, targets)]
            distance = np.linalg.norm(ways, axis=2).sum(axis=0)
            np.testing.assert_allclose(scene.progress(obs), -distance, atol=1e-5)
            obs = worlds.step(extreme(scene, 4, 5)).obs


def test_what_the_symbolic_observation_hides_cannot_be_rewarded(tmp_path: Path) -> None:
    content = hover()
    content["static_env_params"]["num_static_fixated_polys"] = 4  # the hull is one of the walls
    scene = load_level(write_level(tmp_path, content), "symbolic")
    assert not any(c.name.startswith("polygon1.") for c in scene.components)
    with pytest.raises(UsageError, match="polygon1 is not in the symbolic observation"):
        scene.progress(np.zeros((1, scene.obs_dim)))


@pytest.mark.parametrize("observation", ["compact", "symbolic"])
def test_physical_contract(path: Path, observation: Observation) -> None:
    scene = load_level(path, observation)
    assert (scene.control_hz, scene.max_ticks, scene.action_noise) == (30.0, 256, 0.1)
    assert scene.action_low.shape == (scene.action_dim,)
    assert len(scene.components) == scene.obs_dim
    with WorldBatch(scene, 8) as worlds:
        first = worlds.reset(range(8))
        record = worlds.step(extreme(scene, 8, 64))
        assert worlds.invalid_count == 0
        assert np.isfinite(worlds.states).all()
    low, high = np.array([(c.low, c.high) for c in scene.components]).T
    for obs in (first, record.obs):
        assert obs.shape == (8, scene.obs_dim)
        assert obs.dtype == np.float32
        assert (low <= obs).all()
        assert (obs <= high).all()


def test_levels_can_be_drawn_in_their_arena(path: Path) -> None:
    scene = load_level(path)
    picture = draw_world(scene, scene.declared_states, scene.action_high, width=200)
    assert picture.size == (200, 200)
    assert len(picture.getcolors(1 << 16)) > 10


def test_get_task_takes_paths_and_refuses_folders_of_several(tmp_path: Path) -> None:
    write_level(tmp_path, hover())
    assert get_task(f"kinetix:{tmp_path}").name == "kinetix-hover"
    scene = get_task(f"kinetix:{tmp_path}/hover.json")
    assert scene.goal == 'Kinetix level "hover": bring polygon1 to circle1.'
    write_level(tmp_path, hover(), "other")
    with pytest.raises(UsageError, match="2 levels: kinetix-hover, kinetix-other"):
        get_task(f"kinetix:{tmp_path}")


def test_the_name_says_how_a_level_is_observed(tmp_path: Path) -> None:
    write_level(tmp_path, hover())
    name = f"kinetix:{tmp_path}/hover.json"
    both = (name, f"{name}@symbolic")
    compact, symbolic = map(get_task, both)
    assert get_task(f"{name}@compact") == compact
    assert (compact.name, symbolic.name) == ("kinetix-hover", "kinetix-hover-symbolic")
    assert compact.obs_dim != symbolic.obs_dim
    assert compact.digest != symbolic.digest
    assert expand([f"kinetix:{tmp_path}@symbolic"]) == both[1:]
    assert expand(both) == both  # a run may have a level under both names
    with pytest.raises(UsageError, match=r'observation.*Did you mean "symbolic"'):
        get_task(f"{name}@symbolc")


@pytest.mark.parametrize("place", ["me@home/hover.json", "hover@symbolic.json", "Hover.JSON"])
def test_paths_may_hold_what_names_are_made_of(place: str, tmp_path: Path) -> None:
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    path.write_text(write_level(tmp_path, hover()).read_text())
    for end, observation in (("", "compact"), ("@symbolic", "symbolic")):
        scene = get_task(f"kinetix:{path}{end}")
        assert isinstance(scene, LevelScene)
        assert (scene.observation, scene.level.path) == (observation, path)


def test_names_are_absolute_expanded_and_unique(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, name in (("a", "one"), ("a", "two words & more"), ("b", "one")):
        (tmp_path / folder).mkdir(exist_ok=True)
        write_level(tmp_path / folder, hover(), name)
    monkeypatch.chdir(tmp_path)
    found = expand(["catcher", "kinetix:a"])
    assert found == (
        "catcher",
        f"kinetix:{tmp_path}/a/one.json",
        f"kinetix:{tmp_path}/a/two words & more.json",
    )
    shown = [short_name(task) for task in found]
    assert shown == ["catcher", "kinetix-one", "kinetix-two_words_more"]
    assert get_task(found[2]).name == shown[2]
    with pytest.raises(UsageError, match="would both be called kinetix-one"):
        expand(["kinetix:a", "kinetix:b/one.json"])


def heavier(content: Content) -> None:
    content["env_state"]["polygon"][2]["inverse_mass"] *= 0.99


def smoother(content: Content) -> None:
    content["env_params"]["base_friction"] = 0.3


def longer_lists(content: Content) -> None:
    content["env_state"]["circle"].append(content["env_state"]["circle"][2])
    content["static_env_params"]["num_circles"] += 1


def without_effect(content: Content) -> None:
    content["env_state"]["gravity"]["1"] = -1.2
    content["env_params"]["max_timesteps"] = 100
    content["env_state"]["joint"][0]["global_position"] = {"0": 1.0, "1": 1.0}


@pytest.mark.parametrize(
    ("change", "matters"),
    [(heavier, True), (smoother, True), (longer_lists, True), (without_effect, False)],
)
def test_the_digest_follows_what_an_episode_depends_on(
    change: Callable[[Content], Any], matters: bool, tmp_path: Path
) -> None:
    content = hover()
    first = load_level(write_level(tmp_path, content))
    change(content)
    (tmp_path / "moved").mkdir()
    second = load_level(write_level(tmp_path / "moved", content))
    assert (first.digest != second.digest) == matters
