"""The compiled physics moves small levels as Kinetix does, and what is simple by closed forms."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from golden_levels import (
    POSE,
    VELOCITY,
    play_substeps,
    small_entries,
    small_levels,
    small_values,
)
from level_files import hover, write_level

from rtc_cli.tasks.kinetix.packing import FAILURE, NOTHING, SUCCESS
from rtc_cli.tasks.kinetix.reading import Level, read_level
from rtc_cli.tasks.scene import SUBSTEP_S, SUBSTEPS

EARLY = 1e-6  # m and rad, at the end of the first control step
LATER = (
    2e-4  # from then on; twice what marks the horizon, since libraries' sines differ in last bits
)
REWARDS = {NOTHING: 0, SUCCESS: 1, FAILURE: -1}


def small_level(entry: str, gravity: float, folder: Path) -> Level:
    name = entry.partition("@")[0]
    level = read_level(write_level(folder, small_levels()[name], name))
    return dataclasses.replace(level, gravity=(0.0, gravity))


@pytest.mark.parametrize("entry", small_entries())
def test_small_levels_move_as_in_kinetix(entry: str, tmp_path: Path) -> None:
    golden = small_values(entry)
    level = small_level(entry, float(golden["gravity_y"]), tmp_path)
    moving = [shape.number for shape in level.shapes if level.moves(shape)]
    assert moving == golden["ids"].tolist()

    states, meaning = play_substeps(level, np.repeat(golden["actions"], SUBSTEPS, axis=0))

    # From some substep on rounding decides: another float32 implementation differs from there.
    comparable = int(golden["horizon_rounding_1e-4"]) - 1
    pose = np.abs(states[..., POSE] - golden["pose"])[:comparable]
    # A velocity may be off by what shifts a pose by its tolerance in one substep.
    shift = np.abs(states[..., VELOCITY] - golden["vel"])[:comparable] * SUBSTEP_S
    for error in (pose, shift):
        assert error[:SUBSTEPS].max() <= EARLY
        assert error.max() <= LATER
    rewards = [REWARDS[int(each)] for each in meaning]
    assert rewards[:comparable] == golden["reward"][:comparable].tolist()


def test_free_fall_is_the_semi_implicit_euler_sum(tmp_path: Path) -> None:
    """v_n = v_0 − g n h and y_n = y_0 + h Σ v_k: velocities first, then places."""
    content = hover()
    velocity, spin, substeps = (0.3, 0.5), 0.7, 20
    content["env_state"]["joint"][0]["active"] = False
    hull = content["env_state"]["polygon"][1]
    hull |= {"velocity": {"0": velocity[0], "1": velocity[1]}, "angular_velocity": spin}
    hull["collision_mode"] = 0  # touches the floor only
    states, _ = play_substeps(read_level(write_level(tmp_path, content)), np.zeros((substeps, 6)))
    n = np.arange(1, substeps + 1)
    fallen = 9.81 * SUBSTEP_S**2 * n * (n + 1) / 2
    wanted = np.stack(
        [
            2.0 + velocity[0] * n * SUBSTEP_S,
            2.0 + velocity[1] * n * SUBSTEP_S - fallen,
            np.full(substeps, velocity[0]),
            velocity[1] - 9.81 * n * SUBSTEP_S,
            spin * n * SUBSTEP_S,
            np.full(substeps, spin),
        ],
        axis=1,
    )
    np.testing.assert_allclose(states[:, 0], wanted, atol=1e-5)


@pytest.mark.parametrize("command", [1.0, -0.4, 2.0])
def test_a_motor_spins_up_by_its_recurrence(command: float, tmp_path: Path) -> None:
    """A wheel on a wall: its inertia drops out, and commands beyond ±1 count as ±1."""
    content = hover()
    to_floor = {"a_index": 0, "b_index": 1, "motor_has_joint_limits": False}
    centre = {"a_relative_pos": {"0": -0.5, "1": 1.8}, "b_relative_pos": {"0": 0.0, "1": 0.0}}
    content["env_state"]["joint"][0] |= to_floor | centre
    content["env_state"]["polygon"][1]["collision_mode"] = 0  # touches the floor only
    commands = np.zeros((30, 6))
    commands[:, 2] = command
    states, _ = play_substeps(read_level(write_level(tmp_path, content)), commands)
    spin, wanted = 0.0, []
    for _ in commands:
        lag = spin - 6.0 * max(-1.0, min(1.0, command))
        spin -= 900.0 * SUBSTEP_S * math.tanh(0.1 * lag)
        wanted.append(spin)
    np.testing.assert_allclose(states[:, 0, 5], wanted, atol=1e-4)
    np.testing.assert_allclose(states[:, 0, :2], 2.0, atol=1e-5)  # hinged at its centre
