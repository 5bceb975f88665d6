"""Results on disk: the schema of an episode's row, the key of a cell, the store, the machine.

One cell is one (checkpoint, task, sampler and settings, geometry, schedule, seeds) with all its
episodes; it is one parquet file that appears whole or not at all. Its key is a hash of its
content, so a cell that is present is never computed again, under whatever name it is shown.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from rtc_cli.errors import StateError
from rtc_cli.files import os_error, write_bytes

SCHEMA_VERSION = 5

# Part of every key. It stays where new columns have values that follow from the old ones.
_KEY_VERSION = 3

_TEXT, _INT, _FLOAT, _BOOL = pa.string(), pa.int64(), pa.float64(), pa.bool_()

# name: (type, unit, may be null)
EPISODE_COLUMNS: dict[str, tuple[pa.DataType, str, bool]] = {
    "task": (_TEXT, "", False),
    "method": (_TEXT, "", False),
    "checkpoint": (_TEXT, "", False),
    "sampler": (_TEXT, "", False),
    "settings": (_TEXT, "JSON", False),
    "schedule": (_TEXT, "", False),
    "train_seed": (_INT, "", False),
    "protocol": (_TEXT, "", False),
    "delay": (_INT, "control steps", False),
    "exec_horizon": (_INT, "control steps", False),
    "flow_steps": (_INT, "", False),
    "action_noise": (_FLOAT, "action", False),
    "delay_model": (_TEXT, "", False),
    "estimator": (_TEXT, "", False),
    "on_late": (_TEXT, "", False),
    "on_exceed": (_TEXT, "", False),
    "observation_lag": (_INT, "control steps", False),
    "episode": (_INT, "", False),
    "status": (_INT, "1 solved, 2 failed, 3 timeout, 4 invalid", False),
    "solved": (_BOOL, "", False),
    "solved_last_substep": (_BOOL, "", True),
    "length": (_INT, "control steps", False),
    "time_to_success_s": (_FLOAT, "s", True),
    "throughput_per_min": (_FLOAT, "1/min", False),
    "seam_jump": (_FLOAT, "1", True),
    "seam_gap": (_FLOAT, "normalised action", True),
    "prefix_error": (_FLOAT, "normalised action", True),
    "action_delta": (_FLOAT, "normalised action", True),
    "action_delta2": (_FLOAT, "normalised action", True),
    "starved_ticks": (_INT, "control steps", False),
    "late_chunks": (_INT, "chunks", False),
    "dropped_chunks": (_INT, "chunks", False),
    "clipped_requests": (_INT, "requests", False),
    "exceeded_requests": (_INT, "requests", False),
    "waiting_ticks": (_INT, "control steps", False),
    "reaction_ticks": (_FLOAT, "control steps", True),
    "measured_reaction_ticks": (_FLOAT, "control steps", True),
    "beyond_trained": (_BOOL, "", False),
    "cell": (_TEXT, "", False),
    "policy": (_TEXT, "digest", False),
    "scene": (_TEXT, "digest", False),
}

EPISODE_SCHEMA = pa.schema(
    [
        pa.field(name, kind, nullable, metadata={"unit": unit})
        for name, (kind, unit, nullable) in EPISODE_COLUMNS.items()
    ],
    metadata={"rtc_schema": str(SCHEMA_VERSION)},
)


def cell_key(
    *,
    policy: str,
    task: str,
    scene: str,
    sampler: str,
    settings: Mapping[str, Any],
    horizon: int,
    exec_horizon: int,
    delay: int,
    schedule: str,
    hold: str,
    flow_steps: int,
    eval_seed: int,
    first_episode: int,
    episodes: int,
    reaction_episodes: int,
    reaction: Mapping[str, float],
    tile: int,
    timing: Mapping[str, Any] | None = None,
) -> str:
    """Key (20 hex digits) of a cell's content: equal keys mean equal rows but for their labels.

    Args:
        policy: digest of the checkpoint.
        scene: digest of the scene with the noise that it is evaluated with.
        settings: all settings of the sampler, defaults included (``Sampler.settings``).
        hold: what ``sync`` executes while it waits; it has no part in other cells.
        reaction_episodes: how many of the episodes run once more, with a push.
        reaction: what a measured reaction is (``rtc_cli.execution.reaction.definition``); it has
            no part in cells without such episodes.
        tile: the rows of one inference; XLA's last bits depend on it.
        timing: delays that vary, and what is done about them; None is the one delay, always.
    """
    content = dict(locals()) | {"settings": dict(settings), "schema": _KEY_VERSION}
    if timing is None:
        del content["timing"]
    else:
        content["timing"] = dict(timing)
    if reaction_episodes:
        content["reaction"] = dict(reaction)
    else:
        del content["reaction"]
    if schedule != "sync":
        content["hold"] = ""
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


class ResultStore:
    """The episodes of a run: ``<folder>/<key>.<method>.<protocol>.seed-<k>.parquet``.

    Safe for several processes: files are written whole, and a file of the same name has the same
    content. The same content under two labels (``naive`` and ``base+plain``; d = s = 4 under
    ``paper`` and ``fixed:4``) is computed once: look it up with ``find`` and append it again.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    def has(self, key: str, *, method: str | None = None, protocol: str | None = None) -> bool:
        """Whether a cell is present, under these labels if they are given."""
        return bool(self._files(key, method, protocol))

    def find(
        self, key: str, *, method: str | None = None, protocol: str | None = None
    ) -> pd.DataFrame | None:
        """The rows of a cell, whatever it is labelled if no labels are given; None if absent."""
        files = self._files(key, method, protocol)
        return _read(files[0]) if files else None

    def append(self, key: str, rows: pd.DataFrame) -> Path:
        """Write the rows of one cell; their labels decide the file's name.

        Raises:
            StateError: the rows do not match the schema, or the file cannot be written.
        """
        rows = rows.assign(cell=key)
        table = _to_table(rows)
        labels = rows[["method", "protocol", "train_seed"]].drop_duplicates()
        if len(labels) != 1:
            raise StateError(f"cell {key}: {len(labels)} different labels in the rows of one cell")
        method, protocol, train_seed = labels.iloc[0]
        path = self.folder / f"{key}.{_slug(method)}.{_slug(protocol)}.seed-{train_seed}.parquet"
        buffer = io.BytesIO()
        pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
        write_bytes(path, buffer.getvalue())
        return path

    def load(self) -> pd.DataFrame:
        """All rows of all cells, in the schema's column order, sorted by file name.

        Raises:
            StateError: a file is damaged; it is named.
        """
        frames = [_read(path) for path in self._files("*", None, None)]
        if not frames:
            return EPISODE_SCHEMA.empty_table().to_pandas()
        return pd.concat(frames, ignore_index=True)

    def _files(self, key: str, method: str | None, protocol: str | None) -> list[Path]:
        middle = ".".join("*" if label is None else _slug(label) for label in (method, protocol))
        try:
            return sorted(self.folder.glob(f"{key}.{middle}.seed-*.parquet"))
        except OSError as error:
            raise os_error(error, self.folder) from error


