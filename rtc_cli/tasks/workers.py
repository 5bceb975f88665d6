"""Many worlds over several processes: same results, bit for bit, as in one.

World w lives in worker w mod k. Requests and answers lie in memory that all processes map; one
short message per worker and call says what to do. Workers are fresh interpreters that import
NumPy and pymunk only (never the caller's main module, never JAX). They end when the pipe to the
parent closes, so none survives it, however it dies; the memory is an unlinked file, so nothing
stays behind either.
"""

from __future__ import annotations

import mmap
import os
import socket
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt

from rtc_cli.errors import StateError, UsageError
from rtc_cli.tasks.local import EngineName, Index, LocalBatch, Record
from rtc_cli.tasks.scene import STATE_SIZE, FloatArray, Scene, StateArray

# Longest piece of a chunk that is handed over at once.
MESSAGE_TICKS = 32
_ALIGN = 64
_PATIENCE_S = 5.0
_START = "from rtc_cli.tasks.workers import serve; import sys; serve(*map(int, sys.argv[1:]))"


class _Memory:
    """Arrays of a batch of n worlds in memory that processes share."""

    def __init__(self, scene: Scene, n: int, file: int) -> None:
        layout = self._layout(scene, n)
        size = sum(self._space(shape, kind) for shape, kind in layout.values())
        if os.fstat(file).st_size < size:
            os.ftruncate(file, size)
        self._map = mmap.mmap(file, size)
        at = 0
        arrays: dict[str, npt.NDArray[Any]] = {}
        for name, (shape, kind) in layout.items():
            arrays[name] = np.ndarray(shape, kind, self._map, at)
            at += self._space(shape, kind)
        self.worlds, self.seeds = arrays["worlds"], arrays["seeds"]
        self.actions, self.obs = arrays["actions"], arrays["obs"]
        self.status, self.ticks = arrays["status"], arrays["ticks"]
        self.solved_last = arrays["solved_last"]
        self.states, self.push = arrays["states"], arrays["push"]

    @staticmethod
    def _layout(scene: Scene, n: int) -> dict[str, tuple[tuple[int, ...], type]]:
        return {
            "worlds": ((n,), np.int64),
            "seeds": ((n,), np.int64),
            "actions": ((n, MESSAGE_TICKS, scene.action_dim), np.float32),
            "obs": ((n, scene.obs_dim), np.float32),
            "status": ((n,), np.int8),
            "ticks": ((n,), np.int32),
            "solved_last": ((n,), np.bool_),
            "states": ((n, len(scene.bodies), STATE_SIZE), np.float64),
            "push": ((n, len(scene.bodies), 3), np.float64),
        }

    @staticmethod
    def _space(shape: tuple[int, ...], kind: type) -> int:
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        return -(-size // _ALIGN) * _ALIGN


class ProcessBatch:
    """Like `LocalBatch`, over `workers` processes."""

    def __init__(self, scene: Scene, n: int, workers: int, engine: EngineName = "auto") -> None:
        self.scene = scene
        self.n = n
        self.invalid_count = 0
        with tempfile.TemporaryFile() as file:
            self._memory = _Memory(scene, n, file.fileno())
            links: list[Connection] = []
            processes: list[subprocess.Popen[bytes]] = []
            self._links, self._processes = links, processes
            self.close = weakref.finalize(self, _end, links, processes)
            for _ in range(workers):
                link, process = _start(file.fileno())
                links.append(link)
                processes.append(process)
        self._memory.states[:] = scene.declared_states
        setup = [(scene, n, k, workers, engine) for k in range(workers)]
        self._exchange(setup)

    @property
    def states(self) -> StateArray:
        """Body states (n, bodies, 6) as of the last call."""
        return self._memory.states

    def reset(self, seeds: npt.NDArray[np.int64], worlds: Index) -> FloatArray:
        """Start episodes; see `LocalBatch.reset`."""
        m = len(worlds)
        self._memory.worlds[:m] = worlds
        self._memory.seeds[:m] = seeds
        self._ask("reset", m, 0)
        return self._memory.obs[:m].copy()

    def step(self, actions: FloatArray, worlds: Index) -> Record:
        """Run worlds through actions; see `LocalBatch.step`."""
        m, total = actions.shape[:2]
        memory = self._memory
        memory.worlds[:m] = worlds
        executed = np.zeros(m, np.int32)
        # An empty chunk is asked too: it answers with observation and status.
        for first in range(0, max(total, 1), MESSAGE_TICKS):
            piece = actions[:, first : first + MESSAGE_TICKS]
            memory.actions[:m, : piece.shape[1]] = piece
            self._ask("step", m, piece.shape[1])
            executed += memory.ticks[:m]
        solved_last = memory.solved_last[:m].copy()
        return Record(memory.obs[:m].copy(), memory.status[:m].copy(), executed, solved_last)

    def predict(self, actions: FloatArray, worlds: Index) -> FloatArray:
        """Look ahead without noise; see `LocalBatch.predict`."""
        m, ticks = actions.shape[:2]
        if ticks > MESSAGE_TICKS:
            raise UsageError(f"{ticks} ticks ahead: at most {MESSAGE_TICKS} over worker processes.")
        self._memory.worlds[:m] = worlds
        self._memory.actions[:m, :ticks] = actions
        self._ask("predict", m, ticks)
        return self._memory.obs[:m].copy()

    def push(self, change: StateArray, worlds: Index) -> None:
        """Change velocities; see `LocalBatch.push`."""
        m = len(worlds)
        self._memory.worlds[:m] = worlds
        self._memory.push[:m] = change
        self._ask("push", m, 0)

    def _ask(self, what: str, rows: int, ticks: int) -> None:
        answers = self._exchange([(what, rows, ticks)] * len(self._links))
        self.invalid_count = sum(answers)

    def _exchange(self, messages: list[Any]) -> list[int]:
        """Send one message to each worker and wait for all answers."""
        if not self.close.alive:
            raise StateError("these worlds are closed: make a new WorldBatch.")
        try:
            for link, message in zip(self._links, messages, strict=True):
                link.send(message)
            return [_answer(link) for link in self._links]
        except (EOFError, OSError) as error:
            self.close()
            raise StateError(
                "a worker process of the worlds ended unexpectedly; use fewer workers,"
                " and look for a lack of memory."
            ) from error
        except BaseException:
            # An answer may be under way; the pipes no longer tell which call it belongs to.
            self.close()
            raise


def _answer(link: Connection) -> int:
    answer = link.recv()
    if isinstance(answer, BaseException):
        raise answer
    return int(answer)


def _start(memory: int) -> tuple[Connection, subprocess.Popen[bytes]]:
    """A worker process that maps `memory`, and the pipe to it."""
    ours, theirs = socket.socketpair()
    with theirs:
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        try:
            process = subprocess.Popen(
                [sys.executable, "-c", _START, str(theirs.fileno()), str(memory)],
                pass_fds=(theirs.fileno(), memory),
                env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is the parent's business
            )
        except OSError as error:
            ours.close()
            raise StateError(f"cannot start a worker process: {error}.") from error
    return Connection(ours.detach()), process


def _end(links: list[Connection], processes: list[subprocess.Popen[bytes]]) -> None:
    """Close the pipes, which ends the workers; kill one that does not follow."""
    for link in links:
        link.close()
    for process in processes:
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def serve(link: int, memory: int) -> None:
    """The life of a worker process; arguments are inherited file descriptors."""
    with Connection(link) as parent:
        try:
            for answer in _answers(parent, memory):
                parent.send(answer)
        except (EOFError, OSError):
            return


def _answers(parent: Connection, memory: int) -> Iterator[int | BaseException]:
    try:
        scene, n, own, workers, engine = parent.recv()
        shared = _Memory(scene, n, memory)
        os.close(memory)
        batch = LocalBatch(scene, len(range(own, n, workers)), engine)
        yield 0
        while True:
            what, rows, ticks = parent.recv()
            mine = np.flatnonzero(shared.worlds[:rows] % workers == own)
            if len(mine):
                _serve_one(batch, shared, what, mine, ticks, own, workers)
            yield batch.invalid_count
    except (EOFError, OSError):
        raise
    except Exception as error:
        yield error


def _serve_one(
    batch: LocalBatch, shared: _Memory, what: str, mine: Index, ticks: int, own: int, workers: int
) -> None:
    """Answer for the rows `mine` of a request."""
    worlds = shared.worlds[mine]
    local = worlds // workers
    match what:
        case "reset":
            shared.obs[mine] = batch.reset(shared.seeds[mine], local)
        case "push":
            batch.push(shared.push[mine], local)
        case "predict":
            shared.obs[mine] = batch.predict(shared.actions[mine, :ticks], local)
        case "step":
            record = batch.step(shared.actions[mine, :ticks], local)
            shared.obs[mine] = record.obs
            shared.status[mine] = record.status
            shared.ticks[mine] = record.ticks
            shared.solved_last[mine] = record.solved_last
    shared.states[worlds] = batch.states[local]
