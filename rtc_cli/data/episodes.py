"""Episodes on disk: one folder of memory-mapped arrays, a manifest and checksums.

```
manifest.json      what the data are: schema, task, scene digest, seeds, counts, experts
observations.npy   (N, O) float32, before each action
actions.npy        (N, A) float32, physical, as the actor gave them (before the world's noise)
lengths.npy        (E,) int32   transitions per episode, in the order of the rows
episodes.npy       (E,) int64   number of the episode, which is its world's seed
status.npy         (E,) int8    how it ended: rtc_cli.tasks.scene.Status
expert.npy         (E,) int32   index into the manifest's expert_ids; -1: unknown
CHECKSUMS.json     SHA-256 of every file
```
"""

import json
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from rtc_cli.errors import StateError
from rtc_cli.files import verify_checksums

SCHEMA = 1
MANIFEST = "manifest.json"
WHAT = "episode data"


@dataclass(frozen=True)
class EpisodeStore:
    """Recorded episodes; arrays are read-only views of the files (see the module's table).

    `starts` (E,) int64 is the row of each episode's first transition.
    """

    folder: Path
    manifest: dict[str, Any]
    observations: np.ndarray
    actions: np.ndarray
    lengths: np.ndarray
    episodes: np.ndarray
    status: np.ndarray
    expert: np.ndarray
    starts: np.ndarray

    @property
    def transitions(self) -> int:
        """Count of rows, all of them valid."""
        return len(self.actions)

    @staticmethod
    def open(folder: Path | str, *, verify: bool = True) -> "EpisodeStore":
        """Open a folder that `collect` wrote; `verify` checks every byte first.

        StateError where it is missing, damaged, of another schema, or inconsistent.
        """
        folder = Path(folder)
        if verify:
            verify_checksums(folder, WHAT)
        manifest = _read_manifest(folder)
        rows, count = manifest["transitions"], manifest["episodes"]
        lengths = _load(folder, "lengths", (count,), np.int32)
        if int(lengths.sum()) != rows or (count and int(lengths.min()) < 1):
            raise _damaged(folder / "lengths.npy", f"its sum is not {rows} positive lengths")
        return EpisodeStore(
            folder=folder,
            manifest=manifest,
            observations=_load(folder, "observations", (rows, manifest["obs_dim"]), np.float32),
            actions=_load(folder, "actions", (rows, manifest["action_dim"]), np.float32),
            lengths=lengths,
            episodes=_load(folder, "episodes", (count,), np.int64),
            status=_load(folder, "status", (count,), np.int8),
            expert=_load(folder, "expert", (count,), np.int32),
            starts=np.cumsum(lengths, dtype=np.int64) - lengths,
        )

    def verify(self) -> None:
        """Check all checksums and that every number is finite; StateError names file and row."""
        verify_checksums(self.folder, WHAT)
        self.check_finite()

    def check_finite(self) -> None:
        """Raise StateError naming file, row and episode of the first NaN or infinity."""
        for name in ("observations", "actions"):
            bad = np.flatnonzero(~np.isfinite(getattr(self, name)).all(axis=1))
            if not len(bad):
                continue
            episode = int(np.searchsorted(self.starts, bad[0], side="right")) - 1
            raise StateError(
                f"{self.folder / name}.npy holds NaN or infinity in {len(bad)} of "
                f"{self.transitions} rows, the first in row {bad[0]} "
                f"(episode {int(self.episodes[episode])})",
                f"remove {self.folder} and run again: the data will be collected anew",
            )


class RowWriter:
    """Appends rows (n, columns) of float32 to a .npy file whose length is not known before."""

    def __init__(self, path: Path, columns: int) -> None:
        self._stream = path.open("wb")
        self._columns, self.rows = columns, 0
        self._write_header()

    def append(self, rows: np.ndarray) -> None:
        self._stream.write(np.ascontiguousarray(rows, "<f4").tobytes())
        self.rows += len(rows)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                # NumPy pads the header for a first axis of any length: it keeps its size.
                self._stream.seek(0)
                self._write_header()
        finally:
            self._stream.close()

    def _write_header(self) -> None:
        shape = (self.rows, self._columns)
        fields = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._stream, fields)


def _read_manifest(folder: Path) -> dict[str, Any]:
    file = folder / MANIFEST
    if not file.is_file():
        raise StateError(
            f"{folder} holds no {WHAT}: {MANIFEST} is missing", "check the path, or collect data"
        )
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _damaged(file, str(error)) from None
    found = manifest.get("schema") if isinstance(manifest, dict) else None
    if found != SCHEMA:
        raise StateError(
            f"{file} has schema {found!r}; {SCHEMA} is readable",
            f"remove {folder} and run again: the data will be collected anew",
        )
    return dict(manifest)


def _load(folder: Path, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    file = folder / f"{name}.npy"
    try:
        array: np.ndarray = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise _damaged(file, str(error)) from None
    if array.shape != shape or array.dtype != np.dtype(dtype):
        wanted = f"{shape} {np.dtype(dtype)}"
        raise _damaged(file, f"it holds {array.shape} {array.dtype}, the manifest says {wanted}")
    return array


def _damaged(file: Path, reason: str) -> StateError:
    return StateError(
        f"{WHAT} is damaged: {file}: {reason}",
        f"remove {file.parent} and run again: the data will be collected anew",
    )
