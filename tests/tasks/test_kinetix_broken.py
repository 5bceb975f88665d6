"""Broken and unsupported level files: one line that names the file, the field and the rule."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from level_files import Content, hover, write_level

from rtc_cli.errors import UsageError
from rtc_cli.tasks import get_task
from rtc_cli.tasks.kinetix import load_level

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


def star(level: Content) -> None:
    """Five corners that turn right all the way but wind round twice."""
    corners = ((0.0, 1.0), (0.59, -0.81), (-0.95, 0.31), (0.95, 0.31), (-0.59, -0.81))
    vertices = {str(i): {"0": x, "1": y} for i, (x, y) in enumerate(corners)}
    level["env_state"]["polygon"][1] |= {"n_vertices": 5, "vertices": vertices}


def many_shapes(level: Content) -> None:
    level["env_state"]["polygon"] *= 2500
    level["static_env_params"]["num_polygons"] = 10_000


def anticlockwise(level: Content) -> None:
    vertices = level["env_state"]["polygon"][1]["vertices"]
    vertices["0"], vertices["2"] = vertices["2"], vertices["0"]


def dented(level: Content) -> None:
    level["env_state"]["polygon"][1]["vertices"]["1"] = {"0": -0.19, "1": 0.0}


def weld_target_to_hull(level: Content) -> None:
    level["env_state"]["joint"][1] |= {"a_index": 5, "b_index": 1, "is_fixed_joint": False}
    level["env_state"]["circle"][1]["position"] = level["env_state"]["polygon"][1]["position"]
    level["env_state"]["joint"][1]["a_relative_pos"] = {"0": 0, "1": 0}


def two_hinges_on_one_point(level: Content) -> None:
    """The hull hangs by one point on two places of the floor, 0.8 m apart."""
    level["env_state"]["polygon"][0] |= {"position": {"0": 2.0, "1": 1.7}, "role": 0}
    hinge = level["env_state"]["joint"][1] | {"a_index": 0, "b_index": 1, "is_fixed_joint": False}
    at = {"b_relative_pos": {"0": 0.0, "1": 0.0}}
    level["env_state"]["joint"] = [
        hinge | at | {"a_relative_pos": {"0": x, "1": 0.3}} for x in (-0.4, 0.4)
    ] + level["env_state"]["joint"][2:]


def passing_by(level: Content) -> None:
    for shape in (level["env_state"]["polygon"][1], level["env_state"]["circle"][1]):
        shape["collision_mode"] = 0


def without_drives(level: Content) -> None:
    level["env_state"]["joint"][0]["motor_on"] = False
    for thruster in level["env_state"]["thruster"]:
        thruster["active"] = False


BROKEN: dict[str, tuple[Change, str]] = {
    "no env_state": (lambda level: level.pop("env_state"), '"env_state" is missing'),
    "missing key": (put("polygon[1].friction", KeyError), r'"friction" is missing in .*polygon\[1'),
    "missing constants": (put("env_params.dt", KeyError), '"dt" is missing in env_params'),
    "text for a number": (put("polygon[1].friction", "x"), r'polygon\[1\].friction is "x"; a num'),
    "flag for a number": (put("circle[0].radius", True), r"circle\[0\].radius is true; a number"),
    "number for a flag": (put("joint[0].motor_on", 1), r"joint\[0\].motor_on is 1; true or false"),
    "list for an object": (put("polygon[1].position", 3), r"polygon\[1\].position is 3; a list"),
    "text for a list": (put("joint", "none"), 'env_state.joint is "none"; a list'),
    "a shape is a number": (put("circle", [1, 2, 3]), r"circle\[0\] is 1; an object"),
    "NaN": (put("polygon[1].rotation", float("nan")), r"polygon\[1\].rotation is NaN"),
    "infinity": (put("gravity.1", float("-inf")), r"gravity\[1\] is -Infinity"),
    "huge number": (put("polygon[1].velocity.0", 1e300), r"velocity\[0\] is 1e\+300; -100 to 100"),
    "huge whole number": (
        put("polygon[1].angular_velocity", 10**400),
        r"angular_velocity is 1000.*\.\.\.; -100 to 100",
    ),
    "pair of three": (put("gravity", [0, 1, 2]), "gravity has 3 entries; 2"),
    "joint to an inactive shape": (put("joint[0].b_index", 3), r"joint\[0\].b_index is 3; the num"),
    "joint to no shape": (put("joint[0].a_index", -1), r"joint\[0\].a_index is -1"),
    "joint to itself": (put("joint[0].b_index", 1), r"joint\[0\].b_index is 1; .*two different"),
    "joint with ends apart": (put("joint[0].b_relative_pos.1", 2.0), r"joint\[0\]: .*m apart"),
    "twisted weld": (put("joint[1].rotation", 1.5), r"joint\[1\].rotation is 1.5"),
    "limits the wrong way": (put("joint[0].max_rotation", -2.0), r"joint\[0\].max_rotation is -2"),
    "thruster on an inactive shape": (put("thruster[0].object_index", 6), "object_index is 6"),
    "zero mass": (put("polygon[1].density", 0), r"polygon\[1\].density is 0; a shape that moves"),
    "negative mass": (put("polygon[1].inverse_mass", -1.0), r"polygon\[1\].inverse_mass is -1"),
    "almost no mass": (put("polygon[1].inverse_mass", 1e12), "inverse_mass is 1000000000000"),
    "negative radius": (put("circle[1].radius", -0.2), r"circle\[1\].radius is -0.2"),
    "two corners": (put("polygon[1].n_vertices", 2), r"polygon\[1\].n_vertices is 2; 3 to"),
    "more corners than listed": (put("polygon[1].n_vertices", 6), "vertices has 4 entries; 6 to"),
    "half a corner": (put("polygon[1].n_vertices", 3.5), "n_vertices is 3.5; a whole number"),
    "not convex": (dented, r"polygon\[1\].vertices .* convex"),
    "a star": (star, r"polygon\[1\].vertices .* convex"),
    "anticlockwise": (anticlockwise, r"polygon\[1\].vertices .*anticlockwise"),
    "joints that contradict each other": (two_hinges_on_one_point, r"joint\[\d\]: .* contradict"),
    "goal and target pass each other": (passing_by, "collision_mode: no shape of role 1 touches"),
    "unknown role": (put("polygon[1].role", 4), r"polygon\[1\].role is 4; 0 to 3"),
    "unknown collision mode": (put("polygon[1].collision_mode", 3), "collision_mode is 3; 0 to 2"),
    "motor binding out of range": (put("joint[0].motor_binding", 4), "motor_binding is 4; 0 to 3"),
    "thruster binding out of range": (put("thruster[0].thruster_binding", 2), "binding is 2; 0 to"),
    "negative power": (put("thruster[0].power", -0.1), r"thruster\[0\].power is -0.1"),
    "restitution above 1": (put("circle[0].restitution", 1.5), "restitution is 1.5; 0 to 1"),
    "no goal object": (put("polygon[1].role", 0), r"no active shape has role 1 \(goal\)"),
    "no target": (put("circle[1].role", 0), r"no active shape has role 2 \(target\)"),
    "wrong list length": (
        put("static_env_params.num_circles", 4),
        "num_circles is 4; env_state.ci",
    ),
    "10,000 shapes": (many_shapes, "env_state.polygon has 10000 entries; 0 to 32"),
    "another time step": (put("env_params.dt", 0.01), "env_params.dt is 0.01; only 1/60"),
    "another frame skip": (put("static_env_params.frame_skip", 4), "frame_skip is 4; only 2"),
    "long episodes": (put("env_params.max_timesteps", 1000), "max_timesteps is 1000; 1 to 256"),
    "a wheel on the wall": (
        put("polygon[0].inverse_inertia", 5.0),
        "inverse_inertia is 5.0; a sha",
    ),
    "a moving wall": (put("polygon[0].velocity.0", 1.0), r"polygon\[0\].velocity .* not supported"),
    "goal welded to the target": (weld_target_to_hull, r"joints connect .*polygon\[1\].*circle\[1"),
    "nothing to steer": (without_drives, "no active motor or thruster"),
}


def refusal(act: Callable[[], Any]) -> str:
    """The message of a UsageError, checked to be one line."""
    with pytest.raises(UsageError) as caught:
        act()
    assert caught.value.hint
    assert "\n" not in caught.value.message
    assert len(caught.value.message) < 400
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
