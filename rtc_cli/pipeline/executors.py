"""Runs the jobs of a plan in the order of their needs, in worker processes.

A job is a picklable call that leaves its result in files, so a job that was interrupted is simply
run again. Worker processes are spawned once and kept: each imports JAX and compiles a program only
once. They ignore Ctrl-C (the parent decides) and leave when the parent is gone. Several processes
with one XLA thread each make better use of cores than one process with several threads: the
networks are small.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rtc_cli.errors import StateError
from rtc_cli.runtime import share_accelerator, use_compilation_cache, use_threads

Progress = Callable[[float, float, str], None]
"""``progress(done, total, note)``: how far the running job is, in its own unit."""


@dataclass(frozen=True)
class Job:
    """One unit of work. ``work(progress)`` must be picklable; ``needs`` names earlier jobs."""

    name: str
    stage: str
    work: Callable[[Progress], None]
    needs: tuple[str, ...] = ()


class Listener(Protocol):
    """Hears what the executor does; the command line shows it."""

    def planned(self, jobs: Sequence[Job]) -> None: ...

    def progress(self, job: str, done: float, total: float, note: str) -> None: ...

    def finished(self, job: str, seconds: float) -> None: ...


class Silent:
    """A listener that says nothing."""

    def planned(self, jobs: Sequence[Job]) -> None:
        """Ignore."""

    def progress(self, job: str, done: float, total: float, note: str) -> None:
        """Ignore."""

    def finished(self, job: str, seconds: float) -> None:
        """Ignore."""


def execute(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    threads: int | None = 1,
    cache: Path | None = None,
    listener: Listener | None = None,
) -> None:
    """Run all jobs in worker processes; the first error stops everything and is raised.

    Args:
        jobs: in order of preference. A need that is not the name of one of them is taken as met.
        workers: processes.
        threads: XLA threads of each worker; None leaves XLA its own choice.
        cache: folder in which the workers share compiled programs; None keeps none.
        listener: hears about the plan, progress and ends.
    """
    if not jobs:
        return
    listener = listener or Silent()
    listener.planned(jobs)
    context = multiprocessing.get_context("spawn")
    messages: Any = context.Queue()
    pool = ProcessPoolExecutor(
        max_workers=min(workers, len(jobs)),
        mp_context=context,
        initializer=_start_worker,
        initargs=(messages, os.getpid(), threads, cache),
    )
    try:
        _schedule(pool, jobs, workers, messages, listener)
    except BrokenProcessPool as error:
        raise StateError(
            "a worker process ended without an answer (killed, or out of memory)",
            hint="run the command again: finished parts are kept. --workers 1 needs less memory.",
        ) from error
    finally:
        _stop(pool)


def _schedule(
    pool: ProcessPoolExecutor,
    jobs: Sequence[Job],
    workers: int,
    messages: Any,
    listener: Listener,
) -> None:
    waiting = list(jobs)
    running: dict[Future[float], Job] = {}
    open_names = {job.name for job in jobs}
    while waiting or running:
        ready = [job for job in waiting if open_names.isdisjoint(job.needs)]
        for job in ready[: workers - len(running)]:
            waiting.remove(job)
            with _sigint_blocked():
                running[pool.submit(_work, job)] = job
        finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
        _pass_on(messages, listener)
        for future in finished:
            job = running.pop(future)
            listener.finished(job.name, future.result())
            open_names.remove(job.name)


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Hold Ctrl-C back: a process spawned within inherits that, so it cannot die of one early."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _pass_on(messages: Any, listener: Listener) -> None:
    while True:
        try:
            name, done, total, note = messages.get_nowait()
        except queue.Empty:
            return
        listener.progress(name, done, total, note)


def _stop(pool: ProcessPoolExecutor) -> None:
    # After an error or Ctrl-C the workers are in the middle of jobs whose results nobody awaits;
    # every file appears whole or not at all, so ending them loses nothing.
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    with _sigint_blocked():  # an impatient second Ctrl-C waits until they are gone
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


_messages: Any = None


def _start_worker(messages: Any, parent: int, threads: int | None, cache: Path | None) -> None:
    global _messages
    _messages = messages
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(threads)
    share_accelerator()
    if cache is not None:
        use_compilation_cache(cache)
    threading.Thread(target=_leave_with_parent, args=(parent,), daemon=True).start()


def _leave_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _work(job: Job) -> float:
    started = time.monotonic()
    last = 0.0

    def progress(done: float, total: float, note: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 0.2 or done >= total:
            last = now
            _messages.put((job.name, done, total, note))

    job.work(progress)
    return time.monotonic() - started
