"""`rtc tasks`, through the program's one entry point."""

import json

import pytest

from rtc_cli.cli.app import run
from rtc_cli.tasks import get_task, list_tasks


def test_the_list_names_every_task(capsys):
    assert run(["tasks", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["task"] for row in rows] == list(list_tasks())
    assert all(row["goal"].endswith(".") for row in rows)


def test_a_description_has_every_observation_and_action(capsys):
    assert run(["tasks", "lunar_lander", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    scene = get_task("lunar_lander")
    assert len(document["observation_components"]) == scene.obs_dim
    assert len(document["action_components"]) == scene.action_dim
    assert document["digest"] == scene.digest


def test_pictures_are_written(capsys, tmp_path):
    line = ["tasks", "lunar_lander", "--render", "--by", "random", "--frames", "2", "--json"]
    assert run([*line, "--out", str(tmp_path)]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["status"] == "failed"
    assert (tmp_path / "lunar_lander.gif").stat().st_size > 1000
    assert (tmp_path / "lunar_lander.png").stat().st_size > 1000


def test_several_are_shown_side_by_side(capsys, tmp_path):
    line = ["tasks", "lunar_lander", "--render", "--by", "random,controller", "--frames", "2"]
    assert run([*line, "--json", "--out", str(tmp_path)]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["by"], row["status"]) for row in rows] == [
        ("random", "failed"),
        ("controller", "solved"),
    ]
    assert rows[0]["files"] == rows[1]["files"]


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        (["tasks", "lunar_landr"], 2, 'Did you mean "lunar_lander"'),
        (["tasks", "--render"], 2, "needs one task"),
        (["tasks", "catcher", "--render", "--by", "nave"], 2, 'Did you mean "naive"'),
        (["tasks", "catcher", "--render", "--by", "naive,pnv"], 2, 'Did you mean "pinv"'),
        (["tasks", "catcher", "--render", "--by", "sync,naive,pinv,prefix,random"], 2, "at most 4"),
        (["tasks", "catcher", "--render", "--delay", "2"], 2, "computes no chunks"),
        (["tasks", "catcher", "--render", "--by", "random", "--out", "missing"], 3, "no folder"),
        (["tasks", "catcher", "--render", "--by", "naive"], 3, "no run"),
    ],
)
def test_bad_input_is_one_line(line, code, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(line) == code
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
