"""Worker processes end with their batch, whatever happens, and load no heavy library."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from toy_scenes import ball

from rtc_cli.errors import StateError
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.workers import ProcessBatch


def processes(worlds: WorldBatch) -> list[subprocess.Popen[bytes]]:
    assert isinstance(worlds._batch, ProcessBatch)
    return worlds._batch._processes


def test_close_ends_workers_also_after_an_error() -> None:
    def fail() -> None:
        with WorldBatch(ball(), 4, workers=2) as worlds:
            running.extend(processes(worlds))
            raise KeyboardInterrupt

    running: list[subprocess.Popen[bytes]] = []
    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [process.returncode for process in running] == [0, 0]


def test_a_batch_that_is_dropped_ends_its_workers() -> None:
    worlds = WorldBatch(ball(), 4, workers=2)
    running = processes(worlds)
    del worlds
    assert [process.returncode for process in running] == [0, 0]


def test_a_killed_worker_is_reported_and_the_batch_closed() -> None:
    with WorldBatch(ball(), 4, workers=2) as worlds:
        worlds.reset(range(4))
        running = processes(worlds)
        running[1].kill()
        with pytest.raises(StateError, match="ended unexpectedly"):
            worlds.step(np.zeros((4, 2, 1)))
        assert running[0].returncode == 0
        with pytest.raises(StateError, match="closed"):
            worlds.step(np.zeros((4, 2, 1)))


SCRIPT = """
import sys, time
from toy_scenes import ball
from rtc_cli.tasks.batch import WorldBatch
assert "jax" not in sys.modules
worlds = WorldBatch(ball(), 4, workers=2)
print(*(p.pid for p in worlds._batch._processes), flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_do_not_survive_their_parent(how: signal.Signals) -> None:
    path = os.pathsep.join([str(Path(__file__).parents[1] / "helpers"), *sys.path])
    parent = subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert parent.stdout is not None
    with parent.stdout:
        workers = [int(number) for number in parent.stdout.readline().split()]
    assert len(workers) == 2
    parent.send_signal(how)
    parent.wait()
    deadline = time.monotonic() + 20.0
    while any(_lives(pid) for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _lives(pid: int) -> bool:
    """Whether a process runs; one that has ended but that nobody has waited for does not."""
    status = Path(f"/proc/{pid}/stat")
    if not status.parent.parent.exists():
        pytest.skip("needs /proc")
    try:
        return status.read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_workers_import_no_jax() -> None:
    code = "import rtc_cli.tasks.workers, sys; print('jax' in sys.modules)"
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"
