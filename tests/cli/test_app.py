"""The error boundary: bad input is one line with value, rule and fix, and an exit code."""

import errno
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import typer

import rtc_cli.cli.app as program
from rtc_cli import __version__
from rtc_cli.errors import (
    DivergedError,
    PartialResult,
    RtcError,
    StateError,
    UsageError,
    did_you_mean,
)
from rtc_cli.recipe import load_recipe
from rtc_cli.runs import create_run


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RTC_DEBUG", raising=False)


@pytest.fixture
def command_that(monkeypatch):
    """Replace `rtc report` by a function."""

    def replace(action):
        app = typer.Typer()
        app.command()(action)
        module = type(sys)("rtc_cli.cli.report")
        module.app = app
        monkeypatch.setitem(sys.modules, "rtc_cli.cli.report", module)

    return replace


def raising(error):
    def act() -> None:
        raise error

    return act


def test_version(capsys):
    assert program.run(["--version"]) == 0
    assert capsys.readouterr().out == f"rtc {__version__}\n"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (RtcError("a"), 1, "rtc: error: a\n"),
        (UsageError("a", "b"), 2, "rtc: error: a (b)\n"),
        (StateError("two\nlines", "b"), 3, "rtc: error: two lines (b)\n"),
        (DivergedError("a"), 4, "rtc: error: a\n"),
        (PartialResult("a"), 5, "rtc: error: a\n"),
        (RtcError("a", exit_code=5), 5, "rtc: error: a\n"),
        (
            RuntimeError("INTERNAL: Error: Out of memory allocating 9 bytes.\n---\nmore"),
            3,
            "rtc: error: Out of memory allocating 9 bytes. "
            "(take a smaller network, batch or number of workers, or free some)\n",
        ),
        (KeyboardInterrupt(), 130, "rtc: interrupted; run again to resume\n"),
    ],
)
def test_errors_become_one_line_and_a_code(command_that, capsys, error, code, line):
    command_that(raising(error))
    assert program.run(["report"]) == code
    captured = capsys.readouterr()
    assert captured.err == line
    assert captured.out == ""


@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "disk is full"), (errno.EACCES, "permission denied")]
)
def test_system_errors_are_state(command_that, capsys, number, words):
    command_that(raising(OSError(number, os.strerror(number), "/some/file")))
    assert program.run(["report"]) == 3
    assert "/some/file" in (line := capsys.readouterr().err)
    assert words in line


