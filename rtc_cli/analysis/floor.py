"""The least time a chunk can take on this device: what it must read and compute at measured rates.

`Ceilings` are measured in the run of the profile itself: a large copy, a large matrix product in
the network's dtype. A program's `Needs` are counted, not measured. At batch 1 a large network is
bound by memory on most devices: its weights do not fit any cache and are read again in each step.

The floor is a bound for this way of computing, K steps one after another, at these ceilings. A copy
reads and writes; a device that reads faster than it copies can come out a little below 1.
"""

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_COPY_BYTES = 2**28
_MATRIX = {"cpu": 2048}
_MATRIX_ELSEWHERE = 8192
_TRIES = 7
_CACHED_BELOW = 2**16
"""Arrays smaller than this (bytes) stay in a cache from step to step and are not counted."""
_CACHES = 2**26
"""Nor are those of a network that is smaller than this: all of it stays there."""


@dataclass(frozen=True)
class Ceilings:
    """The best of several tries: bytes read plus written per second; flops per second."""

    bytes_per_s: float
    flops_per_s: float
    dtype: str


@dataclass(frozen=True)
class Needs:
    """What one chunk has to read from memory (bytes) and compute (flops, None if not known)."""

    bytes: int
    flops: float | None

    def floor_ms(self, ceilings: Ceilings) -> float:
        """max(bytes / bandwidth, flops / rate) in milliseconds."""
        compute = 0.0 if self.flops is None else self.flops / ceilings.flops_per_s
        return 1000 * max(self.bytes / ceilings.bytes_per_s, compute)


def measure_ceilings(dtype: Any) -> Ceilings:
    """Measure the default device: a copy of 256 MiB, a square matrix product in `dtype`."""
    size = _MATRIX.get(jax.default_backend(), _MATRIX_ELSEWHERE)
    source = jnp.ones(_COPY_BYTES // 4, jnp.float32)
    matrix = jnp.ones((size, size), dtype)
    copy_s = _best(jax.jit(lambda x: x + 1), source)
    product_s = _best(jax.jit(lambda a: a @ a), matrix)
    return Ceilings(2 * _COPY_BYTES / copy_s, 2 * size**3 / product_s, np.dtype(dtype).name)


def bytes_read(function: Any, *arguments: Any) -> int:
    """Bytes of arrays that are inputs of a function, each as often as an operation reads it.

    Counted on the function's jaxpr: in a loop once per turn, in a forward and a backward pass once
    each. An input that nothing reads does not count, and what is small enough for a cache never.
    """
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    sizes = [int(np.prod(v.aval.shape)) * v.aval.dtype.itemsize for v in jaxpr.invars]
    counted = [
        (count, size)
        for count, size in zip(_reads(jaxpr), sizes, strict=True)
        if count and size >= _CACHED_BELOW
    ]
    if sum(size for _, size in counted) < _CACHES:
        return 0
    return sum(count * size for count, size in counted)


def _reads(jaxpr: Any) -> list[int]:
    """How often each input of a jaxpr is read by an operation, in loops and calls too."""
    reads: dict[Any, int] = dict.fromkeys(jaxpr.invars, 0)
    for equation in jaxpr.eqns:
        inputs = [None if hasattr(v, "val") else v for v in equation.invars]
        inner = _body(equation)
        times = [1] * len(inputs) if inner is None else _reads(inner)
        turns = equation.params.get("length", 1) if inner is not None else 1
        for variable, count in zip(inputs, times, strict=True):
            if variable in reads:
                reads[variable] += turns * count
    return [reads[v] for v in jaxpr.invars]


def _body(equation: Any) -> Any:
    """The jaxpr that a loop or a call runs; None for an operation of its own."""
    for value in equation.params.values():
        inner = getattr(value, "jaxpr", value)
        if hasattr(inner, "eqns") and len(inner.invars) == len(equation.invars):
            return inner
    return None


def _best(function: Any, argument: Any) -> float:
    function(argument).block_until_ready()
    times = []
    for _ in range(_TRIES):
        start = time.perf_counter()
        function(argument).block_until_ready()
        times.append(time.perf_counter() - start)
    return min(times)
