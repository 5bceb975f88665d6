"""Reading traces of latencies, what is refused, and drawing from them in blocks."""

import json

import latency_law
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtc_cli.errors import RtcError, StateError, UsageError
from rtc_cli.traces import (
    LatencyTrace,
    default_block,
    read_trace,
    resample_blocks,
    to_delays,
)
from rtc_cli.units import ROUNDINGS, latency_to_delay

MS = [90.0, 110.5, 95.25]


def trace_of(values) -> LatencyTrace:
    values = np.asarray(values, dtype=np.float64)
    return LatencyTrace(values, {"latency": values}, "synthetic", "ms")


def write(path, content):
    if path.suffix == ".parquet":
        pq.write_table(pa.table(content), path)
    elif path.suffix == ".json":
        path.write_text(json.dumps(content))
    else:
        path.write_text(content)
    return path


# -- what is read ----------------------------------------------------------------------------

SAME = [
    ("a.csv", "latency_ms\n90\n110.5\n95.25\n"),
    ("bom.csv", "\ufefflatency_ms\n90\n110.5\n95.25\n"),
    ("spaces.csv", "# robot\nlatency_ms\r\n 90 \r\n\r\n110.5\r\n95.25"),
    ("a.json", {"latency_ms": MS}),
    ("rows.json", [{"latency_ms": value} for value in MS]),
    ("a.parquet", {"latency_ms": MS}),
    ("seconds.csv", "latency_s\n0.09\n0.1105\n0.09525\n"),
]


@pytest.mark.parametrize(("name", "content"), SAME, ids=[name for name, _ in SAME])
def test_every_format_gives_the_same_trace(name, content, tmp_path):
    trace = read_trace(write(tmp_path / name, content))
    assert trace.total_ms == pytest.approx(MS)
    assert trace.total_ms.dtype == np.float64
    assert trace.unit == ("s" if "seconds" in name else "ms")
    assert name in trace.source
    assert trace.warnings == ()


@pytest.mark.parametrize(
    ("name", "content"),
    [("bare.csv", "90\n110.5\n95.25\n"), ("bare.txt", "90\n110.5\n95.25\n"), ("list.json", MS)],
)
def test_numbers_without_a_name_need_a_unit(name, content, tmp_path):
    path = write(tmp_path / name, content)
    with pytest.raises(UsageError, match="unit") as refused:
        read_trace(path)
    assert "--unit" in refused.value.hint
    assert read_trace(path, unit="ms").total_ms.tolist() == MS
    assert read_trace(path, unit="s").total_ms == pytest.approx(1000 * np.array(MS))


def test_components_add_up(tmp_path):
    path = write(tmp_path / "a.tsv", "t\tvision_ms\tnet_s\n0\t18\t0.01\n1\t20\t0.03\n")
    trace = read_trace(path, columns=["vision_ms", "net_s"], fixed_ms={"fixed": 2.5})
    assert trace.total_ms == pytest.approx([30.5, 52.5])
    assert list(trace.components_ms) == ["vision_ms", "net_s", "fixed"]
    assert sum(trace.components_ms.values()) == pytest.approx(trace.total_ms)
    assert trace.unit == "ms and s"
    assert "vision_ms + net_s" in trace.source
    assert "plus fixed 2.5 ms" in trace.source
    assert trace.after(1).total_ms == pytest.approx([52.5])


def test_columns_without_a_header_are_numbered(tmp_path):
    path = write(tmp_path / "a.csv", "1,90\n2,110\n")
    assert read_trace(path, columns=["2"], unit="ms").total_ms.tolist() == [90, 110]


@pytest.mark.parametrize(
    ("unit", "values", "said"),
    [
        ("ms", "0.09\n0.11\n", "seconds read as milliseconds"),
        ("s", "90\n110\n", "milliseconds read as seconds"),
        ("ms", "9e7\n1e8\n", "nanoseconds"),
    ],
)
def test_a_mistaken_unit_is_warned_of(unit, values, said, tmp_path):
    trace = read_trace(write(tmp_path / "a.csv", values), unit=unit)
    assert len(trace.warnings) == 1
    assert said in trace.warnings[0]


# -- profiles --------------------------------------------------------------------------------


def profile(*rows):
    keys = ("sampler", "batch", "flow_steps")
    filled = [dict(zip(keys, row, strict=True)) | {"samples_ms": MS} for row in rows]
    return {"schema": 1, "run": None, "machine": {"cpu": "X"}, "rows": filled}


def test_a_row_of_a_profile_is_a_trace(tmp_path):
    path = write(tmp_path / "p.json", profile(("plain", 1, 5), ("prefix", 1, 5)))
    trace = read_trace(path, sampler="prefix", fixed_ms={"camera": 60})
    assert trace.total_ms.tolist() == [150, 170.5, 155.25]
    assert (trace.kind, trace.machine) == ("profile", {"cpu": "X"})
    assert "sampler prefix" in trace.source
    one = write(tmp_path / "one.json", profile(("plain", 1, 5)))
    assert read_trace(one).total_ms.tolist() == MS


