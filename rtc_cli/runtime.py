"""Settings of the numerical runtime that must stand before JAX is imported."""

import os
import sys
from importlib import metadata
from pathlib import Path

from rtc_cli.errors import UsageError

_GPU_PLUGINS = ("jax-cuda", "jax-rocm")
_SINGLE_THREAD_FLAG = "--xla_cpu_multi_thread_eigen=false"


def use_threads(n: int | None) -> None:
    """Limit XLA and BLAS on the CPU to `n` threads; None changes nothing.

    Works through environment variables that are read once, so it must be called before JAX is
    imported; RuntimeError otherwise. Spawned worker processes inherit the setting.
    """
    if n is None:
        return
    if n < 1:
        raise UsageError(f"{n} threads are not possible", "give an integer >= 1")
    if "jax" in sys.modules and os.environ.get("NPROC") != str(n):
        raise RuntimeError("use_threads must be called before jax is imported")
    os.environ["NPROC"] = str(n)  # the size of XLA's own thread pool
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(n)
    flags = os.environ.get("XLA_FLAGS", "").split()
    flags = [flag for flag in flags if not flag.startswith("--xla_cpu_multi_thread_eigen")]
    if n == 1:
        flags.append(_SINGLE_THREAD_FLAG)
    os.environ["XLA_FLAGS"] = " ".join(flags)


def has_accelerator() -> bool:
    """Whether JAX would compute on a GPU, as far as its installed plugins tell; imports nothing."""
    if os.environ.get("JAX_PLATFORMS", "").startswith("cpu"):
        return False
    names = {(found.name or "").lower() for found in metadata.distributions()}
    return any(name.startswith(_GPU_PLUGINS) for name in names)


def share_accelerator() -> None:
    """Let several processes use one GPU: each takes memory as it needs it, not most at once."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def use_compilation_cache(folder: Path | str) -> None:
    """Keep compiled programs in a folder, so that a second start need not compile again."""
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": "0.5",
    }
    for name, value in settings.items():
        os.environ[name.upper()] = value
    if "jax" in sys.modules:
        import jax

        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
