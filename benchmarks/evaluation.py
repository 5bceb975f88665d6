"""Seconds of one evaluation point: 128 episodes with random weights and the paper's Mixer.

Each method is compiled and warmed up by one episode, then measured ``--repeat`` times, the methods
alternating round by round; all samples are printed, and the processor time, which other programs
on the machine disturb less. The public reference needs 81 s for its
catcher-like level (naive, mean length 63, two CPU cores).

    python benchmarks/evaluation.py                     # catcher, d = s = 2, K = 5
    python benchmarks/evaluation.py --tile 64 --json
"""

import argparse
import json
import statistics
import time
from typing import Any

from rtc_cli.results import machine_record
from rtc_cli.runtime import use_threads


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="catcher")
    parser.add_argument("--methods", default="naive,pinv,prefix")
    parser.add_argument("--episodes", type=int, default=128)
    parser.add_argument("--exec-horizon", type=int, default=2)
    parser.add_argument("--delay", type=int, default=2)
    parser.add_argument("--flow-steps", type=int, default=5)
    parser.add_argument("--tile", type=int, default=None, help="rows of one inference")
    parser.add_argument("--threads", type=int, default=None, help="XLA's threads")
    parser.add_argument("--layers", type=int, default=4)
    parser.add_argument("--channels", type=int, default=256)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser.parse_args()


def random_policy(scene: Any, layers: int, channels: int) -> Any:
    """A policy with random weights whose actions spread over the task's bounds."""
    import jax
    import jax.numpy as jnp

    from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig

    normaliser = Normaliser(
        jnp.zeros(scene.obs_dim),
        jnp.ones(scene.obs_dim),
        jnp.asarray((scene.action_low + scene.action_high) / 2),
        jnp.asarray((scene.action_high - scene.action_low) / 2),
    )
    options = {"layers": layers, "channels": channels, "channel_hidden": 2 * channels}
    config = PolicyConfig(
        network="mixer",
        options=tuple(options.items()),
        horizon=8,
        obs_dim=scene.obs_dim,
        action_dim=scene.action_dim,
    )
    init = jax.jit(lambda key: Policy.init(config, normaliser, key, adaln_zero=False))
    return init(jax.random.key(0))


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """One row per method: all seconds, the compile time and the mean length."""
    from rtc_cli.core.geometry import ChunkGeometry
    from rtc_cli.execution.inference import TILE
    from rtc_cli.execution.methods import get_methods
    from rtc_cli.execution.rollout import evaluate_cell
    from rtc_cli.tasks import get_task

    scene = get_task(options.task)
    policy = random_policy(scene, options.layers, options.channels)
    tile = options.tile or TILE

    def run(method: Any, episodes: int) -> tuple[float, float, float]:
        start, cpu = time.perf_counter(), time.process_time()
        rows = evaluate_cell(
            scene,
            policy,
            method,
            ChunkGeometry(8, options.exec_horizon, options.delay),
            flow_steps=options.flow_steps,
            episodes=range(episodes),
            eval_seed=0,
            tile=tile,
        )
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        return seconds, cpu, float(rows.length.mean())

    methods = get_methods(options.methods.split(","))
    warm = {method.name: run(method, 1)[0] for method in methods}
    samples: dict[str, list[float]] = {method.name: [] for method in methods}
    cpu_samples: dict[str, list[float]] = {method.name: [] for method in methods}
    lengths: dict[str, float] = {}
    for _ in range(options.repeat):
        for method in methods:
            seconds, cpu, lengths[method.name] = run(method, options.episodes)
            samples[method.name].append(seconds)
            cpu_samples[method.name].append(cpu)
    return [
        {
            "task": scene.name,
            "method": name,
            "episodes": options.episodes,
            "tile": tile,
            "first_run_s": warm[name],
            "median_s": statistics.median(seconds),
            "samples_s": seconds,
            "cpu_samples_s": cpu_samples[name],
            "mean_length": lengths[name],
        }
        for name, seconds in samples.items()
    ]


def main() -> None:
    """Measure and print."""
    options = arguments()
    use_threads(options.threads)
    rows = measure(options)
    if options.json:
        print(json.dumps({"schema": 1, "machine": machine_record(), "rows": rows}, indent=2))
        return
    print(f"{options.task}: {options.episodes} episodes, tile {rows[0]['tile']}")
    for row in rows:
        print(
            f"{row['method']:>14}: {row['median_s']:6.2f} s after compilation (all: "
            f"{', '.join(f'{s:.2f}' for s in row['samples_s'])}; processor time of this process "
            f"{statistics.median(row['cpu_samples_s']):.2f} s), mean length "
            f"{row['mean_length']:.1f}, first run with compilation {row['first_run_s']:.1f} s"
        )


if __name__ == "__main__":
    main()