def test_what_a_profile_was_made_with_is_added_once(tmp_path):
    made = profile(("plain", 1, 5))
    made["rows"][0]["fixed_ms"] = {"vision": 18.0}
    path = write(tmp_path / "p.json", made)
    assert read_trace(path, fixed_ms={"net": 10.0}).total_ms == pytest.approx(np.array(MS) + 28)
    with pytest.raises(UsageError, match='"vision" is a part of it already'):
        read_trace(path, fixed_ms={"vision": 18.0})


def test_a_measured_cost_is_drawn_for_every_row(tmp_path):
    path = write(tmp_path / "a.csv", "a_ms\n" + "90\n" * 4000)
    network = tuple(float(value) for value in range(10))
    trace = read_trace(path, fixed_ms={"network": network})
    drawn = trace.total_ms - 90
    assert set(drawn) == set(network)
    assert drawn.mean() == pytest.approx(np.mean(network), abs=0.3)
    assert np.array_equal(drawn, read_trace(path, fixed_ms={"network": network}).total_ms - 90)
    assert "plus network 4.5 ms (median of 10)" in trace.source


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({}, "more than one sampler: plain, prefix"),
        ({"sampler": "prefx"}, 'no sampler "prefx".* Did you mean "prefix"'),
        ({"sampler": "prefix"}, "more than one batch: 1, 64"),
        ({"sampler": "prefix", "batch": 64}, "more than one flow-steps: 5, 10"),
        ({"sampler": "prefix", "batch": 2}, 'no batch "2"'),
        ({"sampler": "plain", "unit": "s"}, "samples are in ms"),
        ({"columns": ["latency_ms"]}, "has no columns"),
    ],
)
def test_an_ambiguous_profile_is_refused(asked, said, tmp_path):
    rows = [("plain", 1, 5), ("prefix", 1, 5), ("prefix", 64, 5), ("prefix", 64, 10)]
    path = write(tmp_path / "p.json", profile(*rows))
    with pytest.raises(UsageError, match=said):
        read_trace(path, **asked)


def test_a_profile_that_rtc_writes_is_read(tmp_path):
    from rtc_cli.analysis.profile import save_profile

    rows = profile(("plain", 1, 5))["rows"]
    save_profile(tmp_path / "profile.json", rows, {"cpu": "X"})
    assert read_trace(tmp_path / "profile.json").total_ms.tolist() == MS


# -- what is refused -------------------------------------------------------------------------

BAD = [
    ("a.csv", None, {}, StateError, ["a.csv", "does not exist"]),
    ("a.csv", "", {}, StateError, ["holds no latency"]),
    ("a.csv", "latency_ms\n", {}, StateError, ["holds no latency"]),
    ("a.csv", "latency_ms\n90\n", {}, StateError, ["holds one latency"]),
    ("a.csv", "latency_ms\n90\n-1\n", {}, StateError, ["row 2", "latency_ms", "-1 is negative"]),
    ("a.csv", "latency_ms\n90\nnan\n", {}, StateError, ["row 2", "latency_ms", "nan is not fin"]),
    ("a.csv", "latency_ms\ninf\n90\n", {}, StateError, ["row 1", "inf is not finite"]),
    ("a.csv", "latency_ms\n90\nslow\n", {}, StateError, ["row 2", '"slow" is no number']),
    ("a.csv", "t,a_ms\n0,1\n1\n", {"columns": ["a_ms"]}, StateError, ["row 2", "no value"]),
    ("a.csv", "a_ms,a_ms\n0,1\n1,2\n", {}, StateError, ['two columns are called "a_ms"']),
    ("a.csv", "a_ms\n1\n2\n", {"columns": ["b_ms"]}, UsageError, ['no column "b_ms"', '"a_ms"']),
    ("a.csv", "a_ms,b_ms\n1,2\n2,3\n", {}, UsageError, ["2 columns: a_ms, b_ms", "--column"]),
    ("a.csv", "a_ms\n1\n2\n", {"unit": "s"}, UsageError, ["a_ms", "says ms", "given is s"]),
    ("a.csv", "a_ms\n1\n2\n", {"fixed_ms": {"net": -1.0}}, UsageError, ["net is -1.0 ms"]),
    ("a.csv", "a_ms\n1\n2\n", {"sampler": "plain"}, UsageError, ["is a trace", "--column"]),
    ("a.csv", b"a_ms\n\xff\n", {}, StateError, ["byte 5", "UTF-8"]),
    ("a.xyz", "a_ms\n1\n2\n", {}, UsageError, ['".xyz"', ".parquet"]),
    ("a.json", b"[1, ", {}, StateError, ["broken JSON", "line 1"]),
    ("a.json", b"[]", {}, StateError, ["holds no latency"]),
    ("a.json", b"3", {}, StateError, ["is no trace"]),
    ("a.json", b'[1, NaN, "x"]', {"unit": "ms"}, StateError, ["row 2", "nan is not finite"]),
    ("a.json", b"[1, null]", {"unit": "ms"}, StateError, ["row 2", "no value"]),
    ("a.json", b"[1, true]", {"unit": "ms"}, StateError, ["row 2", "true is no number"]),
    ("a.json", b'{"a_ms": [1, 2], "b_ms": [1]}', {"columns": ["b_ms"]}, StateError, ["row 2"]),
    ("a.parquet", b"PAR1", {}, StateError, ["no parquet file"]),
]


