"""`rtc latency`: its JSON, its page, its words, and one line for bad input."""

import csv
import json
import re
import tomllib

import latency_law
import numpy as np
import pytest

import rtc_cli.cli.app as program


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("RTC_DEBUG", raising=False)


@pytest.fixture
def trace(tmp_path):
    values = latency_law.draw(3, 1000, warm_up=12, drift=0.2, stay=0.5)
    path = tmp_path / "robot.csv"
    path.write_text("latency_ms\n" + "\n".join(f"{value:.3f}" for value in values) + "\n")
    return path


def json_of(args, capsys):
    assert program.run(["latency", *map(str, args), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_json(trace, capsys):
    found = json_of([trace, "--hz", 40], capsys)
    assert found["schema"] == 1
    assert found["run"] is None
    assert [row["percentile"] for row in found["rows"]] == [0.5, 0.9, 0.95, 0.99, 1.0]
    assert (found["hz"], found["rounding"]) == (40.0, "ceil")
    assert found["warm_up"]["rows"] > 0
    assert found["drift"]["found"]
    assert len(found["samples_ms"]) == found["trace"]["rows"] == 1000
    kept = 1000 - found["warm_up"]["rows"]
    assert sum(row["count"] for row in found["delays"]) == kept
    assert sum(row["share"] for row in found["delays"]) == pytest.approx(1)
    assert tomllib.loads(found["recipe"])["horizon"] == found["recommendation"]["horizon"]
    assert any("warm-up" in sentence for sentence in found["findings"])
    for row in found["rows"][:3]:
        assert row["low_ms"] < row["latency_ms"] < row["high_ms"]
        assert row["delay"] == int(np.ceil(row["latency_ms"] * 40 / 1000))


def test_tables_for_people(trace, capsys):
    assert program.run(["latency", str(trace), "--horizon", "8"]) == 0
    shown = capsys.readouterr().out
    for words in ("warm-up", "p99", "d at 50 Hz, ceil", "H = 8 cannot hold", "max-of-last:10"):
        assert words in shown, words
    snippet = shown.split("Keys for a recipe:\n")[1]
    assert tomllib.loads(snippet)["train"]["delays"]["kind"] == "weights"


def test_the_page(trace, capsys, tmp_path):
    found = json_of([trace, "--save", "page"], capsys)
    folder = tmp_path / "page"
    assert (found.pop("page"), found.pop("markdown")) == ("page/index.html", "page/report.md")
    html = (folder / "index.html").read_text()
    assert not re.search(r'(src|href)="(?!#|data:)', html)
    assert html.count("<svg") == 4
    markdown = (folder / "report.md").read_text()
    for name in ("trace", "distribution", "delays", "autocorrelation"):
        assert (folder / f"figures/{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"figures/{name}.png" in markdown
    assert json.loads((folder / "rows.json").read_text()) == found
    with open(folder / "tables/percentiles.csv") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[0]["latency_ms"]) == pytest.approx(found["rows"][0]["latency_ms"], abs=1e-4)
    plan = found["recommendation"]
    assert f"s = {plan['exec_horizon']}" in markdown
    assert found["recipe"].strip() in markdown


ODD = [
    ("few.csv", "latency_ms\n90\n110\n", ["--save", "page"]),
    ("zero.csv", "latency_ms\n" + "0\n" * 30, ["--save", "page"]),
    ("compiled.csv", "latency_ms\n30000\n" + "90\n95\n100\n" * 100, ["--save", "page"]),
    ("long.csv", "latency_ms\n" + "90\n95\n200\n" * 1500, ["--horizon", "1"]),
    ("equal.csv", "latency_ms\n" + "40\n" * 300, ["--rounding", "floor"]),
    ("huge.csv", "latency_s\n" + "9e7\n95\n100\n" * 10, ["--save", "page"]),
    ("parts.csv", "a_ms,b_ms\n" + "90,10\n95,20\n" * 20, ["--column", "a_ms", "--column", "b_ms"]),
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("name", "content", "more"), ODD, ids=[odd[0] for odd in ODD])
def test_odd_traces(name, content, more, tmp_path, capsys):
    (tmp_path / name).write_text(content)
    assert program.run(["latency", name, *more]) == 0
    assert "nan" not in capsys.readouterr().out
    if "--save" in more:
        assert "nan" not in (tmp_path / "page/report.md").read_text()


def test_a_profile_with_what_is_around_it(tmp_path, capsys):
    samples = np.random.default_rng(0).uniform(13, 15, 50).tolist()
    rows = [{"sampler": name, "batch": 1, "samples_ms": samples} for name in ("plain", "prefix")]
    (tmp_path / "profile.json").write_text(json.dumps({"schema": 1, "rows": rows}))
    found = json_of(["profile.json", "--sampler", "prefix", "--fixed-ms", 62], capsys)
    assert found["rows"][0]["latency_ms"] == pytest.approx(76, abs=1)
    assert found["recommendation"]["delay"] == 4
    assert any("one by one" in sentence for sentence in found["findings"])


def test_seconds_read_as_milliseconds_are_warned_of(tmp_path, capsys):
    (tmp_path / "t.csv").write_text("0.09\n0.1\n0.11\n")
    found = json_of(["t.csv", "--unit", "ms"], capsys)
    assert "seconds read as milliseconds" in found["findings"][0]
    assert program.run(["latency", "t.csv", "--unit", "ms"]) == 0
    assert "--unit s" in capsys.readouterr().out


BAD = [
    (["missing.csv"], 3, ["missing.csv", "does not exist"]),
    (["robot.csv", "--hz", "0"], 2, ["--hz", "0"]),
    (["robot.csv", "--hz", "nan"], 2, ["--hz", "nan"]),
    (["robot.csv", "--column", "latency"], 2, ['"latency"', 'mean "latency_ms"']),
    (["robot.csv", "--unit", "s"], 2, ["latency_ms", "says ms"]),
    (["robot.csv", "--unit", "h"], 2, ["--unit", "h"]),
    (["robot.csv", "--rounding", "up"], 2, ["--rounding", "up"]),
    (["robot.csv", "--fixed-ms", "-1"], 2, ['fixed cost "-1"', ">= 0"]),
    (["robot.csv", "--horizon", "0"], 2, ["--horizon", "0"]),
    (["robot.csv", "--percentile", "99"], 2, ["--percentile", "99"]),
    (["robot.csv", "--sampler", "pinv"], 2, ["is a trace", "--column"]),
    (["robot.csv", "--save", "robot.csv"], 3, ["robot.csv"]),
]


@pytest.mark.parametrize(("args", "code", "words"), BAD, ids=[" ".join(b[0]) for b in BAD])
def test_bad_input_is_one_line(args, code, words, trace, capsys):
    assert program.run(["latency", *args]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert all(word in lines[0] for word in words), lines[0]
