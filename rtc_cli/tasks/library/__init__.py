"""The built-in tasks: one module each; its docstring is what a person reads about the task.

A module offers `SCENE`. Some also offer `controller`: a feedback law written by hand, which shows
what a solved episode looks like before anything is trained.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.util import find_spec

from rtc_cli.errors import UsageError
from rtc_cli.tasks.scene import FloatArray

Controller = Callable[[FloatArray], FloatArray]
"""Observations (n, O) -> physical actions (n, A)."""


def has_controller(task: str) -> bool:
    """Whether a task has a hand-written controller."""
    return _find_controller(task) is not None


def get_controller(task: str) -> Controller:
    """The hand-written controller of a built-in task; UsageError where there is none."""
    found = _find_controller(task)
    if found is None:
        raise UsageError(
            f'task "{task}" has no controller written by hand; only some built-in tasks have one.',
            "let random actions or a trained method act",
        )
    return found


def _find_controller(task: str) -> Controller | None:
    name = f"{__name__}.{task}"
    if not task.isidentifier() or find_spec(name) is None:
        return None
    found: Controller | None = getattr(importlib.import_module(name), "controller", None)
    return found
