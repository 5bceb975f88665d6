"""docs/latency.md: its commands run, in their order, and what it shows of the analysis is true."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from untrained_runs import save_untrained

import rtc_cli.cli.app as program
from rtc_cli.pipeline.plan import EVALUATION, TRAINING
from rtc_cli.results import ResultStore
from rtc_cli.runs import open_run

PAGE = Path(__file__).parents[2] / "docs/latency.md"
TRACE = "docs/latency/robot.csv"
TASK = "cartpole_thrust"

# In the place of the page's own SMALL.
TINIER = (
    "--set experts.seeds=0 --set experts.max_steps=20000 --set experts.worlds=64 "
    "--set experts.target_success=0.01 --set experts.min_success=0 --set data.transitions=2000 "
    "--set network.channels=8 --set network.channel_hidden=8 --set network.token_hidden=8 "
    "--set train.batch=64 --set train.epochs=4 --set train.warmup_steps=2 --set eval.episodes=4 "
    "--set eval.flow_steps=1"
)


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text("utf-8"), flags=re.DOTALL)


def commands(small=None):
    """The page's command lines, in order, with SMALL filled in: the page's own, or another."""
    found, words = [], {}
    for line in "".join(blocks("sh")).replace("\\\n", " ").splitlines():
        if assigned := re.fullmatch(r'([A-Z]+)="(.*)"', line):
            words[assigned[1]] = assigned[2] if small is None else small
        elif line:
            for name, value in words.items():
                line = line.replace(f"${name}", value)
            found.append(shlex.split(line, comments=True))
    assert all(line[0] == "rtc" for line in found)
    return [line[1:] for line in found]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "docs/latency").mkdir(parents=True)
    shutil.copy(PAGE.parents[1] / TRACE, tmp_path / TRACE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


def plain(text):
    """Words only: lines break elsewhere on a page than in a terminal."""
    return re.sub(r"[\s─…]+", " ", text)


def test_the_analysis_says_what_the_page_shows(folder, capsys):
    first = next(line for line in commands() if line[0] == "latency")
    assert program.run(first[:4]) == 0  # TRACE --hz 30
    said = plain(capsys.readouterr().out)
    shown = blocks("text")[0]
    assert all(plain(part).strip() in said for part in shown.split("...\n")), said


def test_the_page_trains_with_what_the_analysis_gave(folder, capsys):
    first = next(line for line in commands() if line[0] == "latency")
    assert program.run([*first[:4], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    train = next(line for line in commands(small="") if line[0] == "train")
    given = [word for word in train if "=" in word]
    assert given == found["overrides"]


def test_every_command_runs(folder, monkeypatch, capsys):
    """All but the training, in whose place random weights are put; the slow test trains."""

    def execute(jobs, **settings):
        for job in jobs:
            kind, _, seed = job.name.replace(" · ", " ").partition(f" {TASK} seed ")
            if job.stage == EVALUATION:
                job.work(lambda *progress: None)
            elif job.stage == TRAINING and kind in ("base", "prefix"):
                save_untrained(open_run("runs/robot"), TASK, kind, int(seed))

    monkeypatch.setattr("rtc_cli.cli.live.execute", execute)
    for line in commands(TINIER):
        assert program.run(line) == 0, (line, capsys.readouterr().err)
    check_outcome(folder)


@pytest.mark.slow
def test_the_whole_page(folder):
    for line in commands(TINIER):
        command = [sys.executable, "-m", "rtc_cli", *line]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (line, done.stderr)
    check_outcome(folder)


def check_outcome(folder):
    rows = ResultStore(folder / "runs/robot/results/episodes").load()
    assert set(rows.method) == {"naive", "pinv", "prefix"}
    assert set(rows.estimator) == {"constant:3", "max-of-last:10"}
    assert set(rows.exec_horizon) == {4, 7}
    assert all(model.startswith("trace:robot.csv@30 #") for model in rows.delay_model)
    page = (folder / "latency/report.md").read_text("utf-8")
    assert "What this does to the policies" in page
