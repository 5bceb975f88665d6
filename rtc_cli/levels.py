"""Names of tasks that are level files: "kinetix:PATH" on the command line and in recipes.

A leaf: text and folder listings only. Reading a level is the business of `rtc_cli.tasks.kinetix`.
Recipes hold absolute paths, so that a run finds its levels from any working directory and from
every worker process. Folders, tables and pictures show the short name, "kinetix-<file name>".
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from rtc_cli.errors import UsageError

PREFIX = "kinetix:"
SHORT_PREFIX = "kinetix-"
SUFFIX = ".json"


def is_level(task: str) -> bool:
    """Whether a task's name is that of a level file or a folder of them."""
    return task.startswith(PREFIX)


def level_path(task: str) -> Path:
    """The path that a level's name holds; UsageError for the home of a user who does not exist."""
    try:
        return Path(task.removeprefix(PREFIX)).expanduser()
    except RuntimeError as error:
        raise UsageError(f'"{task}": {error}', "write the path without ~") from error


def short_name(task: str) -> str:
    """The name to show, safe as a folder's name: "kinetix-<file name>"; other names as they are."""
    if not is_level(task):
        return task
    stem = level_path(task).name.removesuffix(SUFFIX)
    return SHORT_PREFIX + re.sub(r"[^A-Za-z0-9_-]+", "_", stem)


def task_label(task: str) -> str:
    """What tables and figures call a task: levels are marked as a port."""
    name = short_name(task)
    return f"{name} (pymunk port)" if name.startswith(SHORT_PREFIX) else name


def port_note(tasks: Iterable[str]) -> str:
    """The sentence that goes with results on levels; "" where no task is one."""
    if not any(short_name(task).startswith(SHORT_PREFIX) for task in tasks):
        return ""
    return (
        "Tasks named kinetix-... are Kinetix levels in a pymunk port: their results are not "
        "comparable with published values."
    )


def expand(tasks: Iterable[str]) -> tuple[str, ...]:
    """Names with absolute paths, folders replaced by their level files in the order of names.

    Raises UsageError for a folder without levels, and for two levels of one short name: their
    results would be mixed up.
    """
    found: list[str] = []
    for task in tasks:
        found += _expanded(task) if is_level(task) else [task]
    levels: dict[str, str] = {}
    for task in dict.fromkeys(found):
        other = levels.setdefault(short_name(task), task)
        if other != task:
            raise UsageError(
                f'"{other}" and "{task}" would both be called {short_name(task)}',
                "rename one of the files",
            )
    return tuple(found)


def _expanded(task: str) -> list[str]:
    if task == PREFIX:
        raise UsageError(f'"{task}" names no level', "write kinetix:PATH_OR_FOLDER")
    path = Path(os.path.normpath(level_path(task).absolute()))
    if not path.is_dir():
        return [f"{PREFIX}{path}"]
    files = sorted(path.glob(f"*{SUFFIX}"))
    if not files:
        raise UsageError(
            f"{path} holds no level files (*{SUFFIX})", "name a level file or another folder"
        )
    return [f"{PREFIX}{file}" for file in files]
