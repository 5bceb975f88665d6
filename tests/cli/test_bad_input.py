"""Bad input of every kind: one line with value, rule and fix, a code, and nothing half-written."""

import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rtc_cli.cli.app as program
from rtc_cli.errors import StateError
from rtc_cli.files import read_json, remove_remains, write_checksums
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import create_run


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RTC_DEBUG", raising=False)


def _refusal(args: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = program.run(args)
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("rtc: error: ")
    return code, lines[0]


BAD_FILES = [
    ("broken.toml", b'tasks = ["catcher"\n', ["broken TOML", "mend"]),
    ("latin.toml", b'tasks = ["catcher"]\nname = "\xff"\n', ["byte 28", "UTF-8"]),
    ("empty.toml", b"", ['"tasks" is missing']),
    ("folder.toml", None, ["folder.toml", "folder, not a file"]),
]


@pytest.mark.parametrize(("name", "content", "words"), BAD_FILES, ids=[b[0] for b in BAD_FILES])
def test_bad_recipe_files(name, content, words, capsys, tmp_path):
    path = tmp_path / name
    path.mkdir() if content is None else path.write_bytes(content)
    code, line = _refusal(["run", name], capsys)
    assert code == 2
    assert all(word in line for word in words), line
    assert not (tmp_path / "runs").exists()


BAD_SETTINGS = [
    ("nonsense", ['"nonsense"', "KEY=VALUE"]),
    ("train=3", ["train = 3", "section"]),
    ("train.epochs=abc", ['"abc"', "integer"]),
    ("train.epochs=0", ["train.epochs = 0", "1"]),
    ("train.learning_rate=nan", ["NaN", "finite"]),
    ("train.batch=100000", ["100000", "65000", "minibatch"]),
    ("train.seeds=[]", ["train.seeds = []", "at least one"]),
    ("train.seeds=0,0", ["[0, 0]", "once"]),
    ("train.seeds=99999999999999999999999", ["train.seeds", "899"]),
    ("tasks=[]", ["tasks = []", "at least one"]),
    ("network.kind=mixr", ['"mixr"', 'mean "mixer"']),
    ("eval.delays=4-0", ["4-0", "backwards", '"0-4"']),
    ("eval.episodes=9999999", ["9999999", "100000"]),
    ("eval.protocols=fixed:9", ["fixed:9", "1 to 8"]),
    ("profile.samplers=pnv", ['"pnv"', 'mean "pinv"']),
    ("horizon=4", ["horizon 4", "support reaches 4"]),
]


@pytest.mark.parametrize(("setting", "words"), BAD_SETTINGS, ids=[b[0][:30] for b in BAD_SETTINGS])
def test_bad_settings(setting, words, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("rtc_cli.cli.starting.open_or_create_run", None)  # no run may start
    code, line = _refusal(["run", "quickstart", "--set", setting], capsys)
    assert code == 2
    assert all(word in line for word in words), line
    assert list(tmp_path.iterdir()) == []


BAD_COMMANDS = [
    (["run", ""], 2, ['unknown recipe ""', "quickstart"]),
    (["run", "--workers", "0"], 2, ["--workers", "not 0"]),
    (["run", "--resume"], 3, ["no run", "rtc run"]),
    (["ablate", "quickstart"], 2, ['"quickstart"', "[ablation]", "rtc run"]),
    (["train", "quickstart", "--run", "file"], 3, ["file", "exists"]),
    (["report", "--run", "file"], 3, ["file", "holds no run"]),
    (["profile", "--batch", ""], 2, ['""', "1,64"]),
    (["eval", "--flow-steps", "0"], 2, ["--flow-steps", "not 0"]),
]


@pytest.mark.parametrize(("args", "code", "words"), BAD_COMMANDS, ids=lambda v: str(v)[:40])
def test_bad_commands(args, code, words, capsys, tmp_path):
    (tmp_path / "file").write_text("mine")
    found, line = _refusal(args, capsys)
    assert found == code
    assert all(word in line for word in words), line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_whose_recipe_was_edited(capsys, tmp_path):
    run = create_run(load_recipe("quickstart"), tmp_path / "run")
    path = run.folder / "recipe.toml"
    path.write_text(path.read_text().replace("epochs = ", "epochs = 1"))
    code, line = _refusal(["eval", "--run", "run"], capsys)
    assert code == 3
    assert "was changed" in line
    assert "restore it" in line


def test_damaged_records_name_the_file(tmp_path):
    (tmp_path / "0.json").write_text('{"task"')
    with pytest.raises(StateError, match=r"record of an expert is damaged: .*0\.json"):
        read_json(tmp_path / "0.json", "record of an expert")


def test_the_next_writer_removes_what_an_ended_one_left(tmp_path):
    run = create_run(load_recipe("quickstart"), tmp_path / "run")
    (run.folder / "data" / ".seed-0.abc.tmp").mkdir(parents=True)
    (run.folder / "data" / ".seed-0.abc.tmp" / "actions.npy").touch()
    (run.folder / ".recipe.toml.xyz.tmp").touch()
    with run.lock():
        assert list(run.folder.rglob("*.tmp")) == []
    assert (run.folder / "recipe.toml").is_file()
    remove_remains(tmp_path / "nowhere")


# -- states that need a trained run ------------------------------------------------------------

_TINY = {
    "tasks": "cartpole_thrust",
    "experts.seeds": "0",
    "experts.max_steps": "20000",
    "experts.worlds": "64",
    "experts.target_success": "0.01",
    "experts.min_success": "0",
    "data.transitions": "2000",
    "network.channels": "8",
    "network.channel_hidden": "8",
    "network.token_hidden": "8",
    "train.batch": "64",
    "train.epochs": "40",
    "train.warmup_steps": "2",
    "eval.delays": "0,2",
    "eval.episodes": "12",
}
_RTC = [sys.executable, "-m", "rtc_cli"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bad") / "run"
    settings = [part for key, value in _TINY.items() for part in ("--set", f"{key}={value}")]
    command = [*_RTC, "train", "quickstart", "--run", str(folder), *settings]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


_CHECKPOINTS = Path("checkpoints/cartpole_thrust/seed-0")
_DATA = Path("data/cartpole_thrust/seed-0")


def _flip_a_byte(run: Path) -> None:
    files = [file for file in (run / _CHECKPOINTS / "base/params").rglob("*") if file.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(content)


def _change_the_horizon(run: Path) -> None:
    path = run / _CHECKPOINTS / "base/meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"horizon": 6}))
    write_checksums(path.parent)


def _put_a_pickle(run: Path) -> None:
    (run / _CHECKPOINTS / "base/params.pkl").write_bytes(pickle.dumps({"weights": [1.0]}))


def _put_nan(run: Path) -> None:
    actions = np.load(run / _DATA / "actions.npy")
    actions[77, 0] = np.nan
    np.save(run / _DATA / "actions.npy", actions)
    write_checksums(run / _DATA)
    shutil.rmtree(run / _CHECKPOINTS / "base")


def _damage_the_expert(run: Path) -> None:
    (run / "experts/cartpole_thrust/0.json").write_text("{")


def _remove_checkpoints(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")


DAMAGES = [
    ("eval", _flip_a_byte, ["damaged", "does not match its checksum", "restore or remove"]),
    ("eval", _change_the_horizon, ["has horizon 6, but 8 is needed"]),
    ("eval", _put_a_pickle, ["params.pkl is a pickle", "never unpickles"]),
    ("eval", _remove_checkpoints, ["missing", "rtc train"]),
    ("train", _put_nan, ["actions.npy", "NaN", "row 77", "collected anew"]),
    ("train", _damage_the_expert, ["0.json", "damaged", "remove that file"]),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "damage", "words"), DAMAGES, ids=[damage.__name__ for _, damage, _ in DAMAGES]
)
def test_damaged_runs(
    command: str, damage: Callable[[Path], None], words: list[str], trained: Path, tmp_path: Path
):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    damage(run)
    done = subprocess.run(
        [*_RTC, command, "--run", str(run), "--workers", "1"], capture_output=True, text=True
    )
    assert done.returncode == 3
    said = [line for line in done.stderr.splitlines() if not line.startswith("[")]  # progress
    assert len(said) == 1, done.stderr
    assert all(word in said[0] for word in words), said[0]
    assert list(run.rglob("*.tmp")) == []


@pytest.mark.slow
def test_a_full_disk_loses_nothing_and_can_be_resumed(trained: Path, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    shutil.rmtree(run / _CHECKPOINTS / "base")
    command = [*_RTC, "train", "--run", str(run), "--workers", "1"]
    limited = ["bash", "-c", 'ulimit -f 8; exec "$@"', "bash", *command]
    done = subprocess.run(limited, capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert not (run / _CHECKPOINTS / "base").exists()
    assert subprocess.run(command, capture_output=True).returncode == 0
    assert (run / _CHECKPOINTS / "base").is_dir()
