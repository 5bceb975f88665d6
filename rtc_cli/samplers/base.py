"""The vocabulary of samplers, and the loop that all of them share.

A sampler is a table of token times and an update rule. The table's distinct flow times are known
before any observation; in every Euler step each token has a row of it. Inside the loop arrays are
token-major (H, B, A); a request and a chunk are batch-major (B, H, A).
"""

import abc
import dataclasses
import functools
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rtc_cli.core.conditioning import Rows, select_rows
from rtc_cli.core.flow import Velocity
from rtc_cli.core.geometry import ChunkGeometry, known
from rtc_cli.core.policy import PhysicalActions
from rtc_cli.errors import UsageError


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ChunkRequest:
    """What a sampler is asked for; a pytree, so it may be an argument of `jax.jit`.

    noise: (B, H, A) float32, the chunk at tau = 0, in normalised action space.
    overlap: (B, H, A) float32, normalised: the unexecuted rest of the running chunk, overlap[:, 0]
        being the action due at the start of inference. Ignored from index H - s on. None: there
        is no previous chunk (only with delay 0); nothing guides then.
    delay: int32 (B,), each at most geometry.delay, replaces it per example.
    exec_horizon: int32 (B,), replaces geometry.exec_horizon per example, as delays that vary from
        one inference to the next make it; each example's own (s, d) has to be legal.
    flow_steps: K, the number of Euler steps.

    Raises TypeError for physical actions, UsageError for shapes, dtypes and concrete values that
    do not fit; traced values are not checked.
    """

    geometry: ChunkGeometry
    flow_steps: int = field(metadata={"static": True})
    noise: Float[Array, "B H A"]
    overlap: Float[Array, "B H A"] | None = None
    delay: Int[Array, " B"] | None = None
    exec_horizon: Int[Array, " B"] | None = None


class Field(Protocol):
    """A velocity field on a table of flow times: x (H, B, A), each token's row -> (H, B, A)."""

    def __call__(self, x: Float[Array, "H B A"], rows: Rows) -> Array: ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """A checked request, token-major.

    noise (H, B, A); overlap (H, B, A), zero from index H - s on, or None; delay and exec_horizon ()
    or (B,).
    """

    geometry: ChunkGeometry
    flow_steps: int = field(metadata={"static": True})
    noise: Float[Array, "H B A"]
    overlap: Float[Array, "H B A"] | None
    delay: Int[Array, "*B"]
    exec_horizon: Int[Array, "*B"]

    @property
    def prefix(self) -> Array:
        """Which tokens are committed: bool (H, 1) or (H, B)."""
        return jnp.arange(self.noise.shape[0])[:, None] < jnp.atleast_1d(self.delay)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Step:
    """One Euler step: its index k, its flow time k/K, its length 1/K."""

    index: Int[Array, ""]
    tau: Float[Array, ""]
    dt: float = field(metadata={"static": True})


