"""The executor keeps the order of needs, uses its workers and reports errors whole."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import jobs_for_tests as work
import pytest

from rtc_cli.errors import DivergedError, StateError
from rtc_cli.pipeline.executors import Job, execute


class Ears:
    """A listener that remembers."""

    def __init__(self) -> None:
        self.ended: list[str] = []
        self.notes: list[str] = []

    def planned(self, jobs) -> None:
        self.count = len(jobs)

    def progress(self, job: str, done: float, total: float, note: str) -> None:
        self.notes.append(f"{job} {note}")

    def finished(self, job: str, seconds: float) -> None:
        self.ended.append(job)


def _times(folder: Path, name: str) -> tuple[float, float]:
    began, ended, _ = (folder / name).read_text().split()
    return float(began), float(ended)


def test_needs_are_kept_and_independent_jobs_share_the_time(tmp_path: Path) -> None:
    def job(name: str, *needs: str) -> Job:
        return Job(name, "test", partial(work.touch, str(tmp_path), name, 0.4), needs)

    ears = Ears()
    execute(
        [job("a"), job("b"), job("c", "a", "b"), job("d", "elsewhere")], workers=2, listener=ears
    )
    a, b, c = (_times(tmp_path, name) for name in "abc")
    assert c[0] >= max(a[1], b[1])
    assert max(a[0], b[0]) < min(a[1], b[1]), "a and b ran one after the other"
    assert sorted(ears.ended) == ["a", "b", "c", "d"]
    assert ears.count == 4
    assert "a begun" in ears.notes


def test_an_error_stops_the_plan_and_keeps_its_hint_and_code(tmp_path: Path) -> None:
    jobs = [
        Job("bad", "test", work.diverge),
        Job("after", "test", partial(work.touch, str(tmp_path), "after", 0.0), ("bad",)),
    ]
    with pytest.raises(DivergedError) as caught:
        execute(jobs, workers=1)
    assert (caught.value.message, caught.value.hint) == ("loss is NaN", "lower the rate")
    assert caught.value.exit_code == 4
    assert not (tmp_path / "after").exists()


def test_an_error_does_not_wait_for_other_jobs(tmp_path: Path) -> None:
    jobs = [
        Job("long", "test", partial(work.touch, str(tmp_path), "long", 60.0)),
        Job("bad", "test", work.diverge),
    ]
    began = time.monotonic()
    with pytest.raises(DivergedError):
        execute(jobs, workers=2)
    assert time.monotonic() - began < 30
    assert not (tmp_path / "long").exists()


def test_a_worker_that_dies_is_reported() -> None:
    with pytest.raises(StateError, match="worker process ended"):
        execute([Job("dies", "test", work.die)], workers=1)
