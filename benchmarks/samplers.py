"""Time of one chunk: our samplers against baselines in the reference's style.

    python benchmarks/samplers.py [--batch 1 64 512] [--rounds 15]

The paper's Mixer (4 layers, 256 channels), H = 8, K = 5, observation 40, action dim 6, d = 2,
s = 2. All candidates alternate round by round in one process; medians, ratios paired by round.
"""

import argparse
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import reference_style
from alternated import measure, ratio, show_medians, show_ratio

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig, TimeTable
from rtc_cli.samplers import ChunkRequest, Sampler, get_sampler, list_samplers

STEPS = 5
CONFIG = PolicyConfig("mixer", (), horizon=8, obs_dim=40, action_dim=6)
TARGETS = {  # batch: plain, guided, prefix (factors to reach), prefix/plain (not to exceed)
    1: (1.3, 1.1, 1.5, 1.10),
    64: (1.15, 1.1, 1.7, 1.05),
    512: (1.5, 1.5, 2.3, 1.05),
}


def candidates(batch: int) -> dict[str, Callable[[], Any]]:
    policy = Policy.init(CONFIG, Normaliser.identity(40, 6), jax.random.key(0), adaln_zero=False)
    keys = jax.random.split(jax.random.key(1), 3)
    obs = jax.random.normal(keys[0], (batch, CONFIG.obs_dim))
    noise, overlap = (jax.random.normal(k, (batch, 8, 6)) for k in keys[1:])
    params = reference_style.reference_params(policy)
    s, d = jnp.int32(2), jnp.int32(2)

    # As in a deployed policy: the time table is an input, computed once per checkpoint and K.
    tables = {name: policy.time_table(get_sampler(name).times(STEPS)) for name in list_samplers()}

    @functools.partial(jax.jit, static_argnames=("name", "fast"))
    def sample(
        policy: Policy, table: TimeTable, obs: Any, s: Any, d: Any, name: str, fast: bool
    ) -> Any:
        field = policy.velocity(obs, table)
        velocity = field if fast else (lambda x, tau: field(x, tau))
        request = ChunkRequest(ChunkGeometry(8, s, d), STEPS, noise, overlap)
        return get_sampler(name)(velocity, request)

    geometry = ChunkGeometry(8, 2, 2)
    request = ChunkRequest(geometry, STEPS, noise, overlap)
    in_threads = (
        {name: get_sampler(name) for name in list_samplers()} if batch > Sampler.tile else {}
    )

    def ours(name: str, fast: bool = True) -> Any:
        if fast and name in in_threads:  # a large batch, called as a function: tiles on threads
            return in_threads[name](policy.velocity(obs, tables[name]), request)
        return sample(policy, tables[name], obs, s, d, name, fast)

    plain = jax.jit(functools.partial(reference_style.plain, steps=STEPS))
    guided = jax.jit(functools.partial(reference_style.guided, steps=STEPS))
    calls = {
        "plain": lambda: ours("plain"),
        "prefix": lambda: ours("prefix"),
        "pinv": lambda: ours("pinv"),
        "pinv-detached": lambda: ours("pinv-detached"),
        "reference-style plain": lambda: plain(params, obs, noise),
        "reference-style guided": lambda: guided(params, obs, noise, overlap, s, d),
        "prefix-per-token": lambda: ours("prefix", fast=False),
    }
    for left, right in (
        ("plain", "reference-style plain"),
        ("pinv", "reference-style guided"),
        ("prefix", "prefix-per-token"),
    ):
        distance = float(jnp.abs(calls[left]() - calls[right]()).max())
        if not distance < 1e-4:
            raise SystemExit(f"{left} and {right} differ by {distance}")
    return calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 64, 512])
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    for batch in options.batch:
        samples = measure(candidates(batch), options.rounds)
        print(f"batch {batch}")
        show_medians(samples)
        plain, guided, prefix, overhead = TARGETS.get(batch, (1.0, 1.0, 1.0, 1.1))
        show_ratio(samples, "reference-style plain", "plain", plain)
        show_ratio(samples, "reference-style guided", "pinv", guided)
        show_ratio(samples, "prefix-per-token", "prefix", prefix)
        show_ratio(samples, "prefix", "plain", overhead, at_most=True)
        print(f"  pinv / plain: {ratio(samples, 'pinv', 'plain'):.2f}")


if __name__ == "__main__":
    main()