@dataclass(frozen=True)
class Sampler(abc.ABC):
    """Maps (velocity, request) to a chunk (B, H, A). Frozen and hashable; fields are settings."""

    name: ClassVar[str]
    tile: ClassVar[int] = 64
    """Examples that pass through all steps together on a CPU: more would not fit its caches."""

    @property
    def settings(self) -> dict[str, Any]:
        """The settings by name."""
        return dataclasses.asdict(self)

    def times(self, flow_steps: int) -> np.ndarray:
        """The table's distinct flow times (N,); row k is that of step k."""
        return np.arange(flow_steps) / flow_steps

    def start(self, problem: Problem) -> Float[Array, "H B A"]:
        """The chunk before the first step."""
        return problem.noise

    @abc.abstractmethod
    def update(
        self, velocity: Field, x: Float[Array, "H B A"], step: Step, problem: Problem
    ) -> Float[Array, "H B A"]:
        """The chunk after one step."""

    def __call__(
        self, velocity: Velocity, request: ChunkRequest, *, unroll: bool = False
    ) -> Float[Array, "B H A"]:
        """Sample a chunk (B, H, A) float32.

        `velocity(x (B, H, A), tau (B, H)) -> (B, H, A)` is any function; one that offers
        `tabulate` (a policy's does) takes the fast path. `unroll` writes the steps out instead of
        looping over them and over tiles, for a compiler's cost analysis, which counts a loop's
        body once.
        """
        request = _checked(request)
        table = _field(velocity, self.times(request.flow_steps))
        if isinstance(table, _Opaque):
            return self._solve(table, request, unroll)
        batch = request.noise.shape[0]
        if unroll or batch <= self.tile or jax.default_backend() != "cpu":
            return self._solve(table, request, unroll)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((table, request))):
            return self._solve_in_tiles(table, request)
        return self._solve_in_threads(table, request)

    def path(self, velocity: Velocity, request: ChunkRequest) -> Float[Array, "K+1 B H A"]:
        """The chunk before each of the K steps, and after the last; to look into a sampler."""
        request = _checked(request)
        times = self.times(request.flow_steps)
        field_ = _field(velocity, times)
        problem, count = _token_major(request), request.flow_steps

        def body(x: Array, index: Array) -> tuple[Array, Array]:
            after = self.update(field_, x, _step(index, count), problem)
            return after, after

        start = self.start(problem)
        _, later = jax.lax.scan(body, start, jnp.arange(count))
        return jnp.swapaxes(jnp.concatenate([start[None], later]), 1, 2)

    def _solve(self, velocity: Field, request: ChunkRequest, unroll: bool = False) -> Array:
        problem = _token_major(request)
        count = request.flow_steps

        def body(x: Array, index: Array) -> tuple[Array, None]:
            return self.update(velocity, x, _step(index, count), problem), None

        x, _ = jax.lax.scan(
            body, self.start(problem), jnp.arange(count), unroll=count if unroll else 1
        )
        return jnp.swapaxes(x, 0, 1)

    def _solve_in_tiles(self, table: Any, request: ChunkRequest) -> Array:
        """Inside a traced program: a loop over tiles."""
        batch = request.noise.shape[0]
        parts = _tiles(self.tile, table, request)
        chunks = jax.lax.map(lambda part: self._solve(*_tile(table, request, part)), parts)
        return chunks.reshape(-1, *chunks.shape[2:])[:batch]

    def _solve_in_threads(self, table: Any, request: ChunkRequest) -> Array:
        """Outside of one: a compiled tile per call, on as many threads as there are cores.

        XLA shares the operations of one small tile between cores less well than two tiles share
        two cores.
        """
        batch = request.noise.shape[0]
        parts = _tiles(self.tile, table, request)
        tiles = [
            jax.tree.map(lambda leaf, i=i: leaf[i], parts) for i in range(-(-batch // self.tile))
        ]

        def solve(part: Any) -> Array:
            return jax.block_until_ready(_compiled(self, *_tile(table, request, part)))

        with ThreadPoolExecutor(os.cpu_count()) as threads:
            return jnp.concatenate(list(threads.map(solve, tiles)))[:batch]


@functools.partial(jax.jit, static_argnums=0)
def _compiled(sampler: Sampler, table: Any, request: ChunkRequest) -> Array:
    return sampler._solve(table, request)


def _tile(table: Any, request: ChunkRequest, part: Any) -> tuple[Any, ChunkRequest]:
    """The field and the request of one tile."""
    observed, noise, overlap, delay, exec_horizon = part
    tile = dataclasses.replace(
        request, noise=noise, overlap=overlap, delay=delay, exec_horizon=exec_horizon
    )
    return table.part(observed), tile


def _tiles(size: int, table: Any, request: ChunkRequest) -> Any:
    """What belongs to an example, as tiles (T, size, ...), the last one padded."""

    def split(leaf: Array) -> Array:
        tiles = -(-leaf.shape[0] // size)
        padding = [(0, tiles * size - leaf.shape[0])] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, padding).reshape(tiles, size, *leaf.shape[1:])

    own = (request.noise, request.overlap, request.delay, request.exec_horizon)
    return jax.tree.map(split, (table.observed, *own))


@dataclass(frozen=True)
class _Opaque:
    """Any velocity function as a field on a table: each token's time is looked up."""

    velocity: Velocity
    times: Float[Array, " N"]

    def __call__(self, x: Float[Array, "H B A"], rows: Rows) -> Array:
        tau = jnp.broadcast_to(select_rows(rows)(self.times[:, None])[..., 0], x.shape[:2])
        return jnp.swapaxes(self.velocity(jnp.swapaxes(x, 0, 1), tau.T), 0, 1)


def _field(velocity: Velocity, times: np.ndarray) -> Any:
    """The velocity on a table of flow times, by its own fast path if it has one."""
    if hasattr(velocity, "tabulate"):
        return velocity.tabulate(times)
    return _Opaque(velocity, jnp.asarray(times, jnp.float32))


def _step(index: Array, count: int) -> Step:
    return Step(index, index.astype(jnp.float32) / count, 1 / count)


def _token_major(request: ChunkRequest) -> Problem:
    geometry, noise = request.geometry, jnp.swapaxes(request.noise, 0, 1)
    delay = jnp.asarray(geometry.delay if request.delay is None else request.delay)
    own = request.exec_horizon
    exec_horizon = jnp.asarray(geometry.exec_horizon if own is None else own)
    overlap = request.overlap
    if overlap is not None:
        # What lies beyond the overlap is unknown (NaN, perhaps) and must not leak through 0 * x.
        length = noise.shape[0] - jnp.atleast_1d(exec_horizon)
        known_tokens = (jnp.arange(noise.shape[0])[:, None] < length)[..., None]
        overlap = jnp.where(known_tokens, jnp.swapaxes(overlap, 0, 1), 0.0)
    return Problem(geometry, request.flow_steps, noise, overlap, delay, exec_horizon)


def _checked(request: ChunkRequest) -> ChunkRequest:
    steps = known(request.flow_steps)
    if steps is None or steps < 1:
        raise UsageError(
            f"flow_steps {request.flow_steps!r} is not possible", "give an integer >= 1"
        )
    noise = _actions("noise", request.noise)
    horizon = request.geometry.horizon
    if noise.ndim != 3 or noise.shape[1] != horizon:
        raise UsageError(f"noise has shape {noise.shape}, needed is (B, {horizon}, A)")
    overlap = request.overlap
    if overlap is not None:
        overlap = _actions("overlap", overlap)
        if overlap.shape != noise.shape:
            raise UsageError(f"overlap has shape {overlap.shape}, noise {noise.shape}: must agree")
    delay = _checked_delay(request, noise.shape[0])
    longest = known(request.geometry.delay) if delay is None else _largest(delay)
    if overlap is None and longest:
        raise UsageError(
            f"delay {longest} without an overlap: there is no committed action",
            "give the previous chunk as overlap, or use delay 0",
        )
    own = None
    if request.exec_horizon is not None:
        own = _per_example("exec_horizon", request.exec_horizon, noise.shape[0])
        _check_pairs(horizon, own, request.geometry.delay if delay is None else delay)
    return dataclasses.replace(request, noise=noise, overlap=overlap, delay=delay, exec_horizon=own)


def _actions(name: str, value: Any) -> Array:
    if isinstance(value, PhysicalActions):
        raise TypeError(
            f"{name} is in physical units; samplers work on normalised actions:"
            " use Normaliser.actions(...) first"
        )
    given = value if isinstance(value, jax.Array | np.ndarray) else np.asarray(value)
    if given.dtype != np.float32:
        raise UsageError(f"{name} has dtype {given.dtype}, needed is float32", "convert it")
    return jnp.asarray(given)


def _checked_delay(request: ChunkRequest, batch: int) -> Array | None:
    if request.delay is None:
        return None
    delay = _per_example("delay", request.delay, batch)
    limit, largest = known(request.geometry.delay), _largest(delay)
    if largest is not None and (int(delay.min()) < 0 or (limit is not None and largest > limit)):
        raise UsageError(
            f"per-example delays {np.asarray(delay).tolist()} must lie in 0..{limit}"
            " (geometry.delay)",
            "choose geometry.delay as the largest of them",
        )
    return delay


def _per_example(name: str, value: Any, batch: int) -> Array:
    given = jnp.asarray(value)
    if given.shape != (batch,) or not jnp.issubdtype(given.dtype, jnp.integer):
        raise UsageError(
            f"{name} has shape {given.shape} and dtype {given.dtype}, needed is int32 ({batch},)"
        )
    return given.astype(jnp.int32)


def _check_pairs(horizon: int, exec_horizon: Array, delay: Any) -> None:
    """Check each example's own (s, d), as `ChunkGeometry` does; traced values are not."""
    if any(isinstance(value, jax.core.Tracer) for value in (exec_horizon, delay)):
        return
    pairs = np.stack(np.broadcast_arrays(np.asarray(exec_horizon), np.asarray(delay)), axis=1)
    for s, d in np.unique(pairs, axis=0).tolist():
        ChunkGeometry(horizon=horizon, exec_horizon=s, delay=d)


def _largest(delay: Array) -> int | None:
    return None if isinstance(delay, jax.core.Tracer) else int(delay.max(initial=0))
