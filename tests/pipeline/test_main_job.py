"""The whole job on a tiny recipe: resume after SIGKILL, workers, and what is computed again.

Slow: each test starts processes that import JAX and compile.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from rtc_cli.results import ResultStore
from rtc_cli.training.checkpoints import load_policy, policy_digest

pytestmark = pytest.mark.slow

TINY = [
    "tasks=cartpole_thrust",
    "experts.seeds=0",
    "experts.max_steps=20000",
    "experts.worlds=64",
    "experts.target_success=0.01",
    "experts.min_success=0",
    "data.transitions=2000",
    "network.channels=8",
    "network.channel_hidden=8",
    "network.token_hidden=8",
    "train.batch=64",
    "train.epochs=40",
    "train.warmup_steps=2",
    "eval.delays=0,2",
    "eval.episodes=12",
    "profile.rounds=2",
]
# Enough to compare rows; what takes time is starting processes and compiling.
FEWER = [
    *("--set", "train.epochs=4", "--set", "eval.methods=naive,prefix"),
    *("--set", "profile.samplers=prefix"),
]
VARYING = [
    *("--delay-model", "constant:0", "--delay-model", "constant:2"),
    *("--delay-model", "uniform:0-4", "--estimator", "exact", "--estimator", "max-of-last:3"),
]
SETTINGS = [part for setting in TINY for part in ("--set", setting)]
COMMAND = [sys.executable, "-m", "rtc_cli"]


def _rtc(*args: str, folder: Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([*COMMAND, *args], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


def _digest(run: Path, kind: str) -> str:
    return policy_digest(load_policy(run / "checkpoints" / "cartpole_thrust" / "seed-0" / kind))


def _kill_during_training(run: Path, folder: Path) -> None:
    """Start training and kill the whole process group once a few epochs are saved."""
    process = subprocess.Popen(
        [*COMMAND, "train", "quickstart", "--run", str(run), *SETTINGS],
        cwd=folder,
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    saved = run / "partial" / "cartpole_thrust" / "seed-0" / "fork"
    for _ in range(1200):
        if saved.is_dir() and any(saved.glob("epoch-*")):
            break
        assert process.poll() is None, "training ended before it could be killed"
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (run / "checkpoints" / "cartpole_thrust" / "seed-0" / "base").exists()


def test_training_killed_and_resumed_ends_with_the_same_bits(tmp_path: Path) -> None:
    _kill_during_training(tmp_path / "killed", tmp_path)
    _rtc("train", "--run", "killed", folder=tmp_path)
    _rtc("train", "quickstart", "--run", "whole", *SETTINGS, folder=tmp_path)
    for kind in ("base", "prefix"):
        assert _digest(tmp_path / "killed", kind) == _digest(tmp_path / "whole", kind)
    assert _digest(tmp_path / "whole", "base") != _digest(tmp_path / "whole", "prefix")


def test_rows_do_not_depend_on_workers_and_present_cells_are_not_computed_again(
    tmp_path: Path,
) -> None:
    _rtc("train", "quickstart", "--run", "one", *SETTINGS, *FEWER, folder=tmp_path)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    _rtc("run", "--run", "one", "--workers", "1", folder=tmp_path)
    for name, workers in (("one", "1"), ("two", "2")):
        _rtc("eval", "--run", name, "--workers", workers, *VARYING, folder=tmp_path)
    one, two = (_rows(tmp_path / name) for name in ("one", "two"))
    assert set(one.delay_model) == {"constant:0", "constant:2", "uniform:0-4"}
    assert set(one.estimator) == {"exact", "max-of-last:3"}
    pd.testing.assert_frame_equal(one, two)
    cells = sorted((tmp_path / "one" / "results" / "episodes").glob("*.parquet"))
    times = [path.stat().st_mtime_ns for path in cells]
    again = _rtc("eval", "--run", "one", "--json", folder=tmp_path)
    assert [path.stat().st_mtime_ns for path in cells] == times
    document = json.loads(again.stdout)
    assert document["schema"] == 1
    assert {row["delay"] for row in document["rows"]} == {0, 2}
    assert (tmp_path / "one" / "report" / "index.html").stat().st_size > 10_000


def _rows(run: Path) -> pd.DataFrame:
    rows = ResultStore(run / "results" / "episodes").load()
    order = ["method", "delay", "delay_model", "estimator", "protocol", "episode"]
    return rows.sort_values(order, ignore_index=True)
