"""Kinetix level files as tasks: a port to pymunk, not the original simulator.

`load_level` reads a file and gives its `Scene`; `rtc_cli.tasks.get_task("kinetix:PATH")` does the
same by name. `reading.py` knows the file format, `building.py` the translation. What a level asks
for and this port lacks is refused by name. docs/kinetix.md compares the motions.
"""

from __future__ import annotations

from pathlib import Path

from rtc_cli.levels import short_name
from rtc_cli.tasks.kinetix.building import build_scene
from rtc_cli.tasks.kinetix.reading import read_level
from rtc_cli.tasks.scene import Scene

__all__ = ["load_level"]


def load_level(path: Path | str) -> Scene:
    """Read a Kinetix level file (.json) as a scene named "kinetix-<file name>".

    Raises UsageError, naming the file, the field and what is allowed, for a broken level and for
    one that asks for what this port does not support.
    """
    path = Path(path)
    return build_scene(read_level(path), short_name(f"kinetix:{path}"))
