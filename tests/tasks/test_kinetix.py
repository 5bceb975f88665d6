"""Kinetix levels as scenes: a small one of our own, and the originals where they are at hand."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from level_files import ARM_KG, HULL_KG, TIP_KG, hover, write_level

from rtc_cli.errors import UsageError
from rtc_cli.levels import expand, short_name
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix import load_level
from rtc_cli.tasks.render import draw_world
from rtc_cli.tasks.scene import Fixed, Pivot, Role, Scene, Status, TanhMotor, Weighed

FOLDER = os.environ.get("RTC_KINETIX_LEVELS", "")
ORIGINALS = (
    "cartpole_thrust",
    "catcher_v3",
    "grasp_easy",
    "hard_lunar_lander",
    "mjc_walker",
    "trampoline",
)


@pytest.fixture
def level(tmp_path: Path) -> Scene:
    return load_level(write_level(tmp_path, hover()))


@pytest.fixture(params=["hover", *ORIGINALS])
def any_level(request: pytest.FixtureRequest, tmp_path: Path) -> Scene:
    """Our own level, and each original."""
    if request.param == "hover":
        return load_level(write_level(tmp_path, hover()))
    if not FOLDER:
        pytest.skip("RTC_KINETIX_LEVELS does not name a folder with the original level files")
    return get_task(f"kinetix:{FOLDER}/{request.param}.json")


def run(scene: Scene, actions: np.ndarray, engine: str = "auto") -> tuple[np.ndarray, ...]:
    """States, statuses and observations after open-loop actions (n, T, A)."""
    with WorldBatch(scene, len(actions), engine=engine) as worlds:  # type: ignore[arg-type]
        worlds.reset(np.arange(len(actions)))
        for first in range(0, actions.shape[1], 8):
            record = worlds.step(actions[:, first : first + 8])
        assert worlds.invalid_count == 0
        return worlds.states, record.status, record.obs


def extreme(scene: Scene, n: int, ticks: int) -> np.ndarray:
    """Actions at the ends of their ranges, chosen at random."""
    ends = np.random.default_rng(7).random((n, ticks, scene.action_dim)) < 0.5
    return np.where(ends, scene.action_low, scene.action_high).astype(np.float32)


def test_bodies_have_the_files_places_roles_and_masses(level: Scene) -> None:
    bodies = {body.name: body for body in level.bodies}
    assert list(bodies) == ["polygon0", "polygon1", "polygon2", "circle0", "circle1"]
    assert [body.static for body in level.bodies] == [True, False, False, False, True]
    roles = [body.shapes[0].role for body in level.bodies]
    assert roles == [Role.HAZARD, Role.GOAL, Role.NONE, Role.NONE, Role.TARGET]
    assert bodies["polygon1"].position == (2.0, 2.0)
    masses = [b.mass for b in level.bodies if isinstance(b, Weighed)]
    np.testing.assert_allclose(masses, [HULL_KG, ARM_KG, TIP_KG])
    assert bodies["polygon1"].shapes[0].area == pytest.approx(0.4 * 0.2)  # anticlockwise again


def test_joints_motors_and_thrusters_follow_the_laws_of_the_file(level: Scene) -> None:
    hinge, weld = level.joints
    assert isinstance(hinge, Pivot)
    assert isinstance(weld, Fixed)
    assert (hinge.a, hinge.b, hinge.anchor) == ("polygon1", "polygon2", (2.0, 1.9))
    assert hinge.limits == (-1.0, 1.0)
    wanted = TanhMotor(
        a="polygon1", b="polygon2", action="motor2", max_rate=6.0, gain=900.0, limits=(-1.0, 1.0)
    )
    assert level.motors == (wanted,)
    assert [t.max_force for t in level.thrusters] == pytest.approx([1.5, 1.5])
    np.testing.assert_allclose([t.direction for t in level.thrusters], [[0, 1]] * 2, atol=1e-12)


def test_only_bindings_that_do_something_are_actions(level: Scene) -> None:
    names = [(action.name, action.low, action.high) for action in level.actions]
    assert names == [("motor2", -1.0, 1.0), ("thruster0", 0.0, 1.0), ("thruster1", 0.0, 1.0)]


def test_who_touches_whom_follows_joints_and_collision_modes(tmp_path: Path) -> None:
    content = hover()
    content["env_state"]["polygon"][2]["collision_mode"] = 0
    shapes = [body.shapes[0] for body in load_level(write_level(tmp_path, content)).bodies]
    names = ["floor", "hull", "arm", "tip", "target"]
    touching = {
        (names[i], names[k])
        for i, one in enumerate(shapes)
        for k, other in enumerate(shapes[:i])
        if one.category & other.mask and other.category & one.mask
    }
    assert touching == {
        ("hull", "floor"),
        ("arm", "floor"),  # mode 2 meets mode 0
        ("tip", "floor"),
        ("target", "floor"),
        ("target", "hull"),
        ("target", "tip"),
    }


def test_friction_of_a_contact_is_the_originals(level: Scene) -> None:
    one, other = level.bodies[0].shapes[0], level.bodies[1].shapes[0]
    assert one.friction * other.friction == pytest.approx(math.hypot(0.4, 0.4))


def test_limits_count_from_the_joints_rotation(tmp_path: Path) -> None:
    content = hover()
    hinge = content["env_state"]["joint"][0]
    hinge |= {"a_index": 5, "b_index": 2, "rotation": -0.5}
    content["env_state"]["circle"][1] |= {"rotation": 0.5, "position": {"0": 2.0, "1": 2.0}}
    hinge["a_relative_pos"] = {"0": 0.0, "1": 0.0}
    level = load_level(write_level(tmp_path, content))
    # What never moves has angle 0 in the physics, though it is declared at 0.5 rad.
    assert level.joints[0].limits == pytest.approx((-1.0, 1.0))  # type: ignore[union-attr]


def test_open_joints_are_closed_before_the_start(tmp_path: Path) -> None:
    content = hover()
    content["env_state"]["joint"][0]["b_relative_pos"]["1"] = 0.25  # 0.1 m beyond the hull's end
    level = load_level(write_level(tmp_path, content))
    hull, arm = level.bodies[1].position[1], level.bodies[2].position[1]
    assert hull - 0.1 == pytest.approx(arm + 0.25)
    # Shifts share out by mass, so the common centre of gravity stays.
    masses, ys = [HULL_KG, ARM_KG, TIP_KG], [body.position[1] for body in level.bodies[1:4]]
    assert np.dot(masses, ys) == pytest.approx(np.dot(masses, [2.0, 1.75, 1.6]))


def test_thrust_up_solves_it_and_doing_nothing_fails(level: Scene) -> None:
    up = np.tile(np.array([0.0, 1.0, 1.0], np.float32), (4, 64, 1))
    still = np.zeros_like(up)
    assert (run(level, up)[1] == Status.SOLVED).all()
    assert (run(level, still)[1] == Status.FAILED).all()


def test_observations_are_the_state_of_what_moves(level: Scene) -> None:
    with WorldBatch(level, 1) as worlds:
        obs = worlds.reset([3])[0]
    assert level.obs_dim == 3 * 7
    names = [component.name for component in level.components[:7]]
    assert names[0] == "polygon1.position.x"
    np.testing.assert_allclose(obs[:7], [-0.2, -0.2, 0, 0, 1, 0, 0], atol=1e-6)
    assert level.progress(obs[None])[0] == pytest.approx(-1.0)  # hull (2, 2), target (2, 3)


def test_physical_contract(any_level: Scene) -> None:
    scene = any_level
    assert (scene.control_hz, scene.max_ticks) == (30.0, 256)
    actions = extreme(scene, 8, 64)
    states, status, obs = run(scene, actions)
    assert obs.shape == (8, scene.obs_dim)
    assert obs.dtype == np.float32
    assert np.isfinite(obs).all()
    assert np.isfinite(states).all()
    assert np.abs(states[:, :, 2:4]).max() <= scene.max_speed
    again = run(scene, actions)
    public = run(scene, actions, "public")
    for one, other, third in zip((states, status, obs), again, public, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, third)


def test_joints_hold_under_extreme_actions(any_level: Scene) -> None:
    """Where a joint's two ends are apart after two seconds, the level has come to pieces."""
    scene = any_level
    states, _, _ = run(scene, extreme(scene, 4, 60))

    def end(world: int, name: str, anchor: tuple[float, float]) -> np.ndarray:
        body, now = scene.bodies[scene.body_index[name]], states[world, scene.body_index[name]]
        arm = np.array(anchor) - np.array(body.position)
        turn = now[4] - body.angle
        c, s = math.cos(turn), math.sin(turn)
        return now[:2] + np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])

    for joint in scene.joints:
        assert isinstance(joint, Pivot | Fixed)
        for world in range(4):
            gap = end(world, joint.a, joint.anchor) - end(world, joint.b, joint.anchor)
            assert np.hypot(*gap) < 0.1, joint


def test_levels_can_be_drawn_in_their_arena(any_level: Scene) -> None:
    picture = draw_world(any_level, any_level.declared_states, any_level.action_high, width=200)
    assert picture.size == (200, 200)
    assert len(picture.getcolors(1 << 16)) > 10


def test_get_task_takes_paths_and_refuses_folders_of_several(tmp_path: Path) -> None:
    write_level(tmp_path, hover())
    assert get_task(f"kinetix:{tmp_path}").name == "kinetix-hover"
    assert get_task(f"kinetix:{tmp_path}/hover.json").description.startswith(
        'Kinetix level "hover", pymunk port'
    )
    write_level(tmp_path, hover(), "other")
    with pytest.raises(UsageError, match="2 levels: kinetix-hover, kinetix-other"):
        get_task(f"kinetix:{tmp_path}")


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


def test_the_digest_follows_the_content(tmp_path: Path) -> None:
    content = hover()
    first = load_level(write_level(tmp_path, content)).digest
    assert load_level(write_level(tmp_path, content)).digest == first
    content["env_state"]["polygon"][2]["inverse_mass"] *= 1.01
    assert load_level(write_level(tmp_path, content)).digest != first
