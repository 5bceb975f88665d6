"""What a person sees while jobs run: bars on a terminal, a line per finished job elsewhere."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.cli.output import progress
from rtc_cli.pipeline.executors import Job, execute
from rtc_cli.runs import Run
from rtc_cli.runtime import has_accelerator

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

# Physics keeps a core busy while another process's inference keeps the GPU busy.
_PER_GPU = 4


def run_jobs(run: Run, jobs: Sequence[Job], workers: int | None) -> None:
    """Run jobs of a run side by side and show how they get on, on stderr.

    Without `workers`: a process per core; with a GPU, a few that share it. The processes keep
    compiled programs in the run's folder.
    """
    threads = None if has_accelerator() else 1
    _show(jobs, workers=workers or _worker_count(), threads=threads, cache=run.programs)


def run_alone(jobs: Sequence[Job]) -> None:
    """Run jobs that measure time one after the other, with all threads and nothing cached."""
    _show(jobs, workers=1, threads=None, cache=None)


def _show(jobs: Sequence[Job], **settings: Any) -> None:
    with progress() as bars:
        listener = _Bars(bars) if sys.stderr.isatty() else _Lines()
        execute(jobs, listener=listener, **settings)


def _worker_count() -> int:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(usable or 1, _PER_GPU) if has_accelerator() else usable or 1


class _Bars:
    """One bar for all jobs, and one for each that runs."""

    def __init__(self, bars: Progress) -> None:
        self.bars = bars
        self.all: TaskID | None = None
        self.running: dict[str, TaskID] = {}

    def planned(self, jobs: Sequence[Job]) -> None:
        """Show how many jobs there are."""
        self.all = self.bars.add_task("jobs", total=len(jobs), note="")

    def progress(self, job: str, done: float, total: float, note: str) -> None:
        """Move a job's bar."""
        if job not in self.running:
            self.running[job] = self.bars.add_task(job, total=int(total), note=note)
        self.bars.update(self.running[job], completed=int(done), total=int(total), note=note)

    def finished(self, job: str, seconds: float) -> None:
        """Remove a job's bar."""
        if job in self.running:
            self.bars.remove_task(self.running.pop(job))
        if self.all is not None:
            self.bars.update(self.all, advance=1, note=f"{job}: {seconds:.0f} s")


class _Lines:
    """For logs: a line per finished job."""

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.count = self.done = 0

    def planned(self, jobs: Sequence[Job]) -> None:
        """Remember how many jobs there are."""
        self.count = len(jobs)

    def progress(self, job: str, done: float, total: float, note: str) -> None:
        """Say nothing before the end."""

    def finished(self, job: str, seconds: float) -> None:
        """Print the job, its seconds and the time since the start."""
        self.done += 1
        since = time.monotonic() - self.started
        print(
            f"[{since:6.0f} s] {self.done}/{self.count} {job}: {seconds:.1f} s",
            file=sys.stderr,
            flush=True,
        )
