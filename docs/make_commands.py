"""Writes docs/commands.md from the program's own help pages: python docs/make_commands.py

`tests/cli/test_docs.py` fails where the file is not what this script writes.
"""

from pathlib import Path
from typing import Any

import typer
from typer.main import get_command

from rtc_cli.cli.app import app

PAGE = Path(__file__).parent / "commands.md"
WIDTH = 96

INTRO = """\
# Commands

This page is made from the help pages (`python docs/make_commands.py`).

- **Runs.** A run is a folder, `./runs/<recipe>-<UTC time>/` or `--run DIR`. Commands that need one
  take the newest. One process at a time writes to it; what it holds already is not computed again.
- **Recipes.** `RECIPE` is a shipped name (`quickstart`, `standard`, `kinetix`, `equal_hardware`,
  `paper`, `ablations/delay_distribution`, `ablations/multimodality`) or the path of a `.toml` file.
  `--set train.epochs=8` overrides a value; lists take commas
  (`--set eval.methods=naive,pinv`), delays take ranges (`0,2-4`).
- **Output.** Tables for people. With `--json`, one JSON document on stdout and everything else on
  stderr: `{"schema": 1, "run": ..., "machine": ..., "rows": [...]}`, undefined numbers as `null`.
- **Errors.** One line on stderr that names the value, the rule and the fix. With `RTC_DEBUG=1` the
  traceback too.

| exit code | meaning |
| --- | --- |
| 0 | done |
| 2 | what was typed: options, recipe, names, geometry |
| 3 | state on disk or elsewhere: run missing, locked or foreign, checkpoint, data, full disk |
| 4 | diverged: NaN |
| 5 | partial result |
| 130 | interrupted; run again to resume |
"""


def pages() -> dict[str, str]:
    """Return the help page of `rtc` and of every command, by its full name."""
    root = get_command(app)
    return dict(_pages(root, "rtc", None))


def _pages(command: Any, name: str, parent: Any) -> list[tuple[str, str]]:
    context = typer.Context(
        command, info_name=name, parent=parent, terminal_width=WIDTH, max_content_width=WIDTH
    )
    context.help_option_names = ["-h", "--help"]
    path = context.command_path
    found = [(path, command.get_help(context).rstrip())]
    if hasattr(command, "list_commands"):
        for child in command.list_commands(context):
            found += _pages(command.get_command(context, child), child, context)
    return found


def text() -> str:
    """Return the whole page."""
    sections = [INTRO]
    for name, page in pages().items():
        lines = "\n".join(line.rstrip() for line in page.splitlines())
        sections.append(f"## {name}\n\n```text\n{lines}\n```\n")
    return "\n".join(sections)


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
