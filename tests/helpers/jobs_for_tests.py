"""Work for executor tests; a module of its own, since spawned workers import it by name."""

from __future__ import annotations

import os
import time
from pathlib import Path

from rtc_cli.errors import DivergedError
from rtc_cli.pipeline.executors import Progress


def touch(folder: str, name: str, seconds: float, progress: Progress) -> None:
    """Write the times at which the work began and ended."""
    began = time.time()
    progress(0, 1, "begun")
    time.sleep(seconds)
    (Path(folder) / name).write_text(f"{began} {time.time()} {os.getpid()}")


def diverge(progress: Progress) -> None:
    """Fail with an error that has a hint."""
    raise DivergedError("loss is NaN", "lower the rate")


def die(progress: Progress) -> None:
    """End the process without an answer."""
    os._exit(9)
