"""Level files wherever tasks are named: recipes, --set, --tasks, run folders, `rtc tasks`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from level_files import hover, write_level

from rtc_cli.cli.app import run as rtc
from rtc_cli.errors import UsageError
from rtc_cli.pipeline.checks import check_recipe
from rtc_cli.pipeline.plan import run_plan
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import create_run, open_run


@pytest.fixture
def levels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "levels"
    folder.mkdir()
    for name in ("one", "two"):
        write_level(folder, hover(), name)
    monkeypatch.chdir(tmp_path)
    return folder


def test_a_recipe_holds_absolute_paths_and_its_run_short_names(levels: Path) -> None:
    recipe = load_recipe("quickstart", ["tasks=catcher,kinetix:levels"])
    wanted = ("catcher", f"kinetix:{levels}/one.json", f"kinetix:{levels}/two.json")
    assert recipe.tasks == wanted
    check_recipe(recipe)
    run = create_run(recipe, Path("run"))
    level = wanted[1]
    for place in (run.experts(level), run.data(level, 0).parent, run.checkpoint(level, 0, "x")):
        assert "kinetix-one" in place.parts
    names = [job.name for job in run_plan(run)]
    assert len(set(names)) == len(names)
    assert any("kinetix-two" in name for name in names)
    assert not any("/" in name for name in names)
    # A run stays readable when the files are gone; only using a level needs its file.
    (levels / "one.json").unlink()
    assert open_run(run.folder).recipe.tasks == wanted
    with pytest.raises(UsageError, match=r"one\.json: No such file"):
        check_recipe(recipe)


@pytest.mark.parametrize(
    ("tasks", "wanted"),
    [
        ("kinetix:nowhere/x.json", "x.json: No such file"),
        ("kinetix:.", "holds no level files"),
        ("kinetix:levels/one.json,kinetix:other/one.json", "would both be called kinetix-one"),
        ("kinetix:levels/one.json,kinetix:./levels/one.json", "name each value once"),
    ],
)
def test_levels_that_cannot_be_used_are_refused(levels: Path, tasks: str, wanted: str) -> None:
    (levels.parent / "other").mkdir()
    write_level(levels.parent / "other", hover(), "one")
    with pytest.raises(UsageError, match=wanted):
        check_recipe(load_recipe("quickstart", [f"tasks={tasks}"]))


def test_tasks_lists_describes_and_draws_levels(
    levels: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rtc(["tasks", "kinetix:levels", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["task"] for row in rows] == ["kinetix-one", "kinetix-two"]
    assert rows[0]["goal"] == 'Kinetix level "one": bring polygon1 to circle1.'
    line = ["tasks", "kinetix:levels/two.json", "--render", "--frames", "2", "--json"]
    assert rtc(line) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert (row["task"], row["by"]) == ("kinetix-two", "random")
    assert {Path(file).name for file in row["files"]} == {"kinetix-two.gif", "kinetix-two.png"}


@pytest.mark.parametrize("command", ["run", "train", "ablate"])
def test_commands_that_start_runs_take_tasks(
    command: str, levels: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rtc([command, "--tasks", "kinetix:levels/three.json"]) == 2
    error = capsys.readouterr().err
    assert f"{levels}/three.json: No such file" in error
    assert error.count("\n") == 1


def test_eval_takes_full_and_short_names_of_the_runs_levels(
    levels: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = load_recipe("quickstart", ["tasks=kinetix:levels/one.json"])
    create_run(recipe, Path("run"))
    for tasks, code, words in (
        ("kinetix-one", 3, "checkpoint"),
        ("kinetix:levels/one.json", 3, "checkpoint"),
        ("kinetix:levels", 2, 'unknown task of this run "kinetix-two"'),
    ):
        line = ["eval", "--run", "run", "--tasks", tasks, "--episodes", "1", "--workers", "1"]
        assert rtc(line) == code, tasks
        assert words in capsys.readouterr().err
