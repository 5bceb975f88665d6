"""Networks by name, with random weights: what a profile can be made of without a run."""

from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from rtc_cli.core.policy import (
    Normaliser,
    Policy,
    PolicyConfig,
    get_network,
    list_networks,
    parameter_shapes,
)
from rtc_cli.errors import UsageError, did_you_mean


@dataclass(frozen=True)
class Preset:
    """A network's kind and sizes, and those of what goes in and out of it."""

    kind: str
    sizes: dict[str, int]
    horizon: int = 8
    obs_dim: int = 40  # Kinetix-sized, as action_dim
    action_dim: int = 6


_GEMMA_HEADS = {"heads": 8, "head_dim": 256, "context": 968}
"""968 tokens: three images of 256 and a prompt of 200, as in openpi's policies."""

PRESETS = {
    "quickstart": Preset(
        "mixer", {"layers": 2, "channels": 64, "channel_hidden": 128, "token_hidden": 32}
    ),
    "paper": Preset(
        "mixer", {"layers": 4, "channels": 256, "channel_hidden": 512, "token_hidden": 64}
    ),
    # The sizes of pi0's and pi0.5's action expert (openpi: gemma_300m).
    "expert-300m": Preset(
        "transformer",
        {"layers": 18, "channels": 1024, "channel_hidden": 4096, "kv_heads": 1} | _GEMMA_HEADS,
        horizon=50,
        obs_dim=32,
        action_dim=32,
    ),
    # As many parameters as are reported of pi0.6's expert, whose sizes are not published: depth
    # and key heads of Gemma 3 4B, with which it shares the context's keys, width and MLP ours.
    "expert-860m": Preset(
        "transformer",
        {"layers": 34, "channels": 1280, "channel_hidden": 4608, "kv_heads": 4} | _GEMMA_HEADS,
        horizon=50,
        obs_dim=32,
        action_dim=32,
    ),
}
"""Networks that `rtc profile --network` knows beside the registered ones."""


def random_policy(
    network: str, horizon: int | None = None, *, dtype: str = "float32", seed: int = 0
) -> Policy:
    """Return a policy of a preset's size with random weights, adaLN's included (not zero).

    `network` is a preset or a registered network at its default sizes; `horizon` None is the
    preset's. `dtype` is "float32", or "bfloat16" for networks that have it. UsageError where
    the machine's memory will not hold it.
    """
    config = preset_config(network, horizon, dtype)
    check_memory(config, network)
    normaliser = Normaliser.identity(config.obs_dim, config.action_dim)
    return Policy.init(config, normaliser, jax.random.key(seed), adaln_zero=False)


def preset_config(network: str, horizon: int | None = None, dtype: str = "float32") -> PolicyConfig:
    """The configuration behind a network's name; UsageError for an unknown name or dtype."""
    preset = _preset(network)
    sizes = dict(preset.sizes)
    if dtype not in ("float32", "bfloat16"):
        raise UsageError(f'unknown dtype "{dtype}"', "use float32 or bfloat16")
    if dtype == "bfloat16":
        if preset.kind == "mixer":
            raise UsageError(f'network "{network}" has no bfloat16', "use float32, or an expert")
        sizes["bfloat16"] = 1
    return PolicyConfig(
        preset.kind,
        tuple(sizes.items()),
        preset.horizon if horizon is None else horizon,
        preset.obs_dim,
        preset.action_dim,
    )


def check_memory(config: PolicyConfig, name: str) -> None:
    """Raise UsageError if the parameters alone, twice while they are drawn, exceed the memory."""
    leaves = jax.tree.leaves(parameter_shapes(config))
    needed = 2 * sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)
    free = free_memory()
    if free is not None and needed > free:
        raise UsageError(
            f'network "{name}" needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free',
            "use --dtype bfloat16, a smaller network, or a machine with more memory",
        )


def free_memory() -> int | None:
    """Bytes that the default device can still give; None where it does not say."""
    device = jax.devices()[0]
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    rooms = [room for room in (_machine_room(), _container_room()) if room is not None]
    return min(rooms, default=None)


def _machine_room() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found = dict(line.split(":", 1) for line in lines)
        return int(found["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None


def _container_room(groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """What a control group (a container, a batch system) still allows; None without a limit."""
    names = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
    for limit, used in names:
        try:
            allowed, taken = ((groups / name).read_text(encoding="ascii") for name in (limit, used))
            return int(allowed) - int(taken)
        except (OSError, ValueError):  # "max" stands for no limit
            continue
    return None


def _preset(name: str) -> Preset:
    if name in PRESETS:
        return PRESETS[name]
    allowed = (*PRESETS, *list_networks())
    if name not in allowed:
        raise UsageError(f'unknown network "{name}".{did_you_mean(name, allowed)}')
    get_network(name)
    return Preset(name, {})