def test_bugs_keep_their_traceback(command_that):
    command_that(raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        program.run(["report"])


def test_debugging_shows_the_traceback(command_that, capsys, monkeypatch):
    monkeypatch.setenv("RTC_DEBUG", "1")
    command_that(raising(UsageError("a")))
    assert program.run(["report"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_errors_survive_the_way_from_a_worker_process():
    import pickle

    sent = pickle.loads(pickle.dumps(StateError("a", "b", 5)))
    assert (type(sent), sent.message, sent.hint, sent.exit_code) == (StateError, "a", "b", 5)


def test_did_you_mean():
    assert did_you_mean("prefx", ["naive", "prefix"]) == (
        ' Did you mean "prefix"? Allowed: naive, prefix.'
    )
    assert did_you_mean("zzz", ["naive", "prefix"]) == " Allowed: naive, prefix."


BAD_INPUT = [
    (["trian"], 2, ['"trian"', 'Did you mean "train"']),
    (["profile", "--smapler", "pinv"], 2, ["--smapler", "profile --help"]),
    (["profile", "--sampler", "pnv"], 2, ['"pnv"', 'Did you mean "pinv"']),
    (["profile", "--batch", "1,x"], 2, ['"1,x"', "integers"]),
    (["profile", "--batch", "0"], 2, ['"0"']),
    (["profile", "--rounding", "up"], 2, ["up", "ceil"]),
    (["profile", "--rounds", "1"], 2, ["1"]),
    (["profile", "--network", "papr"], 2, ['"papr"', 'Did you mean "paper"']),
    (["profile", "--run", "nowhere"], 3, ["nowhere", "does not exist", "--run"]),
    (["profile", "--run", "x", "--horizon", "9"], 2, ["--horizon"]),
    (["train", "quikstart"], 2, ['"quikstart"', 'Did you mean "quickstart"']),
    (["train", "nowhere.toml"], 2, ["nowhere.toml"]),
    (["train", "quickstart", "--set", "train.epohcs=8"], 2, ["epohcs", 'mean "epochs"']),
    (["run", "quickstart", "--set", "tasks=cacher"], 2, ['"cacher"', 'mean "catcher"']),
    (["run", "quickstart", "--set", "eval.methods=pnv"], 2, ['"pnv"', 'mean "pinv"']),
    (["run", "quickstart", "--set", "eval.delays=9"], 2, ["9", "8"]),
    (["eval"], 3, ["no run", "rtc run"]),
    (["eval", "--run", "nowhere"], 3, ["nowhere", "does not exist"]),
    (["report"], 3, ["no run"]),
    (["report", "--run", "nowhere"], 3, ["nowhere", "does not exist"]),
    (["tasks", "cacher"], 2, ['"cacher"', 'mean "catcher"']),
]


@pytest.mark.parametrize(("args", "code", "words"), BAD_INPUT, ids=lambda v: str(v)[:40])
def test_bad_input(args, code, words, capsys, tmp_path):
    assert program.run(args) == code
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    for word in words:
        assert word in lines[0]
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []  # nothing is left behind


BAD_EVALUATION = [
    (["--delays", "4-0"], ["4-0", "backwards", '"0-4"']),
    (["--delays", "x"], ['"x"', "0,2-4"]),
    (["--delays", "9"], ["9", "8"]),
    (["--delays", "4", "--protocol", "fixed:2"], ["4", "2"]),
    (["--delays", "4", "--protocol", "fixed:6"], ["4", "6"]),
    (["--protocol", "papr"], ['"papr"', "paper"]),
    (["--methods", "pnv"], ['"pnv"', 'mean "pinv"']),
    (["--tasks", "cacher"], ['"cacher"', "cartpole"]),
    (["--episodes", "0"], ["0"]),
]


@pytest.mark.parametrize(("args", "words"), BAD_EVALUATION, ids=lambda v: str(v)[:40])
def test_bad_evaluation_of_a_run(args, words, capsys):
    create_run(load_recipe("quickstart"))
    assert program.run(["eval", *args]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]


def test_a_locked_and_a_foreign_run(capsys, tmp_path):
    run = create_run(load_recipe("quickstart"), tmp_path / "mine")
    with run.lock():
        assert program.run(["train", "quickstart", "--run", str(run.folder)]) == 3
    assert "locked by process" in capsys.readouterr().err
    assert program.run(["train", "paper", "--run", str(run.folder)]) == 3
    assert "another recipe" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_no_permission_to_write(capsys, tmp_path):
    (tmp_path / "closed").mkdir(mode=0o500)
    assert program.run(["train", "quickstart", "--run", str(tmp_path / "closed" / "run")]) == 3
    assert "permission denied" in capsys.readouterr().err


def test_a_closed_pipe_is_quiet():
    code = f"{sys.executable} -m rtc_cli --help | head -c 1 >/dev/null"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_ctrl_c_while_a_command_runs(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", _SLEEPER], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "sleeping\n"
    time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert error == "rtc: interrupted; run again to resume\n"


# The handler that Python installs in a terminal; programs started in the background ignore Ctrl-C.
_SLEEPER = """
import signal, sys, time, types, typer
signal.signal(signal.SIGINT, signal.default_int_handler)
from rtc_cli.cli import app as program
module = types.ModuleType("rtc_cli.cli.report")
module.app = typer.Typer()
@module.app.command()
def sleep():
    print("sleeping", flush=True)
    time.sleep(30)
sys.modules["rtc_cli.cli.report"] = module
sys.argv = ["rtc", "report"]
from rtc_cli.__main__ import main
main()
"""


def test_json_goes_to_stdout_and_all_else_to_stderr(capsys):
    import numpy as np

    from rtc_cli.cli.output import document, output

    with output(True) as out:
        print("a library's chatter")
        out.say("words")
        row = {"x": np.float32(0.5), "y": float("nan"), "z": np.arange(2), "w": np.bool_(True)}
        out.result(document(None, {}, [row]), "a table")
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {
        "schema": 1,
        "run": None,
        "machine": {},
        "rows": [{"x": 0.5, "y": None, "z": [0, 1], "w": True}],
    }
    assert "chatter" in captured.err
    assert "words" in captured.err
    assert "a table" not in captured.err


def test_no_progress_bars_without_a_terminal(capsys):
    from rtc_cli.cli.output import progress

    with progress() as bars:
        bars.update(bars.add_task("work", total=3, note=""), advance=1)
    assert capsys.readouterr() == ("", "")


def test_an_empty_command_line_shows_the_help_and_is_no_error(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert program.run([]) == 0
    shown = capsys.readouterr()
    assert "Commands:" in shown.out
    assert not shown.err
