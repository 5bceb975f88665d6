"""Names of tasks that are level files: "kinetix:PATH" on the command line and in recipes.

A leaf: text and folder listings only. Reading a level is the business of `rtc_cli.tasks.kinetix`.
Recipes hold absolute paths, so that a run finds its levels from any working directory and from
every worker process. Folders, tables and pictures show the short name, "kinetix-<file name>".
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

from rtc_cli.errors import UsageError, did_you_mean

PREFIX = "kinetix:"
SHORT_PREFIX = "kinetix-"
SUFFIX = ".json"
OPTION = "@"  # before the kind of observation
LEVELS = "{levels}"  # in a recipe's tasks: the folder of --levels

Observation = Literal["compact", "symbolic"]


def is_level(task: str) -> bool:
    """Whether a task's name is that of a level file or a folder of them."""
    return task.startswith(PREFIX)


def level_path(task: str) -> Path:
    """The path that a level's name holds; UsageError for the home of a user who does not exist."""
    try:
        return Path(_split(task)[0]).expanduser()
    except RuntimeError as error:
        raise UsageError(f'"{task}": {error}', "write the path without ~") from error


def moved_level(task: str, path: Path) -> str:
    """The name of the same level, observed in the same way, in another file."""
    observation = level_observation(task)
    end = "" if observation == "compact" else f"{OPTION}{observation}"
    return f"{PREFIX}{path.absolute()}{end}"


def level_observation(task: str) -> Observation:
    """How a level is observed, by its name; UsageError for a kind that does not exist."""
    return _split(task)[1]


def _split(task: str) -> tuple[str, Observation]:
    """The path in a level's name, and how it is observed."""
    whole = task.removeprefix(PREFIX)
    path, found, kind = whole.rpartition(OPTION)
    for known in get_args(Observation):
        if found and kind == known:
            return path, known
    if path.lower().endswith(SUFFIX) and kind.isalpha():
        known_kinds = did_you_mean(kind, get_args(Observation))
        raise UsageError(
            f'"{task}": unknown observation "{kind}".{known_kinds}', "write PATH@symbolic, or PATH"
        )
    return whole, "compact"


def short_name(task: str) -> str:
    """The name to show, safe as a folder's name: "kinetix-<file name>"; other names as they are."""
    if not is_level(task):
        return task
    file = level_path(task)
    stem = file.stem if file.suffix.lower() == SUFFIX else file.name
    observation = level_observation(task)
    end = "" if observation == "compact" else f"-{observation}"
    return SHORT_PREFIX + re.sub(r"[^\w-]+", "_", unicodedata.normalize("NFC", stem)) + end


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
        return [moved_level(task, path)]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == SUFFIX)
    if not files:
        raise UsageError(
            f"{path} holds no level files (*{SUFFIX})", "name a level file or another folder"
        )
    return [moved_level(task, file) for file in files]
