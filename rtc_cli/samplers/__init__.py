"""Samplers: (velocity, request) -> chunk. The public interface.

geometry = ChunkGeometry(horizon=8, exec_horizon=2, delay=2)
request = ChunkRequest(geometry=geometry, flow_steps=5, noise=noise, overlap=overlap)
chunk = get_sampler("pinv", max_guidance_weight=5.0)(velocity, request)
"""

import dataclasses
from importlib.metadata import entry_points
from typing import Any

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.samplers.base import ChunkRequest, Sampler
from rtc_cli.samplers.pinv import Pinv
from rtc_cli.samplers.pinv_detached import PinvDetached
from rtc_cli.samplers.plain import Plain
from rtc_cli.samplers.prefix import Prefix

__all__ = ["ChunkRequest", "Sampler", "get_sampler", "list_samplers"]

_SAMPLERS: dict[str, type[Sampler]] = {
    kind.name: kind for kind in (Plain, Pinv, PinvDetached, Prefix)
}


def list_samplers() -> tuple[str, ...]:
    """Names of the built-in samplers and of those that installed packages add."""
    plugins = entry_points(group="rtc_cli.samplers").names
    return (*_SAMPLERS, *sorted(set(plugins) - _SAMPLERS.keys()))


def get_sampler(name: str, **settings: Any) -> Sampler:
    """Return a sampler with its settings.

    UsageError for an unknown name or setting, or a value that is not allowed. A package adds a
    sampler with an entry point in the group `rtc_cli.samplers` that loads a `Sampler` class.
    """
    kind = _find(name)
    allowed = [field.name for field in dataclasses.fields(kind)]
    for setting in settings:
        if setting not in allowed:
            raise UsageError(
                f'sampler "{name}" has no setting "{setting}".{did_you_mean(setting, allowed)}'
            )
    return kind(**settings)


def _find(name: str) -> type[Sampler]:
    if name in _SAMPLERS:
        return _SAMPLERS[name]
    for plugin in entry_points(group="rtc_cli.samplers", name=name):
        return plugin.load()
    raise UsageError(f'unknown sampler "{name}".{did_you_mean(name, list_samplers())}')