@pytest.mark.parametrize(
    ("name", "content", "asked", "kind", "words"), BAD, ids=[f"{i}" for i in range(len(BAD))]
)
def test_bad_input_names_file_row_and_column(name, content, asked, kind, words, tmp_path):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        path.write_text(content)
    with pytest.raises(kind) as refused:
        read_trace(path, **asked)
    said = f"{refused.value.message} ({refused.value.hint})"
    assert "\n" not in said
    assert all(word in said for word in words), said


def test_parquet_of_text_is_refused(tmp_path):
    path = write(tmp_path / "a.parquet", {"a_ms": ["x", "y"]})
    with pytest.raises(RtcError, match='row 1, column "a_ms": "x" is no number'):
        read_trace(path)


# -- delays ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rounding", ROUNDINGS)
def test_delays_are_those_of_single_latencies(rounding):
    values = np.concatenate([np.random.default_rng(0).uniform(0, 400, 300), np.arange(0, 400, 10)])
    expected = [latency_to_delay(value, 50, rounding) for value in values]
    assert to_delays(values, 50, rounding).tolist() == expected
    assert to_delays(values[:300].reshape(3, 100), 50, rounding).shape == (3, 100)
    assert to_delays([], 50, rounding).size == 0


def test_a_rate_of_zero_is_refused():
    with pytest.raises(UsageError, match="0 Hz"):
        trace_of(MS).delays(0)


# -- drawing ---------------------------------------------------------------------------------


def test_a_draw_is_a_function_of_the_seed():
    trace = trace_of(np.arange(100.0))
    first, again, other = (
        resample_blocks(trace, 500, np.random.default_rng(seed), 8) for seed in (1, 1, 2)
    )
    assert first.tolist() == again.tolist() != other.tolist()
    shorter = resample_blocks(trace, 1, np.random.default_rng(1), 8)
    assert shorter.shape == (1,)
    assert resample_blocks(trace, 0, np.random.default_rng(1), 8).size == 0


def test_blocks_follow_the_trace_and_have_the_mean_length():
    """Within a block row i + 1 follows row i, the first row follows the last."""
    trace = trace_of(np.arange(1000.0))
    drawn = resample_blocks(trace, 50_000, np.random.default_rng(0), 10)
    follows = (np.diff(drawn) % 1000) == 1
    assert follows.mean() == pytest.approx(0.9, abs=0.01)
    assert drawn.mean() == pytest.approx(499.5, rel=0.03)
    independent = resample_blocks(trace, 50_000, np.random.default_rng(0), 1)
    assert ((np.diff(independent) % 1000) == 1).mean() < 0.01


def test_bursts_stay_and_shares_too():
    """A slow chunk follows a slow one in 60% of cases; single rows would make it 2%."""
    values = latency_law.draw(0, 20_000, stay=0.6)
    trace = trace_of(values)
    drawn = resample_blocks(trace, 40_000, np.random.default_rng(0))
    slow = drawn > 180
    assert slow.mean() == pytest.approx((values > 180).mean(), rel=0.15)
    again = slow[1:][slow[:-1]].mean()
    known = (values[1:] > 180)[values[:-1] > 180].mean()
    assert again == pytest.approx(known, abs=0.08)
    single = resample_blocks(trace, 40_000, np.random.default_rng(0), 1) > 180
    assert single[1:][single[:-1]].mean() < 0.05


def test_the_default_block_is_short_without_bursts():
    assert default_block(trace_of(latency_law.draw(0))) < 4
    assert default_block(trace_of(latency_law.draw(0, stay=0.6))) > 5
    assert default_block(trace_of(latency_law.draw(0, correlation=0.8))) > 10
    assert default_block(trace_of([50.0, 50.0])) == 1


@pytest.mark.parametrize("block", [0, 0.5, float("nan")])
def test_a_block_below_one_row_is_refused(block):
    with pytest.raises(UsageError, match="block length"):
        resample_blocks(trace_of(MS), 5, np.random.default_rng(0), block)
