"""The time of one chunk per sampler, measured side by side.

All programs are compiled first and warmed up; then rounds follow, and in each every program is
called once, in an order drawn anew, and waited for. So a machine that slows down slows all of
them down, and the ratio to `plain` is taken within rounds. One chunk is everything from a
normalised observation to a chunk: the observation's projection and all flow steps. The time table
belongs to the checkpoint and is computed before, as in an evaluation. So are the keys and values of
a network with a context: they are a vision-language model's work, and enter as a fixed cost.

The baseline `prefix-per-token` is what a user would write first: batch-major, time embedding and
adaLN for every token in every step.
"""

import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtc_cli.analysis.floor import Ceilings, Needs, bytes_read, measure_ceilings
from rtc_cli.analysis.networks import random_policy
from rtc_cli.core.flow import Velocity
from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy
from rtc_cli.errors import UsageError
from rtc_cli.files import write_json
from rtc_cli.fixed_costs import FixedCosts, check_costs, percentile_with
from rtc_cli.samplers import ChunkRequest, Sampler, get_sampler
from rtc_cli.units import Rounding, latency_to_delay

PER_TOKEN = "prefix-per-token"
"""The straightforward prefix sampler: a baseline of profiles, not in the registry of samplers."""

RATIO_METHOD = (
    "ratio of medians; 95% percentile interval of a bootstrap over rounds, paired within a round"
)
DELAY_FROM = "p95_ms"
"""The figure, fixed costs added, that delays are made of: a chunk should seldom be late."""

WARM_UP_CALLS = 3
_RESAMPLES = 2000

Sample = Callable[..., Float[Array, "B H A"]]
Progress = Callable[[int, int], None]
"""`progress(done, total)`: programs compiled and rounds done."""


@dataclass(frozen=True)
class Program:
    """One compiled sampler and what is known before it is timed.

    `memory` is what the program holds at most, its inputs included (bytes); `flops` and `bytes`
    are XLA's counts for one call, None where it does not say.
    """

    sampler: str
    call: Callable[[], Array]
    compile_s: float
    memory: int | None
    flops: float | None
    bytes: float | None
    needs: Needs


@dataclass(frozen=True)
class Clock:
    """What turns milliseconds into a delay.

    `fixed_ms` are the costs around the network (see `fixed_costs`).
    """

    hz: float = 30.0
    rounding: Rounding = "ceil"
    fixed_ms: FixedCosts = field(default_factory=dict)

    def __post_init__(self) -> None:
        latency_to_delay(0.0, self.hz, self.rounding)  # refuses a bad rate
        check_costs(self.fixed_ms)


