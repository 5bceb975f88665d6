"""The time of one chunk per sampler, measured side by side.

All programs are compiled first and warmed up; then rounds follow, and in each every program is
called once, in an order drawn anew, and waited for. So a machine that slows down slows all of
them down, and the ratio to `plain` is taken within rounds. One chunk is everything from a
normalised observation to a chunk: the observation's projection and all flow steps. The time table
belongs to the checkpoint and is computed before, as in an evaluation.

The baseline `prefix-per-token` is what a user would write first: batch-major, time embedding and
adaLN for every token in every step.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtc_cli.core.flow import Velocity
from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig, TimeTable, get_network
from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.files import write_json
from rtc_cli.samplers import ChunkRequest, Sampler, get_sampler
from rtc_cli.units import Rounding, latency_to_delay

PER_TOKEN = "prefix-per-token"
"""The straightforward prefix sampler: a baseline of profiles, not in the registry of samplers."""

PRESETS: dict[str, tuple[str, dict[str, int]]] = {
    "quickstart": (
        "mixer",
        {"layers": 2, "channels": 64, "channel_hidden": 128, "token_hidden": 32},
    ),
    "paper": (
        "mixer",
        {"layers": 4, "channels": 256, "channel_hidden": 512, "token_hidden": 64},
    ),
}
"""Networks by name: kind and sizes."""

RATIO_METHOD = (
    "ratio of medians; 95% percentile interval of a bootstrap over rounds, paired within a round"
)
DELAY_FROM = "p95_ms"
"""The figure that `delay_at_hz` is made of: a chunk should seldom be late."""

WARM_UP_CALLS = 3
_OBS_DIM, _ACTION_DIM = 40, 6  # of a random network; Kinetix-sized
_RESAMPLES = 2000

Sample = Callable[..., Float[Array, "B H A"]]
Progress = Callable[[int, int], None]
"""`progress(done, total)`: programs compiled and rounds done."""


@dataclass(frozen=True)
class Program:
    """One compiled sampler and what is known before it is timed."""

    sampler: str
    call: Callable[[], Array]
    compile_s: float
    flops: float | None
    bytes: float | None


def random_policy(
    network: str,
    horizon: int,
    *,
    obs_dim: int = _OBS_DIM,
    action_dim: int = _ACTION_DIM,
    seed: int = 0,
) -> Policy:
    """Return a policy of a preset's size with random weights, adaLN's included (not zero).

    `network` is a preset ("quickstart", "paper") or a registered network at its default sizes.
    """
    kind, options = _network(network)
    config = PolicyConfig(kind, tuple(options.items()), horizon, obs_dim, action_dim)
    normaliser = Normaliser.identity(obs_dim, action_dim)
    return Policy.init(config, normaliser, jax.random.key(seed), adaln_zero=False)


def profile_samplers(
    network: Policy | str,
    samplers: Sequence[str],
    *,
    batch: Sequence[int] = (1,),
    horizon: int | None = None,
    flow_steps: int = 5,
    rounds: int = 50,
    hz: float = 30.0,
    rounding: Rounding = "ceil",
    label: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Time `plain`, the named samplers and `prefix-per-token`; one row each per batch size.

    `network` is a policy, or a name that `random_policy` knows (then `horizon`, default 8, sets
    its size). `label` is the rows' `network`. Guided samplers have their default settings.
    Milliseconds; `flops` and `bytes` (null where the compiler does not say) are XLA's for one
    call; `delay_at_hz` is made of the 95th percentile.
    """
    policy = _policy(network, horizon, seed)
    if not samplers:
        raise UsageError("no sampler is named", "name at least one with --sampler")
    if rounds < 2:
        raise UsageError(f"{rounds} rounds are too few", "give at least 2; 50 is usual")
    for value in batch:
        if value < 1:
            raise UsageError(f"batch {value} is not possible", "give integers >= 1")
    latency_to_delay(0.0, hz, rounding)  # refuses a bad rate before anything is compiled
    functions = _functions(samplers)
    name = label or (network if isinstance(network, str) else policy.config.network)
    total = len(batch) * (len(functions) + rounds)
    rows: list[dict[str, Any]] = []
    for number, size in enumerate(batch):
        report = _offset(progress, number * (len(functions) + rounds), total)
        with _no_compilation_cache():
            programs = _compile_all(functions, policy, size, flow_steps, seed, report)
        times = _time(programs, rounds, seed, report)
        rows += _rows(programs, times, name, policy, size, flow_steps, hz, rounding)
    return rows


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


def _network(name: str) -> tuple[str, dict[str, int]]:
    if name in PRESETS:
        return PRESETS[name]
    from rtc_cli.core.policy import list_networks

    allowed = (*PRESETS, *list_networks())
    if name not in allowed:
        raise UsageError(f'unknown network "{name}".{did_you_mean(name, allowed)}')
    get_network(name)
    return name, {}


def _policy(network: Policy | str, horizon: int | None, seed: int) -> Policy:
    if isinstance(network, str):
        return random_policy(network, 8 if horizon is None else horizon, seed=seed)
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
        policy: Policy, table: TimeTable | None, inputs: tuple[Array, ...], unroll: bool
    ) -> Array:
        observations, noise, overlap, exec_horizon, delay = inputs
        geometry = ChunkGeometry(policy.config.horizon, exec_horizon, delay)
        request = ChunkRequest(geometry, flow_steps, noise, overlap)
        return sample(policy.velocity(observations, table), request, unroll=unroll)

    # A sampler's time table is computed once per checkpoint and K, not once per chunk.
    table = policy.time_table(sample.times(flow_steps)) if isinstance(sample, Sampler) else None
    arguments = (policy, table, inputs)
    jitted = jax.jit(chunk, static_argnums=3)
    start = time.perf_counter()
    compiled = jitted.lower(*arguments, False).compile()
    compile_s = time.perf_counter() - start
    for _ in range(WARM_UP_CALLS):
        compiled(*arguments).block_until_ready()
    # A loop's body is counted once, so the costs are those of the same program without loops.
    flops, accessed = _costs(jitted.lower(*arguments, True).compile())
    return Program(name, lambda: compiled(*arguments), compile_s, flops, accessed)


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
    network: str,
    policy: Policy,
    batch: int,
    flow_steps: int,
    hz: float,
    rounding: Rounding,
) -> list[dict[str, Any]]:
    shared = {
        "network": network,
        "batch": batch,
        "horizon": policy.config.horizon,
        "flow_steps": flow_steps,
        "hz": hz,
        "rounding": rounding,
        "rounds": len(times),
        "ratio_method": RATIO_METHOD,
        "delay_from": DELAY_FROM,
    }
    rows = []
    for index, program in enumerate(programs):
        samples = times[:, index]
        p50, p95, p99 = (float(value) for value in np.percentile(samples, [50, 95, 99]))
        ratio, low, high = ratio_interval(samples, times[:, 0])
        rows.append(
            shared
            | {
                "sampler": program.sampler,
                "compile_s": program.compile_s,
                "p50_ms": p50,
                "p95_ms": p95,
                "p99_ms": p99,
                "per_step_ms": p50 / flow_steps,
                "ratio_to_plain": ratio,
                "ratio_low": low,
                "ratio_high": high,
                "flops": program.flops,
                "bytes": program.bytes,
                "delay_at_hz": latency_to_delay(p95, hz, rounding),
                "samples_ms": samples.tolist(),
            }
        )
    return rows


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
