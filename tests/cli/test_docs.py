"""docs/commands.md is what the real program says, and holds every command and option."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.main import get_command

from rtc_cli.cli.app import COMMANDS, app

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def generator():
    spec = importlib.util.spec_from_file_location("make_commands", ROOT / "docs/make_commands.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(generator):
    written = generator.PAGE.read_text(encoding="utf-8")
    assert written == generator.text(), "run: python docs/make_commands.py"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_documented_with_a_help_text(name):
    page = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    section = page.partition(f"## rtc {name}\n")[2].partition("\n## ")[0]
    assert section
    root = get_command(app)
    command = root.get_command(typer.Context(root), name)
    for param in command.params:
        shown = param.opts if param.param_type_name == "option" else [param.metavar]
        assert any(option in section for option in shown), f"{name}: {shown}"
        assert param.help, f"{name} {param.name} has no help text"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_shows_examples(generator, name):
    assert "Examples:" in generator.pages()[f"rtc {name}"]


def test_the_same_option_has_the_same_help_everywhere():
    root = get_command(app)
    seen: dict[str, set[str]] = {}
    for name in COMMANDS:
        for param in root.get_command(typer.Context(root), name).params:
            for option in param.opts:
                seen.setdefault(option, set()).add(str(param.help))
    for option in ("--json", "--set", "--workers", "--resume"):
        assert len(seen[option]) == 1, option


def test_the_readmes_python_runs_as_printed() -> None:
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    snippets = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert snippets
    for snippet in snippets:
        names: dict[str, Any] = {}
        exec(snippet, names)
        chunk = names["chunk"]
        assert chunk.shape == (1, 8, 2)
        # What is committed is nearer to the previous chunk than what is free.
        assert abs(chunk[0, 0, 0] - 0.5) < abs(chunk[0, 7, 0] - 0.5)
