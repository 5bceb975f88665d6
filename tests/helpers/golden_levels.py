"""Levels that Kinetix itself has played: small ones of one effect each, and the paper's twelve.

`data/README.md` says where the values come from. The paper's levels and their values are not part
of this repository: environment variables say where they are.
"""

from __future__ import annotations

import json
import lzma
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from level_files import Content

from rtc_cli.tasks.kinetix.compiling import load_physics
from rtc_cli.tasks.kinetix.packing import pack
from rtc_cli.tasks.kinetix.reading import Level

Golden = dict[str, np.ndarray]

PAPER_LEVELS = (
    "car_launch",
    "cartpole_thrust",
    "catapult",
    "catcher_v3",
    "chain_lander",
    "grasp_easy",
    "h17_unicycle",
    "hard_lunar_lander",
    "mjc_half_cheetah",
    "mjc_swimmer",
    "mjc_walker",
    "trampoline",
)
POSE, VELOCITY = [0, 1, 4], [2, 3, 5]  # columns of a state
_DATA = Path(__file__).parents[1] / "data"


def small_entries() -> list[str]:
    """Names of the small levels' values: "NAME", or "NAME@zero_gravity"."""
    with np.load(_DATA / "kinetix_micro.npz") as values:
        return sorted({key.partition("/")[0] for key in values if "/" in key})


def small_values(entry: str) -> Golden:
    """What Kinetix computed for a small level."""
    return _part(_DATA / "kinetix_micro.npz", entry)


@cache
def small_levels() -> dict[str, Content]:
    """Contents of the small level files by name."""
    with lzma.open(_DATA / "kinetix_micro_levels.json.xz") as file:
        levels: dict[str, Content] = json.load(file)
    return levels


def paper_folder() -> Path:
    """Folder of the paper's level files; skips the test where it is not known."""
    return _known_place("RTC_KINETIX_LEVELS", "the folder of the paper's level files")


def paper_values(level: str) -> Golden:
    """What Kinetix computed for one of the paper's levels; skips the test without the file."""
    return _part(_known_place("RTC_KINETIX_GOLDEN", "kinetix_paper_levels.npz"), level)


def _known_place(variable: str, what: str) -> Path:
    place = os.environ.get(variable, "")
    if not place:
        pytest.skip(f"{variable} does not name {what}")
    return Path(place)


def _part(file: Path, name: str) -> Golden:
    with np.load(file) as values:
        return {key.partition("/")[2]: values[key] for key in values if key.startswith(f"{name}/")}


def play_substeps(level: Level, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (T, moving, 6) after every substep, and what its contacts mean (T,).

    Commands (T, 6): four motor bindings, then two of thrusters. An end of the episode ends nothing.
    """
    physics, packed = load_physics(), pack(level)
    memory, scratch = physics.make_memory(packed, 1), physics.make_scratch(packed)
    parts: Sequence[object] = packed[:-1]  # all but the start, which is in the memory
    ticks = len(commands)
    log = np.empty((ticks, 1, 1, len(packed.bodies.moving), 6), np.float32)
    outcome, last = np.empty((2, ticks, 1, 1), np.int8)
    for i in range(ticks):
        command = commands[None, i : i + 1].astype(np.float32)
        world = np.zeros(1, np.int64)
        physics.run(*parts, memory, scratch, world, command, 1, log[i], outcome[i], last[i])
    return log[:, 0, 0], outcome[:, 0, 0]
