"""How much XLA optimises what the tests compile."""

from pathlib import Path

import pytest

QUICK = {"core", "analysis", "test_samplers.py", "test_profile.py"}
"""Folders and files whose tests compare results within tolerances, and never time anything.

Most of their time would go into compiling small programs that run once. All other tests compile
as users do: those that compare bit for bit, train, or check the samplers' golden values.
"""
_is_quick = False


@pytest.fixture(scope="module", autouse=True)
def quick_compilation(request: pytest.FixtureRequest) -> None:
    """Compile this module's programs without most optimisations, if it is a quick one.

    Programs are kept in memory by what they compute and not by how they were compiled: they are
    dropped where the setting changes.
    """
    global _is_quick
    quick = bool(QUICK & set(request.path.relative_to(Path(__file__).parent).parts))
    if quick != _is_quick:
        import jax

        jax.config.update("jax_disable_most_optimizations", quick)
        jax.clear_caches()
        _is_quick = quick
