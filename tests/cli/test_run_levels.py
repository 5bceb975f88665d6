"""A run keeps the level files that it was made with, and uses its own copies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from level_files import hover, write_level

from rtc_cli.errors import StateError
from rtc_cli.levels import expand, short_name
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import MANIFEST_NAME, Run, create_run, open_run
from rtc_cli.tasks import get_task


@pytest.fixture
def run(tmp_path: Path) -> Run:
    folder = tmp_path / "levels"
    folder.mkdir()
    write_level(folder, hover(), "one")
    tasks = f"tasks=catcher,kinetix:{folder}/one.json,kinetix:{folder}/one.json@symbolic"
    return create_run(load_recipe("quickstart", [tasks]), tmp_path / "run")


def test_levels_are_found_when_the_files_have_moved_or_changed(run: Run, tmp_path: Path) -> None:
    before = {task: get_task(task) for task in run.recipe.tasks}
    original = tmp_path / "levels" / "one.json"
    content = json.loads(original.read_text())
    content["env_state"]["polygon"][1]["friction"] = 0.5
    original.write_text(json.dumps(content))
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere")
    for change in (lambda: None, original.unlink):
        change()
        found = open_run(moved)
        for task, scene in before.items():
            again = get_task(found.source(task))
            assert (again.name, again.digest) == (scene.name, scene.digest)


def test_a_damaged_copy_is_refused(run: Run) -> None:
    copy = run.folder / "levels" / "one.json"
    copy.write_text(copy.read_text().replace("0.15", "0.16"))
    with pytest.raises(StateError, match=r"one\.json is damaged"):
        open_run(run.folder).source(run.recipe.tasks[1])
    copy.unlink()
    with pytest.raises(StateError, match=r"one\.json"):
        open_run(run.folder).source(run.recipe.tasks[1])


def test_a_run_of_an_earlier_version_uses_the_original(run: Run) -> None:
    manifest = json.loads((run.folder / MANIFEST_NAME).read_text())
    del manifest["levels"]
    (run.folder / MANIFEST_NAME).write_text(json.dumps(manifest))
    task = run.recipe.tasks[1]
    assert open_run(run.folder).source(task) == task


def test_file_names_in_any_case_and_script_stay_apart(tmp_path: Path) -> None:
    for name in ("é.json", "ü.JSON", "跳.json"):
        (tmp_path / name).write_text(json.dumps(hover()), encoding="utf-8")
    found = expand([f"kinetix:{tmp_path}"])
    assert [short_name(task) for task in found] == ["kinetix-é", "kinetix-ü", "kinetix-跳"]
    assert [get_task(task).name for task in found] == [short_name(task) for task in found]
