"""Loads the compiled physics, and keeps what was compiled in the user's cache.

Compiling takes some seconds and is done once per machine and version of the sources: numba would
look at the date of one source file only, so the folder is named after all of them.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType

from rtc_cli.errors import UsageError

_SOURCES = ("contacts.py", "numerics.py", "packing.py", "physics.py", "solving.py")
_MODULE = "rtc_cli.tasks.kinetix.physics"


@cache
def load_physics() -> ModuleType:
    """The module `physics`; UsageError where numba is missing."""
    _require_numba()
    import numba

    own = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = own or str(cache_folder())
    try:
        return importlib.import_module(_MODULE)
    finally:
        numba.config.CACHE_DIR = own


def is_compiled() -> bool:
    """Whether the compiled physics is in the cache already; UsageError where numba is missing."""
    _require_numba()
    import numba

    folder = Path(numba.config.CACHE_DIR or cache_folder())
    return next(folder.rglob("physics.run-*.nbc"), None) is not None


def _require_numba() -> None:
    if importlib.util.find_spec("numba") is None:
        raise UsageError(
            "Kinetix levels need numba, which is not installed",
            'pip install "rtc-cli[kinetix]", or ".[kinetix]" in a checkout',
        )


@cache
def cache_folder() -> Path:
    """Where compiled physics is kept: a folder that can be written, the user's cache if possible.

    NUMBA_CACHE_DIR takes its place where it is set.
    """
    here = Path(__file__).parent
    content = b"".join((here / name).read_bytes() for name in _SOURCES)
    name = f"kinetix-{hashlib.sha256(content).hexdigest()[:16]}"
    folder = _user_cache() / "rtc-cli" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="rtc-cli-"))  # compiled anew by every process


def _user_cache() -> Path:
    """The user's cache folder, as the platform has it."""
    if sys.platform == "darwin":
        return Path("~/Library/Caches").expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or tempfile.gettempdir())
    given = os.environ.get("XDG_CACHE_HOME", "")
    return Path(given) if os.path.isabs(given) else Path("~/.cache").expanduser()
