"""Chunks for batches of episodes, in padded tiles of one fixed size.

XLA's results differ in the last bits between batch sizes, so every inference runs on exactly
``tile`` rows, the unused ones padded; a row's result does not depend on the other rows. The
initial noise of a chunk is a function of (evaluation seed, task name, episode, tick of the start
of inference) only: the same for all methods, checkpoints and delays.
"""

from __future__ import annotations

import zlib
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpy.typing import NDArray

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import PhysicalActions, Policy, TimeTable
from rtc_cli.errors import DivergedError
from rtc_cli.execution.timeline import FIRST_CHUNK_TICK
from rtc_cli.execution.worlds import FloatArray, IntArray
from rtc_cli.samplers import ChunkRequest, Sampler

TILE = 32
"""Rows of one inference. Processor time per row hardly depends on it from 16 to 64; a smaller tile
wastes less on the last few long episodes, a larger one less on calls (``benchmarks/evaluation.py``
measures both)."""


def noise_key(eval_seed: int, task: str) -> PRNGKeyArray:
    """The key that all initial noise of an evaluation of one task derives from."""
    return jax.random.fold_in(jax.random.key(eval_seed), zlib.crc32(task.encode()))


def chunk_noise(
    key: PRNGKeyArray, episodes: Int[Array, " B"], ticks: Int[Array, " B"], shape: tuple[int, int]
) -> Float[Array, "B H A"]:
    """Standard normal noise (B, H, A) of the chunks whose inference starts at these ticks.

    ``FIRST_CHUNK_TICK`` stands for the free chunk of an episode, which shares its observation
    with the inference at tick 0 but not its noise.
    """

    def one(episode: Array, tick: Array) -> Array:
        own = jax.random.fold_in(jax.random.fold_in(key, episode), tick - FIRST_CHUNK_TICK)
        return jax.random.normal(own, shape, jnp.float32)

    return jax.vmap(one)(episodes, ticks)


@partial(jax.jit, static_argnames=("sampler", "flow_steps"))
def infer(
    policy: Policy,
    table: TimeTable,
    key: PRNGKeyArray,
    observations: Float[Array, "B O"],
    episodes: Int[Array, " B"],
    ticks: Int[Array, " B"],
    overlap: Float[Array, "B H A"],
    exec_horizon: Int[Array, ""],
    delay: Int[Array, ""],
    own: tuple[Int[Array, " B"], Int[Array, " B"]] | None = None,
    *,
    sampler: Sampler,
    flow_steps: int,
) -> tuple[Float[Array, "B H A"], PhysicalActions]:
    """One chunk per row, normalised and in physical units.

    Execution horizon and delay are traced: one compiled program per sampler and number of flow
    steps serves all cells, and all policies of one shape; rows with their ``own`` (s, d) have
    another one. Observations are physical.
    """
    config = policy.config
    horizon = config.horizon
    request = ChunkRequest(
        geometry=ChunkGeometry(horizon=horizon, exec_horizon=exec_horizon, delay=delay),
        flow_steps=flow_steps,
        noise=chunk_noise(key, episodes, ticks, (horizon, config.action_dim)),
        overlap=overlap,
        exec_horizon=None if own is None else own[0],
        delay=None if own is None else own[1],
    )
    normalised = policy.normaliser.observations(observations)
    chunk = sampler(policy.velocity(normalised, table), request)
    return chunk, policy.normaliser.physical(chunk)


class ChunkMaker:
    """Chunks of one policy for one cell, for up to ``tile`` episodes at a time.

    Safe to use from one thread other than the one that made it.
    """

    def __init__(
        self,
        policy: Policy,
        geometry: ChunkGeometry,
        *,
        flow_steps: int,
        task: str,
        eval_seed: int,
        tile: int,
    ) -> None:
        self._policy = jax.device_put(policy)
        self._exec_horizon = np.int32(geometry.exec_horizon)
        self._delay = np.int32(geometry.delay)
        self._flow_steps = flow_steps
        self._key = noise_key(eval_seed, task)
        self._task = task
        self._tables: dict[Sampler, TimeTable] = {}
        self.tile = tile

    @property
    def shape(self) -> tuple[int, int]:
        """(H, A) of a chunk."""
        return self._policy.config.horizon, self._policy.config.action_dim

    @property
    def obs_dim(self) -> int:
        """Size of an observation."""
        return self._policy.config.obs_dim

    @cached_property
    def zero_action(self) -> FloatArray:
        """(2, A) the action that is zero in physical units: normalised, and physical."""
        zero = np.zeros(self.shape[1], np.float32)
        normalised = self._policy.normaliser.actions(PhysicalActions(jnp.asarray(zero)))
        return np.stack([np.asarray(normalised), zero])

    def first(self, sampler: Sampler, observations: FloatArray, episodes: IntArray) -> FloatArray:
        """(m, 2, H, A) the free chunk of each episode: no previous chunk, no delay."""
        ticks = np.full(len(episodes), FIRST_CHUNK_TICK)
        overlap = np.zeros((len(episodes), *self.shape), np.float32)
        return self._run(sampler, observations, episodes, ticks, overlap, np.int32(0))

    def next(
        self,
        sampler: Sampler,
        observations: FloatArray,
        episodes: IntArray,
        ticks: IntArray,
        overlap: FloatArray,
        own: tuple[IntArray, IntArray] | None = None,
    ) -> FloatArray:
        """(m, 2, H, A) the next chunk of each episode: normalised, and in physical units.

        Args:
            observations: (m, O) physical, m ≤ tile.
            episodes: (m,) numbers of the episodes.
            ticks: (m,) control ticks at which these inferences start.
            overlap: (m, H, A) normalised; what lies from H - s on is ignored.
            own: (m,) execution horizons and (m,) delays that replace the cell's, row by row.

        Raises:
            DivergedError: the policy produced NaN or infinity.
        """
        return self._run(sampler, observations, episodes, ticks, overlap, self._delay, own)

    def _run(
        self,
        sampler: Sampler,
        observations: FloatArray,
        episodes: IntArray,
        ticks: IntArray,
        overlap: FloatArray,
        delay: np.int32,
        own: tuple[IntArray, IntArray] | None = None,
    ) -> FloatArray:
        count = len(episodes)
        chunk, physical = infer(
            self._policy,
            self._table(sampler),
            self._key,
            self._pad(observations, np.float32),
            self._pad(episodes, np.int32),
            self._pad(ticks, np.int32),
            self._pad(overlap, np.float32),
            self._exec_horizon,
            delay,
            None if own is None else (self._pad(own[0], np.int32), self._pad(own[1], np.int32)),
            sampler=sampler,
            flow_steps=self._flow_steps,
        )
        result = np.asarray(chunk)[:count]
        finite = np.isfinite(result).all(axis=(1, 2))
        if not finite.all():
            bad = int(np.flatnonzero(~finite)[0])
            raise DivergedError(
                f"the policy produced NaN or infinity on task {self._task}, episode "
                f"{episodes[bad]}, tick {max(int(ticks[bad]), 0)}",
                "train again, or evaluate another checkpoint",
            )
        return np.stack([result, np.asarray(physical.array)[:count]], axis=1)

    def _table(self, sampler: Sampler) -> TimeTable:
        if sampler not in self._tables:
            self._tables[sampler] = self._policy.time_table(sampler.times(self._flow_steps))
        return self._tables[sampler]

    def _pad(self, rows: NDArray[np.generic], dtype: type) -> NDArray[np.generic]:
        padded = np.zeros((self.tile, *rows.shape[1:]), dtype)
        padded[: len(rows)] = rows
        return padded
