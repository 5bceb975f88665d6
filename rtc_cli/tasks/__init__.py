"""Tasks by name: the built-in ones in `rtc_cli.tasks.library`, and plugins.

A module in the library offers `SCENE`, or a function `scene()`. A package adds tasks through the
entry point group `rtc_cli.tasks`: the entry's name is the task's, its value a `Scene` or a
function without arguments that returns one. Level files have names too: "kinetix:PATH".
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.levels import expand, is_level, level_observation, level_path, short_name
from rtc_cli.tasks.scene import Scene

__all__ = ["get_task", "list_tasks"]

_GROUP = "rtc_cli.tasks"
_LIBRARY = "rtc_cli.tasks.library"


def list_tasks() -> tuple[str, ...]:
    """Names of all tasks, sorted."""
    return tuple(sorted({*_built_in(), *_plugins()}))


def get_task(name: str) -> Scene:
    """The scene called `name`; UsageError with suggestions if there is none.

    "kinetix:PATH" reads a level file; the scene's own name is then "kinetix-<file name>". With
    "kinetix:PATH@symbolic" it is observed as Kinetix does, and called "...-symbolic".
    """
    if not is_level(name):
        return _named(name)
    found = expand([name])
    if len(found) > 1:
        raise UsageError(
            f'"{name}" holds {len(found)} levels: {", ".join(map(short_name, found))}',
            "name one of the files where one task is meant",
        )
    from rtc_cli.tasks.kinetix import load_level

    path, observation = level_path(found[0]), level_observation(found[0])
    return load_level(path, observation)  # not kept: files may change


@cache
def _named(name: str) -> Scene:
    if name in _built_in():
        module = importlib.import_module(f"{_LIBRARY}.{name}")
        found: object = getattr(module, "SCENE", None) or module.scene
    elif name in _plugins():
        found = _plugins()[name].load()
    else:
        raise UsageError(
            f'unknown task "{name}".' + did_you_mean(name, list_tasks()),
            "a level file is named kinetix:PATH",
        )
    scene = found if isinstance(found, Scene) else found() if callable(found) else found
    if not isinstance(scene, Scene):
        raise UsageError(f'task "{name}" gave {type(scene).__name__}; it must give a Scene.')
    return scene


@cache
def _built_in() -> tuple[str, ...]:
    library = importlib.import_module(_LIBRARY)
    modules = pkgutil.iter_modules(library.__path__)
    return tuple(module.name for module in modules if not module.name.startswith("_"))


@cache
def _plugins() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=_GROUP)}
