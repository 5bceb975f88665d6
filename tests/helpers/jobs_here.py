"""Runs the jobs of a plan in the test's own process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from rtc_cli.pipeline.executors import Job


class JobsHere:
    """Stands for `execute`: runs the jobs whose names begin so, one after the other."""

    def __init__(self, beginning: str = "") -> None:
        self.beginning = beginning
        self.names: list[str] = []

    def __call__(self, jobs: Sequence[Job], **settings: Any) -> None:
        for job in jobs:
            if job.name.startswith(self.beginning):
                self.names.append(job.name)
                job.work(lambda *progress: None)


def run_jobs_here(monkeypatch: pytest.MonkeyPatch, beginning: str = "") -> JobsHere:
    """Let commands run their jobs here, and return what will have run them."""
    jobs = JobsHere(beginning)
    monkeypatch.setattr("rtc_cli.cli.live.execute", jobs)
    monkeypatch.delenv("RTC_DEBUG", raising=False)
    return jobs
