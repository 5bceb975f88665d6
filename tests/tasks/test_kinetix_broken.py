"""Broken and unsupported level files: one line that names the file, the field and the rule."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from level_files import Content, hover, write_level

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix import compiling, load_level

Change = Callable[[Content], Any]


def put(path: str, value: Any) -> Change:
    """A change that sets one value; a path is as the messages print it, without "env_state."."""

    def change(level: Content) -> None:
        *way, last = path.split(".") if "params" in path else ["env_state", *path.split(".")]
        place: Any = level
        for step in way:
            name, _, index = step.rstrip("]").partition("[")
            place = place[name][int(index)] if index else place[name]
        if value is KeyError:
            del place[last]
        else:
            place[last] = value

    return change


def bow_tie(level: Content) -> None:
    vertices = level["env_state"]["polygon"][1]["vertices"]
    vertices["0"], vertices["1"] = vertices["1"], vertices["0"]


def many_shapes(level: Content) -> None:
    level["env_state"]["polygon"] *= 2500
    level["static_env_params"]["num_polygons"] = 10_000


def anticlockwise(level: Content) -> None:
    vertices = level["env_state"]["polygon"][1]["vertices"]
    vertices["0"], vertices["2"] = vertices["2"], vertices["0"]


def dented(level: Content) -> None:
    level["env_state"]["polygon"][1]["vertices"]["1"] = {"0": -0.19, "1": 0.0}


def passing_by(level: Content) -> None:
    for shape in (level["env_state"]["polygon"][1], level["env_state"]["circle"][1]):
        shape["collision_mode"] = 0


def hold_hull(level: Content) -> None:
    level["env_state"]["polygon"][1] |= {"inverse_mass": 0.0, "inverse_inertia": 0.0}


def without_drives(level: Content) -> None:
    level["env_state"]["joint"][0]["motor_on"] = False
    for thruster in level["env_state"]["thruster"]:
        thruster["active"] = False


BROKEN: dict[str, tuple[Change, str]] = {
    "no env_state": (lambda level: level.pop("env_state"), '"env_state" is missing'),
    "missing key": (put("polygon[1].friction", KeyError), r'"friction" is missing in .*polygon\[1'),
    "missing constants": (put("env_params.dt", KeyError), '"dt" is missing in env_params'),
    "missing sizes": (
        put("static_env_params.solver_batch_size", KeyError),
        '"solver_batch_size" is missing in static_env_params',
    ),
    "unknown key": (
        lambda level: level.update(env_prams={}),
        'unknown key "env_prams"..*mean "env_params"',
    ),
    "unknown list": (put("joints", []), 'unknown key "joints" in env_state.*mean "joint"'),
    "unknown constant": (
        put("env_params.base_fricton", 0.4),
        'unknown key "base_fricton" in env_params.*mean "base_friction"',
    ),
    "unknown size": (
        put("static_env_params.num_polygon", 4),
        'unknown key "num_polygon" in static_env_params.*mean "num_polygons"',
    ),
    "unknown key of a shape": (
        put("circle[0].frictoin", 1.0),
        r'unknown key "frictoin" in env_state.circle\[0\].*mean "friction"',
    ),
    "unknown key of an inactive shape": (
        put("polygon[3].mass", 1.0),
        r'unknown key "mass" in env_state.polygon\[3\]',
    ),
    "unknown key of a joint": (
        put("joint[0].motor_pwoer", 1.0),
        r'unknown key "motor_pwoer" in env_state.joint\[0\].*mean "motor_power"',
    ),
    "unknown key of a thruster": (
        put("thruster[0].powr", 1.0),
        r'unknown key "powr" in env_state.thruster\[0\].*mean "power"',
    ),
    "text for a number": (put("polygon[1].friction", "x"), r'polygon\[1\].friction is "x"; a num'),
    "flag for a number": (put("circle[0].radius", True), r"circle\[0\].radius is true; a number"),
    "number for a flag": (put("joint[0].motor_on", 1), r"joint\[0\].motor_on is 1; true or false"),
    "list for an object": (put("polygon[1].position", 3), r"polygon\[1\].position is 3; a list"),
    "text for a list": (put("joint", "none"), 'env_state.joint is "none"; a list'),
    "a shape is a number": (put("circle", [1, 2, 3]), r"circle\[0\] is 1; an object"),
    "NaN": (put("polygon[1].rotation", float("nan")), r"polygon\[1\].rotation is NaN"),
    "infinity": (put("polygon[1].position.1", float("-inf")), r"position\[1\] is -Infinity"),
    "a constant is NaN": (put("env_params.slop", float("nan")), "env_params.slop is NaN; 0 to 10"),
    "huge number": (put("polygon[1].velocity.0", 1e300), r"velocity\[0\] is 1e\+300; -100 to 100"),
    "huge whole number": (
        put("polygon[1].angular_velocity", 10**400),
        r"angular_velocity is 1000.*\.\.\.; -100 to 100",
    ),
    "pair of three": (put("polygon[1].position", [0, 1, 2]), "position has 3 entries; 2"),
    "joint to an inactive shape": (put("joint[0].b_index", 3), r"joint\[0\].b_index is 3; the num"),
    "joint to no shape": (put("joint[0].a_index", -1), r"joint\[0\].a_index is -1"),
    "joint to itself": (put("joint[0].b_index", 1), r"joint\[0\].b_index is 1; .*two different"),
    "limits the wrong way": (put("joint[0].max_rotation", -2.0), r"joint\[0\].max_rotation is -2"),
    "thruster on an inactive shape": (put("thruster[0].object_index", 6), "object_index is 6"),
    "negative mass": (put("polygon[1].inverse_mass", -1.0), r"polygon\[1\].inverse_mass is -1"),
    "almost no mass": (put("polygon[1].inverse_mass", 1e12), "inverse_mass is 1000000000000"),
    "negative radius": (put("circle[1].radius", -0.2), r"circle\[1\].radius is -0.2"),
    "two corners": (put("polygon[1].n_vertices", 2), r"polygon\[1\].n_vertices is 2; 3 to 4"),
    "five corners": (put("polygon[1].n_vertices", 5), r"polygon\[1\].n_vertices is 5; 3 to 4"),
    "more corners than listed": (
        put("polygon[1].vertices.3", KeyError),
        r"polygon\[1\].vertices has 3 entries; 4 can",
    ),
    "half a corner": (put("polygon[1].n_vertices", 3.5), "n_vertices is 3.5; a whole number"),
    "not convex": (dented, r"polygon\[1\].vertices .* convex"),
    "crossing edges": (bow_tie, r"polygon\[1\].vertices .* convex"),
    "anticlockwise": (anticlockwise, r"polygon\[1\].vertices .*anticlockwise"),
    "goal and target pass each other": (passing_by, "collision_mode: no shape of role 1 touches"),
    "unknown role": (put("polygon[1].role", 4), r"polygon\[1\].role is 4; 0 to 3"),
    "unknown collision mode": (put("polygon[1].collision_mode", 3), "collision_mode is 3; 0 to 2"),
    "motor binding out of range": (put("joint[0].motor_binding", 4), "motor_binding is 4; 0 to 3"),
    "thruster binding out of range": (put("thruster[0].thruster_binding", 2), "binding is 2; 0 to"),
    "negative power": (put("thruster[0].power", -0.1), r"thruster\[0\].power is -0.1"),
    "restitution above 1": (put("circle[0].restitution", 1.5), "restitution is 1.5; 0 to 1"),
    "no goal object": (put("polygon[1].role", 0), r"no active shape has role 1 \(goal\)"),
    "no target": (put("circle[1].role", 0), r"no active shape has role 2 \(target\)"),
    "more shapes than the arrays hold": (
        put("static_env_params.num_circles", 2),
        "num_circles is 2; env_state.circle has 3 entries",
    ),
    "fewer joints than the arrays hold": (
        put("static_env_params.num_joints", 6),
        "num_joints is 6; env_state.joint has 3 entries",
    ),
    "more surroundings than polygons": (
        put("static_env_params.num_static_fixated_polys", 5),
        "num_static_fixated_polys is 5; 0 to 4",
    ),
    "10,000 shapes": (many_shapes, "env_state.polygon has 10000 entries; 0 to 128"),
    "polygons of more corners": (
        put("static_env_params.max_polygon_vertices", 6),
        "max_polygon_vertices is 6; only 4",
    ),
    "other motor bindings": (
        put("static_env_params.num_motor_bindings", 5),
        "num_motor_bindings is 5; only 4",
    ),
    "other thruster bindings": (
        put("static_env_params.num_thruster_bindings", 1),
        "num_thruster_bindings is 1; only 2",
    ),
    "no iterations": (
        put("static_env_params.num_solver_iterations", 0),
        "num_solver_iterations is 0; 1 to 1000",
    ),
    "another time step": (put("env_params.dt", 0.01), "env_params.dt is 0.01; only 1/60"),
    "another frame skip": (put("static_env_params.frame_skip", 4), "frame_skip is 4; only 2"),
    "nothing to move": (hold_hull, "no shape of role 1 or 2 can move"),
    "nothing to steer": (without_drives, "no active motor or thruster"),
}


def refusal(act: Callable[[], Any]) -> str:
    """The message of a UsageError, checked to be one line."""
    with pytest.raises(UsageError) as caught:
        act()
    assert caught.value.hint
    assert "\n" not in caught.value.message
    assert len(caught.value.message) < 800  # an unknown key is answered with all that are known
    return caught.value.message


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_level_is_refused_by_file_and_field(kind: str, tmp_path: Path) -> None:
    change, wanted = BROKEN[kind]
    content = hover()
    change(content)
    path = write_level(tmp_path, content)
    message = refusal(lambda: load_level(path))
    assert message.startswith(str(path))
    assert re.search(wanted, message), message


def goal_on_target(level: Content) -> None:
    level["env_state"]["joint"][1] |= {"a_index": 5, "b_index": 1, "is_fixed_joint": False}


def two_hinges_on_one_point(level: Content) -> None:
    """The hull hangs by one point on two places of the floor, 0.8 m apart."""
    hinge = level["env_state"]["joint"][1] | {"a_index": 0, "b_index": 1, "is_fixed_joint": False}
    at = {"b_relative_pos": {"0": 0.0, "1": 0.0}}
    level["env_state"]["joint"] = [
        hinge | at | {"a_relative_pos": {"0": x, "1": 1.8}} for x in (-0.4, 0.4)
    ] + level["env_state"]["joint"][2:]


ALLOWED: dict[str, Change] = {
    "joint with ends apart": put("joint[0].b_relative_pos.1", 0.5),
    "twisted weld": put("joint[1].rotation", 1.5),
    "joints that contradict each other": two_hinges_on_one_point,
    "goal jointed to the target": goal_on_target,
    "a wall that moves": put("polygon[0].velocity.0", 1.0),
    "a wall that turns": put("polygon[0].angular_velocity", 1.0),
    "a wheel on the wall": put("polygon[0].inverse_inertia", 5.0),
    "density 0": put("polygon[1].density", 0),
    "another gravity, which is not read": put("gravity", "none"),
    "long episodes, which are not read": put("env_params.max_timesteps", 1000),
    "a highlighted shape": put("polygon[1].highlighted", True),
}


@pytest.mark.parametrize("kind", ALLOWED)
def test_what_the_simulator_can_do_is_played(kind: str, tmp_path: Path) -> None:
    content = hover()
    ALLOWED[kind](content)
    scene = load_level(write_level(tmp_path, content))
    with WorldBatch(scene, 4) as worlds:
        worlds.reset(range(4))
        record = worlds.step(np.ones((4, 60, scene.action_dim)))
        assert worlds.invalid_count == 0
        assert np.isfinite(worlds.states).all()
        assert not (worlds.states == scene.declared_states).all()
    assert np.isfinite(record.obs).all()


def test_levels_say_what_to_install_where_numba_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_level(write_level(tmp_path, hover()))  # reading needs no numba
    found = importlib.util.find_spec
    monkeypatch.setattr(
        compiling.importlib.util, "find_spec", lambda name: None if name == "numba" else found(name)
    )
    compiling.load_physics.cache_clear()
    try:
        for act in (scene.prepare, lambda: WorldBatch(scene, 1)):
            with pytest.raises(UsageError, match="need numba, which is not installed") as caught:
                act()
            assert 'pip install "rtc-cli[kinetix]"' in caught.value.hint
    finally:
        compiling.load_physics.cache_clear()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", "is empty"),
        (json.dumps(hover())[:500], "broken JSON at line 1, column"),
        ("[" * 100_000, "broken JSON"),
        ("[1, 2]", r"the document is [1, 2]; an object"),
        ("null", "the document is null; an object"),
        ("hover", "broken JSON at line 1, column 1"),
    ],
)
def test_a_file_that_is_no_level_is_refused(text: str, wanted: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text, encoding="utf-8")
    message = refusal(lambda: load_level(path))
    assert str(path) in message
    assert wanted in message


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bytes.json"
    path.write_bytes(b"{\xff\xfe")
    assert "not UTF-8" in refusal(lambda: load_level(path))


def test_places_without_a_level_are_refused(tmp_path: Path) -> None:
    (tmp_path / "readme.txt").write_text("no level", encoding="utf-8")
    for name, wanted in {
        f"kinetix:{tmp_path}": "holds no level files",
        f"kinetix:{tmp_path / 'none.json'}": "No such file",
        f"kinetix:{tmp_path / 'readme.txt'}": "broken JSON",
        "kinetix:": "names no level",
    }.items():
        message = refusal(lambda name=name: get_task(name))
        assert wanted in message
    assert "is a folder" in refusal(lambda: load_level(tmp_path))
