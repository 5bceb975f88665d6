"""The built-in tasks: one module each; its docstring is what a person reads about the task.

A module offers `SCENE`, and `controller`: a feedback law written by hand, which shows that the
task can be solved and what an episode looks like.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.util import find_spec

from rtc_cli.errors import UsageError
from rtc_cli.tasks.scene import FloatArray

Controller = Callable[[FloatArray], FloatArray]
"""Observations (n, O) -> physical actions (n, A)."""


def get_controller(task: str) -> Controller:
    """The hand-written controller of a built-in task; UsageError for any other task."""
    name = f"{__name__}.{task}"
    if not task.isidentifier() or find_spec(name) is None:
        raise UsageError(
            f'task "{task}" has no controller written by hand; only built-in tasks have one.',
            "let random actions or a trained method act",
        )
    found: Controller = importlib.import_module(name).controller
    return found
