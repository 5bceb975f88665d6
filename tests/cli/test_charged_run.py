"""Equal hardware: `rtc eval --charge`, and a recipe with `[eval.charge]` through `rtc run`."""

import json
from pathlib import Path

import pytest
from jobs_here import run_jobs_here
from untrained_runs import untrained_run

import rtc_cli.cli.app as program
from rtc_cli.results import ResultStore

# At 30 Hz, with 62 ms around the network: 64, 72, 82 and 252 ms; the last is too slow for H = 8.
LATENCIES = {("plain", 1): 2.0, ("plain", 2): 10.0, ("prefix", 1): 20.0, ("prefix", 2): 190.0}
DELAYS = {("naive", 1): 2, ("naive", 2): 3, ("prefix", 1): 3, ("prefix", 2): 8}
OVERRIDES = [
    "tasks=cartpole_thrust",
    "eval.episodes=5",
    "eval.flow_steps=1",
    "eval.methods=naive,prefix",
    "eval.delays=0,2",
    "eval.charge.profile=latencies.json",
    "eval.charge.fixed_ms.vlm=62",
]


@pytest.fixture
def jobs(monkeypatch):
    return run_jobs_here(monkeypatch, "evaluate")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("charged")
    rows = [{"sampler": s, "flow_steps": k, "p95_ms": ms} for (s, k), ms in LATENCIES.items()]
    (folder / "latencies.json").write_text(json.dumps({"rows": rows}), "utf-8")
    untrained_run(folder / "run", "equal_hardware", OVERRIDES, ["base", "prefix"])
    return folder


@pytest.fixture(autouse=True)
def _here(folder, monkeypatch):
    monkeypatch.chdir(folder)


def rtc(capsys, *arguments):
    assert program.run([*arguments, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def evaluated():
    rows = ResultStore("run/results/episodes").load()
    return set(zip(rows["method"], rows["flow_steps"], rows["delay"], strict=True))


def test_every_method_and_number_of_steps_has_its_own_delay(jobs, capsys):
    command = ["eval", "--run", "run", "--charge", "latencies.json", "--fixed-ms", "62"]
    charged = rtc(capsys, *command, "--hz", "30")["rows"]
    assert {(row["method"], row["flow_steps"]): row["delay"] for row in charged} == DELAYS
    late = next(row for row in charged if row["delay"] == 8)
    assert late["success"] is None
    assert "8" in late["reason"]
    possible = {(*key, delay) for key, delay in DELAYS.items() if delay < 8}
    assert evaluated() == possible
    # The same cells under their own names are there already.
    before = len(ResultStore("run/results/episodes").load())
    for method, flow_steps, delay in possible:
        cell = ["--methods", method, "--flow-steps", str(flow_steps), "--delays", str(delay)]
        rtc(capsys, "eval", "--run", "run", *cell)
    assert len(ResultStore("run/results/episodes").load()) == before


def test_a_recipe_with_a_charge_has_it_in_its_report(jobs, capsys):
    found = rtc(capsys, "run", "--run", "run")
    assert {(r["method"], r["flow_steps"]): r["delay"] for r in found["charge"]["rows"]} == DELAYS
    assert found["charge"]["fixed_ms"] == {"vlm": 62.0}
    charged = [name for name in jobs.names if "K = " in name]
    assert sorted(charged) == [
        "evaluate naive · cartpole_thrust · seed 0 · K = 1, d = 2",
        "evaluate naive · cartpole_thrust · seed 0 · K = 2, d = 3",
        "evaluate prefix · cartpole_thrust · seed 0 · K = 1, d = 3",
    ]
    page = (Path("run") / "report" / "report.md").read_text("utf-8")
    assert "## Success at equal hardware" in page
    assert "Too slow for chunks of 8 actions at this rate: prefix with K = 2." in page
    # The usual evaluation stands beside it, with its own number of flow steps.
    assert {row["delay"] for row in found["rows"]} == {0, 2}


def test_options_that_do_not_go_with_it(capsys):
    for options in (("--delays", "2"), ("--flow-steps", "3"), ("--delay-model", "constant:2")):
        assert program.run(["eval", "--run", "run", "--charge", "latencies.json", *options]) == 2
        assert "--charge has delays" in capsys.readouterr().err
    assert program.run(["eval", "--run", "run", "--charge", "rtx-4080"]) == 2
    assert "rtx-4090" in capsys.readouterr().err
