"""Motions of the Kinetix port keep to their closed forms, as docs/kinetix.md says."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from rtc_cli.tasks.scene import SUBSTEP_S

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_kinetix", DOCS / "make_kinetix.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


def test_the_page_shows_what_the_script_measures(script: ModuleType) -> None:
    # Without the column of rounding errors, which may differ between machines.
    wanted = [line.rsplit("|", 2)[0] for line in script.table(script.motions()).splitlines()]
    page = [line.rsplit("|", 2)[0] for line in (DOCS / "kinetix.md").read_text().splitlines()]
    assert all(line in page for line in wanted)


def test_places_lag_by_one_substep_and_by_no_more(script: ModuleType) -> None:
    for motion, fastest in ((script.free_fall(), 1.0 + 9.81 * 0.8), (script.thruster_burst(), 2.0)):
        assert motion.error < fastest * SUBSTEP_S
        early = motion.time - SUBSTEP_S / 2  # half a substep: v dt minus a dt²/2 on average
        assert np.abs(motion.ours[2:] - motion.closed(early)[2:]).max() < 0.02


def test_free_fall_and_spin_up_are_the_law_to_the_last_digits(script: ModuleType) -> None:
    assert script.free_fall().step_error < 1e-12
    assert script.motor_spin_up().step_error < 1e-12


def test_bounces_reach_the_heights_of_their_restitution(script: ModuleType) -> None:
    tops = script.peaks(script.bounce())
    np.testing.assert_allclose(tops, [0.8**2, 0.8**4, 0.8**6], atol=0.005)
