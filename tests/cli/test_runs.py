"""Run folders: layout, newest, foreign and damaged ones, and the lock."""

import json
import subprocess
import sys

import pytest

from rtc_cli.cli.starting import start
from rtc_cli.errors import StateError, UsageError
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import create_run, newest_run, open_or_create_run, open_run


@pytest.fixture
def recipe():
    return load_recipe("quickstart")


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_create_open_and_newest(recipe):
    first = create_run(recipe, device="test device")
    second = create_run(recipe)
    assert first.folder != second.folder
    assert newest_run().folder == second.folder
    assert newest_run(recipe).folder == second.folder
    opened = open_run(first.folder, recipe)
    assert opened.recipe == recipe
    assert opened.manifest["device"] == "test device"
    assert opened.manifest["recipe_hash"] == recipe.content_hash
    assert {"rtc", "python", "jax", "pymunk"} <= set(opened.manifest["versions"])
    assert opened.checkpoint("t", 0, "base").relative_to(first.folder).as_posix() == (
        "checkpoints/t/seed-0/base"
    )


def test_no_run_and_no_run_of_this_recipe(recipe):
    with pytest.raises(StateError, match="no run"):
        newest_run()
    create_run(recipe)
    with pytest.raises(StateError, match=r"no run of recipe .paper."):
        newest_run(load_recipe("paper"))


def test_a_foreign_run_is_refused_and_says_where_it_differs(recipe, tmp_path):
    run = open_or_create_run(recipe, tmp_path / "run")
    assert open_or_create_run(recipe, run.folder).manifest == run.manifest
    with pytest.raises(StateError, match=r"another recipe.*train\.epochs"):
        open_or_create_run(load_recipe("quickstart", ["train.epochs=3"]), run.folder)


def test_missing_and_strange_folders(tmp_path, recipe):
    with pytest.raises(StateError, match="does not exist"):
        open_run(tmp_path / "nowhere")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").touch()
    with pytest.raises(StateError, match="holds no run"):
        open_run(tmp_path / "full")
    with pytest.raises(StateError, match="exists"):
        create_run(recipe, tmp_path / "full")
    assert [file.name for file in (tmp_path / "full").iterdir()] == ["thesis.txt"]


def test_damaged_runs(tmp_path, recipe):
    run = create_run(recipe, tmp_path / "run")
    (run.folder / "recipe.toml").write_text('tasks = ["other"]\n')
    with pytest.raises(StateError, match="changed after the run was made"):
        open_run(run.folder)
    (run.folder / "manifest.json").write_text("{")
    with pytest.raises(StateError, match="damaged"):
        open_run(run.folder)
    manifest = dict(run.manifest, schema=99)
    (run.folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StateError, match="schema 99"):
        open_run(run.folder)


def test_one_writer_at_a_time(recipe):
    run = create_run(recipe)
    other = open_run(run.folder)
    with run.lock(), pytest.raises(StateError, match="locked by process"), other.lock():
        pass
    with other.lock():
        pass


def test_a_dead_owners_lock_is_taken_over(recipe):
    run = create_run(recipe)
    code = (
        "import os, sys; from rtc_cli.runs import open_run\n"
        "with open_run(sys.argv[1]).lock():\n"
        "    print('locked', flush=True); sys.stdin.read()"
    )
    owner = subprocess.Popen(
        [sys.executable, "-c", code, str(run.folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert owner.stdout is not None
    assert owner.stdout.readline() == "locked\n"
    with pytest.raises(StateError, match=f"process {owner.pid} "), run.lock():
        pass
    owner.kill()
    owner.wait()
    with run.lock():
        pass


def test_a_run_accumulates_training_seeds(recipe, tmp_path):
    other = load_recipe("quickstart", ["train.seeds=3,1"])
    assert other.content_hash == recipe.content_hash
    run = create_run(recipe, tmp_path / "run")
    assert open_or_create_run(other, run.folder).recipe.train.seeds == (0, 3, 1)
    assert open_run(run.folder).recipe.train.seeds == (0, 3, 1)
    assert open_run(run.folder, recipe).with_seeds([1]).recipe.train.seeds == (0, 3, 1)


def test_seeds_that_tuning_uses_are_refused_and_change_nothing(tmp_path):
    run = create_run(load_recipe("standard"), tmp_path / "run")
    before = (run.folder / "recipe.toml").read_bytes()
    with pytest.raises(UsageError, match=r"tune.train_seed 90"):
        run.with_seeds([90])
    assert (run.folder / "recipe.toml").read_bytes() == before


def test_seeds_go_to_the_newest_run_of_the_recipe():
    first = start("quickstart", None, None, resume=False, seeds="0-1")
    assert first.recipe.train.seeds == (0, 1)
    second = start("quickstart", None, None, resume=False, seeds="1-2")
    assert (second.folder, second.recipe.train.seeds) == (first.folder, (0, 1, 2))
    other = start("quickstart", ["train.epochs=5"], None, resume=False, seeds="4")
    assert (other.folder != first.folder, other.recipe.train.seeds) == (True, (4,))
    again = start(None, None, first.folder, resume=False, seeds="7")
    assert again.recipe.train.seeds == (0, 1, 2, 7)
    with pytest.raises(UsageError, match=r'cannot read seeds "x"'):
        start("quickstart", None, None, resume=False, seeds="x")
