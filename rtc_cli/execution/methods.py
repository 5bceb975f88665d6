"""Methods: display names for (checkpoint, sampler, schedule), and the registry of them.

A *checkpoint* is ``base`` or ``prefix`` (trained with simulated delay), a *sampler* turns noise
into a chunk, a *schedule* says how chunks are executed. The matrix methods are named
``checkpoint+sampler``, for {base, prefix} x {plain, pinv, prefix}; those that are the same triple
as a named method share its results, because results are keyed by content and not by name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.execution.timeline import check_schedule

CHECKPOINTS = ("base", "prefix")
MATRIX_SAMPLERS = ("plain", "pinv", "prefix")

Setting = float | int | str | bool


@dataclass(frozen=True)
class Method:
    """A display name for a checkpoint, a sampler with its settings, and a schedule."""

    name: str
    checkpoint: str
    sampler: str
    settings: tuple[tuple[str, Setting], ...] = ()
    schedule: str = "async"

    def __post_init__(self) -> None:
        check_schedule(self.schedule)
        if self.checkpoint not in CHECKPOINTS:
            hint = did_you_mean(self.checkpoint, CHECKPOINTS)
            raise UsageError(f'unknown checkpoint "{self.checkpoint}".{hint}')
        if self.schedule != "async" and self.sampler != "plain":
            raise UsageError(
                f'schedule "{self.schedule}" cannot use sampler "{self.sampler}": it has no '
                "overlap to condition on",
                'use sampler "plain", or schedule "async"',
            )

    @property
    def untrained(self) -> bool:
        """Whether the sampler asks the checkpoint for something it was never trained for."""
        return self.checkpoint == "base" and self.sampler == "prefix"

    def with_settings(self, name: str | None = None, **settings: Setting) -> Method:
        """The same method with other sampler settings, shown as ``name`` or ``<name>-tuned``."""
        merged = dict(self.settings) | settings
        ordered: tuple[tuple[str, Any], ...] = tuple(sorted(merged.items()))
        return replace(self, name=name or f"{self.name}-tuned", settings=ordered)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("sync", "base", "plain", schedule="sync"),
        Method("naive", "base", "plain"),
        Method("pinv", "base", "pinv"),
        Method("pinv-detached", "base", "pinv-detached"),
        Method("prefix", "prefix", "prefix"),
        Method("oracle", "base", "plain", schedule="oracle"),
    )
}

MATRIX: dict[str, Method] = {
    f"{checkpoint}+{sampler}": Method(f"{checkpoint}+{sampler}", checkpoint, sampler)
    for checkpoint in CHECKPOINTS
    for sampler in MATRIX_SAMPLERS
}


def list_methods() -> tuple[str, ...]:
    """Names of all methods: the named ones, then the matrix."""
    return (*METHODS, *MATRIX)


def get_method(name: str) -> Method:
    """The method of that name; UsageError with the allowed names otherwise."""
    method = METHODS.get(name) or MATRIX.get(name)
    if method is None:
        raise UsageError(f'unknown method "{name}".{did_you_mean(name, list_methods())}')
    return method


def get_methods(names: Iterable[str], *, matrix: bool = False) -> tuple[Method, ...]:
    """The methods of these names, each once, in this order; ``matrix`` adds the whole matrix."""
    wanted = (*names, *(MATRIX if matrix else ()))
    return tuple(get_method(name) for name in dict.fromkeys(wanted))