def profile_samplers(
    network: Policy | str,
    samplers: Sequence[str],
    *,
    batch: Sequence[int] = (1,),
    horizon: int | None = None,
    flow_steps: Sequence[int] = (5,),
    rounds: int = 50,
    clock: Clock | None = None,
    dtype: str = "float32",
    label: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Time `plain`, the named samplers and `prefix-per-token`; one row each per K and batch size.

    `network` is a policy, or a name that `random_policy` knows (then `horizon` and `dtype` set its
    size). `label` is the rows' `network`. Guided samplers have their default settings.
    Milliseconds; `flops` and `bytes` (null where the compiler does not say) are XLA's for one
    call; `floor_ms` is the least time at the ceilings measured now (see `floor`); `total_*` has the
    clock's fixed costs in it, and so have the delays, which are made of its 95th percentile.
    """
    _check_settings(samplers, rounds, batch, flow_steps)
    policy = _policy(network, horizon, dtype, seed)
    functions = _functions(samplers)
    name = label or (network if isinstance(network, str) else policy.config.network)
    ceilings = measure_ceilings(network_dtype(policy))
    cells = [(size, steps) for size in batch for steps in flow_steps]
    each = len(functions) + rounds
    rows: list[dict[str, Any]] = []
    for number, (size, steps) in enumerate(cells):
        report = _offset(progress, number * each, len(cells) * each)
        with _no_compilation_cache():
            programs = _compile_all(functions, policy, size, steps, seed, report)
        times = _time(programs, rounds, seed, report)
        shared = {"network": name, "dtype": ceilings.dtype, "batch": size}
        shared |= {"horizon": policy.config.horizon, "flow_steps": steps, "rounds": rounds}
        rows += _rows(programs, times, shared, clock or Clock(), ceilings)
    return rows


def network_dtype(policy: Policy) -> Any:
    """The dtype of most of a policy's parameters."""
    leaves = jax.tree.leaves(policy.params)
    return max(leaves, key=lambda leaf: leaf.size).dtype


def save_profile(path: Path | str, rows: Sequence[Mapping[str, Any]], machine: Any) -> None:
    """Write a run's `results/profile.json`."""
    write_json(path, {"schema": 1, "machine": machine, "rows": list(rows)})


def prefix_per_token(
    velocity: Velocity, request: ChunkRequest, *, unroll: bool = False
) -> Float[Array, "B H A"]:
    """Training-time RTC as its listing reads: every token carries its own flow time."""
    count, (_, horizon, _) = request.flow_steps, request.noise.shape
    clean = (jnp.arange(horizon) < request.geometry.delay)[None]
    overlap = request.noise if request.overlap is None else request.overlap

    def step(x: Array, index: Array) -> tuple[Array, None]:
        x = jnp.where(clean[..., None], overlap, x)
        tau = jnp.where(clean, 1.0, index.astype(jnp.float32) / count)
        return x + velocity(x, jnp.broadcast_to(tau, x.shape[:2])) / count, None

    x, _ = jax.lax.scan(step, request.noise, jnp.arange(count), unroll=count if unroll else 1)
    return jnp.where(clean[..., None], overlap, x)


def ratio_interval(
    times: np.ndarray, baseline: np.ndarray, seed: int = 0
) -> tuple[float, float, float]:
    """Return (ratio, low, high) of the medians of paired samples (R,), as RATIO_METHOD says."""
    generator = np.random.Generator(np.random.Philox(seed))
    picks = generator.integers(0, len(times), size=(_RESAMPLES, len(times)))
    ratios = np.median(times[picks], axis=1) / np.median(baseline[picks], axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(np.median(times) / np.median(baseline)), float(low), float(high)


def _check_settings(
    samplers: Sequence[str], rounds: int, batch: Sequence[int], flow_steps: Sequence[int]
) -> None:
    if not samplers:
        raise UsageError("no sampler is named", "name at least one with --sampler")
    if rounds < 2:
        raise UsageError(f"{rounds} rounds are too few", "give at least 2; 50 is usual")
    for name, values in (("batch", batch), ("flow steps", flow_steps)):
        for value in values:
            if value < 1:
                raise UsageError(f"{name} {value} is not possible", "give integers >= 1")


def _policy(network: Policy | str, horizon: int | None, dtype: str, seed: int) -> Policy:
    if isinstance(network, str):
        return random_policy(network, horizon, dtype=dtype, seed=seed)
    if horizon not in (None, network.config.horizon):
        raise UsageError(
            f"horizon {horizon} does not fit a policy of horizon {network.config.horizon}",
            "leave the horizon away, or profile random weights",
        )
    return network


def _functions(samplers: Sequence[str]) -> dict[str, Sample]:
    names = dict.fromkeys(("plain", *samplers))
    names.pop(PER_TOKEN, None)
    return {name: get_sampler(name) for name in names} | {PER_TOKEN: prefix_per_token}


def _compile_all(
    functions: Mapping[str, Sample],
    policy: Policy,
    batch: int,
    flow_steps: int,
    seed: int,
    report: Callable[[], None],
) -> list[Program]:
    inputs = _inputs(policy, batch, seed)
    programs = []
    for name, sample in functions.items():
        programs.append(_compile(name, sample, policy, inputs, flow_steps))
        report()
    return programs


def _inputs(policy: Policy, batch: int, seed: int) -> tuple[Array, ...]:
    """Observations, noise, overlap, s and d; the last two are traced and cost the same."""
    config, key = policy.config, jax.random.key(seed)
    shape = (batch, config.horizon, config.action_dim)
    delay = min(2, config.horizon // 2)
    return (
        jax.random.normal(jax.random.fold_in(key, 0), (batch, config.obs_dim)),
        jax.random.normal(jax.random.fold_in(key, 1), shape),
        jax.random.normal(jax.random.fold_in(key, 2), shape),
        jnp.int32(max(delay, 1)),
        jnp.int32(delay),
    )


def _compile(
    name: str, sample: Sample, policy: Policy, inputs: tuple[Array, ...], flow_steps: int
) -> Program:
    def chunk(
        policy: Policy, given: Any, inputs: tuple[Array, ...], steps: int, unroll: bool
    ) -> Array:
        observations, noise, overlap, exec_horizon, delay = inputs
        geometry = ChunkGeometry(policy.config.horizon, exec_horizon, delay)
        request = ChunkRequest(geometry, steps, noise, overlap)
        return sample(policy.velocity(observations, *given), request, unroll=unroll)

    def arguments(steps: int) -> tuple[Any, ...]:
        return policy, _given(sample, policy, inputs[0], steps), inputs

    jitted, ready = jax.jit(chunk, static_argnums=(3, 4)), arguments(flow_steps)
    start = time.perf_counter()
    compiled = jitted.lower(*ready, flow_steps, False).compile()
    compile_s = time.perf_counter() - start
    for _ in range(WARM_UP_CALLS):
        compiled(*ready).block_until_ready()
    # A loop's body is counted once, so one and two steps are counted, written out.
    one, two = (_costs(jitted.lower(*arguments(n), n, True).compile()) for n in (1, 2))
    flops, accessed = (_continued(*pair, flow_steps) for pair in zip(one, two, strict=True))
    read = bytes_read(functools.partial(chunk, steps=flow_steps, unroll=False), *ready)
    return Program(
        sampler=name,
        call=lambda: compiled(*ready),
        compile_s=compile_s,
        memory=_memory(compiled),
        flops=flops,
        bytes=accessed,
        needs=Needs(read, flops),
    )


def _continued(one: float | None, two: float | None, steps: int) -> float | None:
    """A count that grows by the same in every step, from those of one and of two steps."""
    return None if one is None or two is None else one + (steps - 1) * (two - one)


def _given(sample: Sample, policy: Policy, observations: Array, flow_steps: int) -> tuple[Any, Any]:
    """What is known before a chunk: a sampler's time table, once per checkpoint and K; a context's
    keys and values, which another network computes."""
    table = policy.time_table(sample.times(flow_steps)) if isinstance(sample, Sampler) else None
    has_context = getattr(policy.network, "has_context", False)
    return table, policy.observe(observations) if has_context else None


def _memory(compiled: Any) -> int | None:
    sizes = compiled.memory_analysis()
    if sizes is None:
        return None
    return int(sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes)


def _costs(compiled: Any) -> tuple[float | None, float | None]:
    costs = compiled.cost_analysis() or {}
    costs = costs[0] if isinstance(costs, list) else costs
    return costs.get("flops"), costs.get("bytes accessed")


def _time(
    programs: Sequence[Program], rounds: int, seed: int, report: Callable[[], None]
) -> np.ndarray:
    """Return milliseconds (rounds, programs)."""
    generator = np.random.Generator(np.random.Philox(seed))
    times = np.empty((rounds, len(programs)))
    for number in range(rounds):
        for index in generator.permutation(len(programs)):
            call = programs[index].call
            start = time.perf_counter()
            call().block_until_ready()
            times[number, index] = 1000 * (time.perf_counter() - start)
        report()
    return times


def _rows(
    programs: Sequence[Program],
    times: np.ndarray,
    shared: Mapping[str, Any],
    clock: Clock,
    ceilings: Ceilings,
) -> list[dict[str, Any]]:
    rows = []
    for index, program in enumerate(programs):
        samples = times[:, index]
        ratio, low, high = ratio_interval(samples, times[:, 0])
        rows.append(
            {
                **shared,
                "sampler": program.sampler,
                "compile_s": program.compile_s,
                **_timing(samples, shared["flow_steps"]),
                "ratio_to_plain": ratio,
                "ratio_low": low,
                "ratio_high": high,
                "ratio_method": RATIO_METHOD,
                "flops": program.flops,
                "bytes": program.bytes,
                "memory_bytes": program.memory,
                **_floor(samples, program.needs, ceilings),
                **_delays(samples, shared["horizon"], clock),
                "samples_ms": samples.tolist(),
            }
        )
    return rows


def _timing(samples: np.ndarray, flow_steps: int) -> dict[str, float]:
    p50, p95, p99 = (float(value) for value in np.percentile(samples, [50, 95, 99]))
    return {"p50_ms": p50, "p95_ms": p95, "p99_ms": p99, "per_step_ms": p50 / flow_steps}


def _floor(samples: np.ndarray, needs: Needs, ceilings: Ceilings) -> dict[str, float]:
    floor_ms = needs.floor_ms(ceilings)
    return {
        "floor_ms": floor_ms,
        "over_floor": float(np.median(samples)) / floor_ms if floor_ms else math.nan,
        "floor_bytes": needs.bytes,
        "ceiling_bytes_per_s": ceilings.bytes_per_s,
        "ceiling_flops_per_s": ceilings.flops_per_s,
    }


def _delays(samples: np.ndarray, horizon: int, clock: Clock) -> dict[str, Any]:
    """The chunk's latency with what is around it, and what follows at the control rate."""
    total = percentile_with(samples, clock.fixed_ms, 95)
    delay = latency_to_delay(total, clock.hz, clock.rounding)
    return {
        "hz": clock.hz,
        "rounding": clock.rounding,
        "delay_from": DELAY_FROM,
        "fixed_ms": dict(clock.fixed_ms),
        "total_p50_ms": percentile_with(samples, clock.fixed_ms, 50),
        "total_p95_ms": total,
        "delay_at_hz": delay,
        **{f"delay_{name}": latency_to_delay(total, clock.hz, name) for name in get_args(Rounding)},
        "chunk_share": delay / horizon,
        # With d = ceil(latency * rate), a rate of d / latency is the highest that has delay d.
        "highest_hz": {str(d): 1000 * d / total for d in range(1, horizon // 2 + 1)},
    }


def _offset(progress: Progress | None, start: int, total: int) -> Callable[[], None]:
    done = start

    def report() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return report


@contextmanager
def _no_compilation_cache() -> Iterator[None]:
    """Compile for real: a program read from a cache would have no compile time to speak of."""
    before = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
