"""The three numbers of a chunk request and the one place where they are checked."""

from dataclasses import dataclass, field

import jax
import numpy as np

from rtc_cli.errors import UsageError

Count = int | jax.Array
"""A number of control steps: a Python int, or a (possibly traced) int32 scalar array."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ChunkGeometry:
    """Horizon H, execution horizon s and delay d of a request, in control steps.

    Valid when `1 <= s <= H`, `0 <= d <= s` and `d <= H - s`. Concrete values are checked at
    construction (UsageError naming the three values and what is legal); traced values are not.
    A pytree: `exec_horizon` and `delay` are leaves, so one compiled program serves all cells;
    `horizon` is a shape and static. lerobot calls H - s, here `overlap`, "execution_horizon".
    """

    horizon: int = field(metadata={"static": True})
    exec_horizon: Count
    delay: Count

    def __post_init__(self) -> None:
        _check(self.horizon, known(self.exec_horizon), known(self.delay))

    @property
    def overlap(self) -> Count:
        """H - s: actions of the previous chunk that are unexecuted when inference starts."""
        return self.horizon - self.exec_horizon


def known(value: object) -> int | None:
    """Return the integer that `value` holds, None if it is traced or not an integer scalar."""
    if isinstance(value, jax.core.Tracer | bool):
        return None
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, jax.Array | np.ndarray) and value.ndim == 0:
        return int(value) if np.issubdtype(value.dtype, np.integer) else None
    return None


def _check(horizon: object, exec_horizon: int | None, delay: int | None) -> None:
    h = known(horizon)
    if h is None or h < 1:
        raise UsageError(f"horizon {horizon!r} is not possible", "give an integer >= 1")
    given = f"horizon {h}, exec_horizon {exec_horizon}, delay {delay}"
    if exec_horizon is not None and not 1 <= exec_horizon <= h:
        raise UsageError(
            f"{given}: exec_horizon must lie in 1..{h} (1 <= s <= H)",
            f"choose an exec_horizon from 1 to {h}",
        )
    if delay is None:
        return
    if delay < 0:
        raise UsageError(f"{given}: delay must be >= 0", "choose a delay >= 0")
    if exec_horizon is None:
        return
    longest = min(exec_horizon, h - exec_horizon)
    if delay > longest:
        raise UsageError(
            f"{given}: delay must be at most min(s, H - s) = {longest} (d <= s and d <= H - s)",
            _remedy(h, delay, exec_horizon),
        )


def _remedy(horizon: int, delay: int, exec_horizon: int) -> str:
    longest = min(exec_horizon, horizon - exec_horizon)
    if 2 * delay > horizon:
        return f"at horizon {horizon} no exec_horizon allows a delay above {horizon // 2}"
    return (
        f"choose a delay from 0 to {longest}, or for delay {delay} "
        f"an exec_horizon from {max(delay, 1)} to {horizon - delay}"
    )
