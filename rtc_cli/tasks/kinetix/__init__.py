"""Kinetix level files as tasks, with the physics that they were made for.

`load_level` reads a file and gives its `LevelScene`; `rtc_cli.tasks.get_task("kinetix:PATH")` does
the same by name. `reading.py` knows the file format, `building.py` makes the scene, `physics.py`
computes a step on the arrays of `packing.py`. What a level asks for and the physics lacks is
refused by name. docs/kinetix.md says how closely Kinetix itself is followed.
"""

from __future__ import annotations

from pathlib import Path

from rtc_cli.levels import OPTION, PREFIX, Observation, short_name
from rtc_cli.tasks.kinetix.building import build_scene
from rtc_cli.tasks.kinetix.reading import read_level
from rtc_cli.tasks.kinetix.scene import LevelScene

__all__ = ["LevelScene", "load_level"]


def load_level(path: Path | str, observation: Observation = "compact") -> LevelScene:
    """Read a Kinetix level file (.json) as a scene named "kinetix-<file name>".

    `observation` is "compact" or "symbolic"; see `LevelScene`. Stepping its worlds needs numba.
    Raises UsageError, naming the file, the field and what is allowed, for a broken level and for
    one that asks for what the physics does not have.
    """
    path = Path(path)
    name = short_name(f"{PREFIX}{path}{OPTION}{observation}")
    return build_scene(read_level(path), name, observation)