def relabel(
    rows: pd.DataFrame,
    *,
    method: str,
    protocol: str,
    train_seed: int,
    policy: str,
) -> pd.DataFrame:
    """Rows of a cell with the labels that only the caller of ``evaluate_cell`` knows."""
    return rows.assign(method=method, protocol=protocol, train_seed=train_seed, policy=policy)


def _slug(label: str) -> str:
    """A label as part of a file name; different labels stay different."""
    return re.sub(r"[^A-Za-z0-9+_-]", lambda match: f"%{ord(match.group()):02x}", str(label))


def _to_table(rows: pd.DataFrame) -> pa.Table:
    missing = [name for name in EPISODE_COLUMNS if name not in rows]
    unknown = [name for name in rows if name not in EPISODE_COLUMNS]
    if missing or unknown:
        raise StateError(f"episode rows: missing columns {missing}, unknown columns {unknown}")
    try:
        table = pa.Table.from_pandas(
            rows[list(EPISODE_COLUMNS)], schema=EPISODE_SCHEMA, preserve_index=False
        )
    except (ValueError, pa.ArrowException) as error:
        raise StateError(f"episode rows do not match their schema: {error}") from error
    # Only the schema's own metadata: pandas would add its version, and bytes would differ.
    return table.replace_schema_metadata(EPISODE_SCHEMA.metadata)


def _read(path: Path) -> pd.DataFrame:
    hint = "remove the file and evaluate again: only this cell is computed anew"
    try:
        data = io.BytesIO(path.read_bytes())
        table = pq.ParquetFile(data, page_checksum_verification=True).read()
    except OSError as error:
        if error.errno is not None:
            raise os_error(error, path) from error
        raise StateError(f"results are damaged: {path} cannot be read", hint) from error
    except (ValueError, pa.ArrowException) as error:
        raise StateError(f"results are damaged: {path} cannot be read", hint) from error
    version = (table.schema.metadata or {}).get(b"rtc_schema", b"none").decode()
    if version in _SINCE:
        return _completed(table.to_pandas(), version, path, hint)
    if version != str(SCHEMA_VERSION) or table.schema.names != list(EPISODE_COLUMNS):
        raise StateError(
            f"results {path} have schema {version}, this version reads {SCHEMA_VERSION}", hint
        )
    return table.to_pandas()


_SINCE_4 = ("solved_last_substep",)
_SINCE_3 = (
    "delay_model",
    "estimator",
    "on_late",
    "on_exceed",
    "observation_lag",
    "dropped_chunks",
    "clipped_requests",
    "exceeded_requests",
)
# Older version that is read: the columns that it lacks.
_SINCE = {"3": (*_SINCE_3, *_SINCE_4), "4": _SINCE_4}


def _completed(rows: pd.DataFrame, version: str, path: Path, hint: str) -> pd.DataFrame:
    """Fill in what an older version did not say.

    In version 3 delays were constant, and known to everybody; up to version 4 no task had a second
    rule of what is solved.
    """
    if list(rows.columns) != [name for name in EPISODE_COLUMNS if name not in _SINCE[version]]:
        raise StateError(f"results {path} lack columns of schema {version}", hint)
    rows = rows.assign(solved_last_substep=None)
    if version == "3":
        requests = -(-rows["length"] // rows["exec_horizon"])
        rows = rows.assign(
            delay_model="constant:" + rows["delay"].astype(str),
            estimator="exact",
            on_late="play",
            on_exceed="play",
            observation_lag=0,
            dropped_chunks=0,
            clipped_requests=0,
            exceeded_requests=requests.where(rows["beyond_trained"], 0),
        )
    return rows[list(EPISODE_COLUMNS)]


@cache
def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine_record() -> dict[str, Any]:
    """What results were computed on; imports nothing heavy.

    ``cores`` counts the cores that this process may use.
    """
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _cpu_name(),
        "cores": usable,
        "platform": platform.platform(terse=True),
        "python": platform.python_version(),
        "jax": _version("jax"),
        "numpy": _version("numpy"),
        "pymunk": _version("pymunk"),
        "numba": _version("numba"),
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
