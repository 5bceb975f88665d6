"""The store of episode rows: keys, labels, whole files, damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtc_cli.errors import StateError
from rtc_cli.results import (
    EPISODE_COLUMNS,
    EPISODE_SCHEMA,
    ResultStore,
    cell_key,
    machine_record,
    relabel,
)

CONTENT: dict[str, Any] = {
    "policy": "p0",
    "task": "catcher",
    "scene": "s0",
    "sampler": "pinv",
    "settings": {"mask": "exp", "prior_std": 1.0},
    "horizon": 8,
    "exec_horizon": 2,
    "delay": 2,
    "schedule": "async",
    "hold": "last",
    "flow_steps": 5,
    "eval_seed": 0,
    "first_episode": 0,
    "episodes": 4,
    "reaction_episodes": 2,
    "reaction": {"push_m_s": 1.0},
    "tile": 32,
    "timing": {"delay_model": "uniform:0-4"},
}


def rows(count: int = 4, **labels: Any) -> pd.DataFrame:
    values: dict[str, Any] = {}
    for name, (kind, _, nullable) in EPISODE_COLUMNS.items():
        if str(kind) == "string":
            values[name] = "x"
        elif str(kind) == "double":
            values[name] = [np.nan if nullable and i == 1 else 0.5 * i for i in range(count)]
        else:
            values[name] = np.arange(count) % 2 == 1 if str(kind) == "bool" else np.arange(count)
    frame = pd.DataFrame(values)
    given = {"method": "naive", "protocol": "fixed:4", "train_seed": 0, "policy": "p0"} | labels
    return relabel(frame, **given)


@pytest.mark.parametrize("name", [name for name in CONTENT if name != "hold"])
def test_every_part_of_a_cell_is_in_its_key(name: str) -> None:
    value = CONTENT[name]
    other = {"mask": "ones"} if isinstance(value, dict) else "sync" if value == "async" else None
    other = other or (value + 1 if isinstance(value, int) else value + "x")
    assert cell_key(**CONTENT | {name: other}) != cell_key(**CONTENT)


def test_cells_of_constant_delays_keep_the_key_of_earlier_versions() -> None:
    """Computed by the version before there were other delays."""
    content = {name: value for name, value in CONTENT.items() if name != "timing"}
    assert cell_key(**content) == cell_key(**content, timing=None) == "1464913133ba62332461"


def test_key_ignores_what_does_not_matter() -> None:
    assert cell_key(**CONTENT) == cell_key(**CONTENT | {"hold": "zero"})
    reordered = dict(reversed(CONTENT["settings"].items()))
    assert cell_key(**CONTENT) == cell_key(**CONTENT | {"settings": reordered})
    unpushed = CONTENT | {"reaction_episodes": 0}
    assert cell_key(**unpushed) == cell_key(**unpushed | {"reaction": {"push_m_s": 9.0}})
    sync = CONTENT | {"schedule": "sync"}
    assert cell_key(**sync) != cell_key(**sync | {"hold": "zero"})
    assert len(cell_key(**CONTENT)) == 20


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    store = ResultStore(tmp_path / "episodes")
    assert not store.has("k1")
    assert store.find("k1") is None
    assert len(store.load()) == 0
    assert list(store.load().columns) == list(EPISODE_COLUMNS)
    path = store.append("k1", rows())
    assert path.name == "k1.naive.fixed%3a4.seed-0.parquet"
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    loaded = store.load()
    pd.testing.assert_frame_equal(loaded, rows().assign(cell="k1"), check_dtype=False)
    assert loaded.seam_gap.isna().tolist() == [False, True, False, False]
    assert loaded.solved.dtype == bool


def test_one_content_under_two_labels(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    store.append("k1", rows())
    assert store.has("k1", method="naive", protocol="fixed:4")
    assert not store.has("k1", method="base+plain", protocol="fixed:4")
    assert not store.has("k1", method="naive", protocol="paper")
    found = store.find("k1")
    assert found is not None
    store.append("k1", found.assign(protocol="paper"))
    assert store.has("k1", method="naive", protocol="paper")
    assert store.load().groupby("protocol").size().to_dict() == {"fixed:4": 4, "paper": 4}


def test_files_are_reproducible(tmp_path: Path) -> None:
    first = ResultStore(tmp_path / "a").append("k1", rows()).read_bytes()
    assert ResultStore(tmp_path / "b").append("k1", rows()).read_bytes() == first


SINCE_4 = ("solved_last_substep",)
SINCE_3 = (
    *("delay_model", "estimator", "on_late", "on_exceed", "observation_lag"),
    *("dropped_chunks", "clipped_requests", "exceeded_requests"),
    *SINCE_4,
)


def write_older(path: Path, frame: pd.DataFrame, version: int) -> None:
    new = SINCE_3 if version == 3 else SINCE_4
    fields = [field for field in EPISODE_SCHEMA if field.name not in new]
    schema = pa.schema(fields, metadata={"rtc_schema": str(version)})
    table = pa.Table.from_pandas(frame.drop(columns=list(new)), schema, preserve_index=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, write_page_checksum=True)


def test_rows_of_version_3_are_completed(tmp_path: Path) -> None:
    given = rows().assign(
        cell="k1", delay=3, exec_horizon=4, length=[1, 4, 5, 9], beyond_trained=[True, False] * 2
    )
    write_older(tmp_path / "k1.naive.paper.seed-0.parquet", given, 3)
    loaded = ResultStore(tmp_path).load()
    expected = given.assign(
        delay_model="constant:3", estimator="exact", on_late="play", on_exceed="play",
        observation_lag=0, dropped_chunks=0, clipped_requests=0, exceeded_requests=[1, 0, 2, 0],
        solved_last_substep=None,
    )  # fmt: skip
    pd.testing.assert_frame_equal(loaded, expected, check_dtype=False)
    # Together with rows of this version, and written again as such.
    ResultStore(tmp_path).append("k2", loaded)
    assert len(ResultStore(tmp_path).load()) == 8


def test_rows_of_version_4_are_completed(tmp_path: Path) -> None:
    given = rows().assign(cell="k1")
    write_older(tmp_path / "k1.naive.paper.seed-0.parquet", given, 4)
    loaded = ResultStore(tmp_path).load()
    expected = given.assign(solved_last_substep=None)
    pd.testing.assert_frame_equal(loaded, expected, check_dtype=False)


@pytest.mark.parametrize("version", [3, 4])
def test_incomplete_rows_of_older_versions_are_damage(tmp_path: Path, version: int) -> None:
    path = tmp_path / "k1.naive.paper.seed-0.parquet"
    write_older(path, rows().assign(cell="k1"), version)
    table = pq.read_table(path)
    pq.write_table(table.drop_columns(["delay"]), path, write_page_checksum=True)
    with pytest.raises(StateError, match=f"lack columns of schema {version}"):
        ResultStore(tmp_path).load()


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text", "pickle"])
def test_a_damaged_file_is_named(tmp_path: Path, damage: str) -> None:
    store = ResultStore(tmp_path)
    path = store.append("k1", rows(400))
    data = path.read_bytes()
    flipped = bytearray(data)
    flipped[-5] ^= 0xFF
    path.write_bytes(
        {
            "truncate": data[:-100],
            "flip": bytes(flipped),
            "empty": b"",
            "text": b"method,success\nnaive,1\n",
            "pickle": b"\x80\x04N.",
        }[damage]
    )
    with pytest.raises(StateError, match=path.name):
        store.load()


def test_a_flipped_byte_never_changes_a_row_unnoticed(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    path = store.append("k1", rows(400))
    data, original = path.read_bytes(), store.load()
    found = 0
    for position in range(0, len(data), len(data) // 150):
        flipped = bytearray(data)
        flipped[position] ^= 0x10
        path.write_bytes(bytes(flipped))
        try:
            pd.testing.assert_frame_equal(store.load(), original)
        except StateError:
            found += 1
    assert found > 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.drop(columns="delay"), r"missing columns \['delay'\]"),
        (lambda r: r.assign(extra=1), r"unknown columns \['extra'\]"),
        (lambda r: r.assign(delay="two"), "do not match their schema"),
        (lambda r: r.assign(task=None), "task: string not null.*had 4 null values"),
        (lambda r: r.assign(method=["a", "b", "a", "b"]), "2 different labels"),
    ],
)
def test_rows_must_match_the_schema(tmp_path: Path, change: Any, message: str) -> None:
    with pytest.raises(StateError, match=message):
        ResultStore(tmp_path).append("k1", change(rows()))
    assert list(tmp_path.iterdir()) == []


def test_every_column_has_a_unit_in_the_file(tmp_path: Path) -> None:
    assert all(b"unit" in field.metadata for field in EPISODE_SCHEMA)


def test_machine_record() -> None:
    record = machine_record()
    assert record["cores"] >= 1
    libraries = {"jax", "numpy", "numba", "pymunk"}
    assert set(record) == {"cpu", "cores", "platform", "python", *libraries}
