"""`rtc latency --run`: a run's policies under a trace, at what its analysis advises."""

import json
import shlex

import latency_law
import numpy as np
import pytest
from jobs_here import run_jobs_here
from untrained_runs import untrained_run

import rtc_cli.cli.app as program
from rtc_cli.results import ResultStore
from rtc_cli.traces import read_trace

TASK = "cartpole_thrust"
ALL = ("all", "all")
OVERRIDES = [
    f"tasks={TASK}",
    "eval.episodes=6",
    "eval.flow_steps=1",
    "eval.methods=naive,prefix",
    "eval.delays=0",
]


@pytest.fixture
def jobs(monkeypatch):
    return run_jobs_here(monkeypatch)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an untrained run and a trace: 36 ms at 50 Hz, slow chunks in bursts."""
    folder = tmp_path_factory.mktemp("latency")
    untrained_run(folder / "run", "quickstart", OVERRIDES, ["base", "prefix"])
    values = 0.4 * latency_law.draw(7, 600, warm_up=12, stay=0.5)
    text = "latency_ms\n" + "\n".join(f"{value:.1f}" for value in values) + "\n"
    for name in ("robot (1).csv", "again.csv"):
        (folder / name).write_text(text)
    return folder


@pytest.fixture(autouse=True)
def _here(folder, monkeypatch):
    monkeypatch.chdir(folder)


def json_of(args, capsys):
    assert program.run([*args, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def stored(folder):
    return ResultStore(folder / "run/results/episodes").load()


def test_the_advice_is_what_is_evaluated(folder, jobs, capsys):
    found = json_of(["latency", "robot (1).csv", "--run", "run", "--save", "page"], capsys)
    rows, plan = stored(folder), found["recommendation"]
    assert found["run"] == "run"
    assert plan["delay_cond"] == 3  # 44 ms at 50 Hz
    assert set(rows.delay_model) == {found["evaluated"]["delay_model"]}
    assert set(rows.estimator) == {"constant:3"}
    assert set(rows.exec_horizon) == {plan["exec_horizon"]} == {4}
    assert set(rows.method) == {"naive", "prefix"}
    pooled = [row for row in found["evaluation"] if (row["task"], row["train_seed"]) == ALL]
    for row in pooled:
        mine = rows[rows.method == row["method"].split(" (")[0]]
        assert row["episodes"] == len(mine) == 6
        assert row["success"] == mine.solved.mean()
        for name in ("late_chunks", "starved_ticks", "exceeded_requests"):
            assert row[name] == pytest.approx(mine[name].mean())
    assert [row["beyond_trained"] for row in pooled] == [False, True]  # told 3, trained to 2
    assert rows.late_chunks.sum() > 0
    (pair,) = [row for row in found["differences"] if row["task"] == "all"]
    assert (pair["method"][:6], pair["baseline"][:5]) == ("prefix", "naive")
    page = (folder / "page/report.md").read_text()
    assert "prefix 0.0% (0.0 to 39.0)" in page  # Wilson for 0 of 6
    assert "| prefix | constant:3 | 4 | 0.0* (0.0 to 39.0) |" in page
    assert (folder / "page/figures/evaluation.png").is_file()
    assert (folder / "page/tables/evaluation.csv").is_file()
    assert json.loads((folder / "page/rows.json").read_text())["evaluation"] == found["evaluation"]


def test_the_run_keeps_the_latencies_without_the_warm_up(folder, jobs, capsys):
    found = json_of(["latency", "robot (1).csv", "--run", "run"], capsys)
    kept = read_trace(found["evaluated"]["latencies"])
    assert found["warm_up"]["rows"] > 0
    assert np.array_equal(kept.total_ms, found["samples_ms"][found["warm_up"]["rows"] :])


def test_nothing_is_computed_twice_nor_mixed_with_constant_delays(folder, jobs, capsys):
    command = ["latency", "robot (1).csv", "--run", "run"]
    first = json_of(command, capsys)
    before = stored(folder)
    files = {path: path.stat().st_mtime_ns for path in folder.glob("run/results/**/*.parquet")}
    store = ResultStore(folder / "run/results/episodes")
    other = before.assign(delay_model="constant:2", estimator="exact", solved=True)
    for key, (_, rows) in enumerate(other.groupby("method")):
        store.append(f"{key:020x}", rows)
    again = json_of(command, capsys)
    assert again["evaluation"] == first["evaluation"]
    same = json_of(shlex.split(first["evaluated"]["command"])[1:], capsys)
    assert [row["success"] for row in same["rows"]] == [
        row["success"] for row in first["evaluation"]
    ]
    assert {path: path.stat().st_mtime_ns for path in files} == files


def test_the_same_latencies_under_another_name_are_labelled_anew(folder, jobs, capsys):
    first = json_of(["latency", "robot (1).csv", "--run", "run"], capsys)
    count = len(stored(folder))
    other = json_of(["latency", "again.csv", "--run", "run"], capsys)
    assert len(stored(folder)) == count
    assert "trace:again.csv@50" in other["evaluated"]["delay_model"]
    drop = ("method", "delay_model")
    left, right = (
        [{k: v for k, v in row.items() if k not in drop} for row in found["evaluation"]]
        for found in (first, other)
    )
    assert left == right


def test_options_replace_the_advice(folder, jobs, capsys):
    more = ["--methods", "naive", "--protocol", "fixed:3", "--estimator", "max-of-last:4"]
    found = json_of(
        ["latency", "again.csv", "--run", "run", *more, "--estimator", "exact", "--episodes", "3"],
        capsys,
    )
    pooled = [row for row in found["evaluation"] if row["train_seed"] == "all"]
    assert {(row["estimator"], row["exec_horizon"], row["episodes"]) for row in pooled} == {
        ("max-of-last:4", 3, 3),
        ("exact", 3, 3),
    }


def test_the_words_for_people(folder, jobs, capsys):
    assert program.run(["latency", "robot (1).csv", "--run", "run"]) == 0
    shown = capsys.readouterr().out
    for words in ("Keys for a recipe:", "Evaluated:", "constant:3", "0.0*", "prefix − naive"):
        assert words in shown, words


def test_a_delay_beyond_the_trained_ones_stops_all_jobs(folder, jobs, capsys):
    more = ["--on-exceed", "fail", "--methods", "prefix,naive"]
    assert program.run(["latency", "again.csv", "--run", "run", *more]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    for words in (TASK, "prefix, d = 2, s = 4", "conditioned delay 3 exceeds 2", "--on-exceed"):
        assert words in line
    assert jobs.names == [f"evaluate prefix · {TASK} · seed 0"]


BAD = [
    (["--methods", "naive"], 2, ["--methods belongs to --run"]),
    (["--on-late", "discard"], 2, ["--on-late belongs to --run"]),
    (["--run", "nowhere"], 3, ["nowhere"]),
    (["--run", "run", "--horizon", "16"], 2, ["--horizon 16", "horizon 8"]),
    (["--run", "run", "--methods", "naif"], 2, ['unknown method "naif"']),
    (["--run", "run", "--hz", "300"], 2, ["H = 8 cannot hold", "a control rate below"]),
]


@pytest.mark.parametrize(("more", "code", "words"), BAD, ids=[" ".join(bad[0]) for bad in BAD])
def test_bad_input_is_one_line(more, code, words, jobs, capsys):
    assert program.run(["latency", "again.csv", *more]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line
