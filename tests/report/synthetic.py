"""Made-up runs for tests of the report. No number here was measured; success is drawn at random
from the probabilities of `success_probability`, which look roughly like an evaluation."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rtc_cli.results import EPISODE_COLUMNS, ResultStore

TASKS = ("cartpole_thrust", "catcher", "lunar_lander")
METHODS = {
    "naive": ("base", "plain", "async"),
    "pinv": ("base", "pinv", "async"),
    "prefix": ("prefix", "prefix", "async"),
}
MORE_METHODS = METHODS | {
    "sync": ("base", "plain", "sync"),
    "pinv-tuned": ("base", "pinv", "async"),
    "base+plain": ("base", "plain", "async"),
    "base+prefix": ("base", "prefix", "async"),
    "prefix+plain": ("prefix", "plain", "async"),
    "prefix+pinv": ("prefix", "pinv", "async"),
}
_LOSS = {
    "naive": 0.032,
    "base+plain": 0.032,
    "prefix+plain": 0.034,
    "pinv": 0.022,
    "pinv-tuned": 0.020,
    "prefix+pinv": 0.021,
    "prefix": 0.012,
    "base+prefix": 0.04,
    "sync": 0.004,
}


_SEAM = {"naive": 0.4, "pinv": 0.2, "pinv-tuned": 0.12, "prefix": 0.06, "oracle": 0.5}


def success_probability(method: str, task: str, delay: int, seed: int) -> float:
    """A smooth made-up curve: falls with the square of the delay."""
    method = {"base+plain": "naive"}.get(method, method)  # the same cell under another label
    shift = 0.02 * np.sin(7 * seed + len(method) + 3 * len(task))
    hard = 0.8 + 0.1 * TASKS.index(task) if task in TASKS else 1.0
    return float(np.clip(0.95 - hard * _LOSS.get(method, 0.03) * delay**2 + shift, 0.02, 0.99))


def cell(
    method: str,
    task: str,
    seed: int,
    protocol: str,
    delay: int,
    exec_horizon: int,
    solved: Sequence[bool],
    *,
    triple: tuple[str, str, str] = ("base", "plain", "async"),
    settings: str = "{}",
    first_episode: int = 0,
    policy: str | None = None,
    action_noise: float = 0.1,
    **timing: Any,
) -> pd.DataFrame:
    """One cell with given outcomes; the other metrics are made up from the outcome."""
    n = len(solved)
    outcome = np.asarray(solved, bool)
    checkpoint, sampler, schedule = triple
    where = f"{checkpoint}{sampler}{settings}{schedule}{task}{seed}{delay}{exec_horizon}{n}"
    where += f"noise{action_noise}" + (str(timing) if timing else "")
    columns: dict[str, Any] = {
        "task": task,
        "method": method,
        "checkpoint": checkpoint,
        "sampler": sampler,
        "settings": settings,
        "schedule": schedule,
        "train_seed": seed,
        "protocol": protocol,
        "delay": delay,
        "exec_horizon": exec_horizon,
        "flow_steps": 5,
        "action_noise": action_noise,
        "delay_model": f"constant:{delay}",
        "estimator": "exact",
        "on_late": "play",
        "on_exceed": "play",
        "observation_lag": 0,
        "episode": np.arange(first_episode, first_episode + n),
        "status": np.where(outcome, 1, 2),
        "solved": outcome,
        "solved_last_substep": None,
        "length": 40 + (np.arange(n) % 30),
        "time_to_success_s": np.where(outcome, (40 + np.arange(n) % 30) / 30.0, np.nan),
        "throughput_per_min": np.where(outcome, 40.0, 0.0),
        "seam_jump": np.nan if exec_horizon == 1 else 1.0 + _SEAM.get(method, 0.2) * delay,
        "seam_gap": np.nan if exec_horizon + delay >= 8 else 0.1 + 0.05 * delay,
        "prefix_error": np.nan if delay == 0 or sampler == "prefix" else 0.08 * delay,
        "action_delta": 0.21,
        "action_delta2": 0.34,
        "starved_ticks": 0,
        "late_chunks": 0,
        "dropped_chunks": 0,
        "clipped_requests": 0,
        "exceeded_requests": 0,
        "waiting_ticks": delay * 7 if schedule == "sync" else 0,
        "reaction_ticks": delay + (exec_horizon - 1) / 2,
        "measured_reaction_ticks": 1.1 * delay + exec_horizon / 2 + (sampler == "pinv"),
        "beyond_trained": False,
        "cell": hashlib.sha256(where.encode()).hexdigest()[:20],
        "policy": policy or hashlib.sha256(f"{checkpoint}{task}{seed}".encode()).hexdigest()[:16],
        "scene": hashlib.sha256(task.encode()).hexdigest()[:16],
    }
    columns |= timing
    return pd.DataFrame({name: columns[name] for name in EPISODE_COLUMNS})


def episodes(
    *,
    tasks: Sequence[str] = TASKS,
    seeds: Iterable[int] = (0, 1, 2, 3, 4),
    methods: dict[str, tuple[str, str, str]] | None = None,
    protocols: Sequence[str] = ("paper", "fixed:4"),
    delays: Sequence[int] = (0, 1, 2, 3, 4),
    n: int = 64,
    variant: int = 0,
) -> list[pd.DataFrame]:
    """Cells of a made-up evaluation; episodes share luck across methods, as real ones do."""
    frames = []
    for task in tasks:
        for seed in seeds:
            rng = np.random.default_rng([variant, seed, len(task)])
            luck = rng.random(n)
            for method, triple in (methods or METHODS).items():
                for protocol in protocols:
                    for delay in delays:
                        s = max(delay, 1) if protocol == "paper" else int(protocol[6:])
                        # A cell's own chance is the same under every protocol and label.
                        own = np.random.default_rng(
                            [seed, delay, s, len(task), *map(ord, "".join(triple))]
                        )
                        mixed = np.where(own.random(n) < 0.5, luck, own.random(n))
                        chance = success_probability(method, task, delay, seed)
                        settings = '{"max_guidance_weight": 20.0}' if "tuned" in method else "{}"
                        frames.append(
                            cell(
                                method,
                                task,
                                seed,
                                protocol,
                                delay,
                                s,
                                mixed < chance,
                                triple=triple,
                                settings=settings,
                            )
                        )
    return frames


# -- a world in which the costs of delay are known -------------------------------------------

LOSS_METHODS = METHODS | {
    "pinv-tuned": ("base", "pinv", "async"),
    "oracle": ("base", "plain", "oracle"),
}
# Recovered fractions that are the same on every task.
RECOVERED = {"naive": 0.0, "pinv": 0.4, "pinv-tuned": 0.7, "prefix": 0.8, "oracle": 1.0}


@dataclass(frozen=True)
class Truth:
    """One task: S(0, 1), the open-loop cost at s = 4, the two other costs at d = 4."""

    closed_loop: float
    open_loop_cost: float
    irreducible: float
    avoidable: float

    def success(self, method: str, delay: int, exec_horizon: int) -> float:
        """Costs grow linearly: with s - 1 the open-loop cost, with d the others."""
        start = self.closed_loop - self.open_loop_cost * (exec_horizon - 1) / 3
        if delay == 0:
            return start
        oracle = start - self.irreducible * delay / 4
        return oracle - (1 - RECOVERED[method]) * self.avoidable * delay / 4


WORLD = {
    "car_launch": Truth(0.96, 0.02, 0.08, 0.32),
    "cartpole_thrust": Truth(0.98, 0.02, 0.04, 0.40),
    "catapult": Truth(0.88, 0.02, 0.00, 0.00),
    "catcher": Truth(0.94, 0.04, 0.08, 0.48),
    "chain_lander": Truth(0.86, 0.10, 0.32, 0.08),
    "grasp": Truth(0.84, 0.00, 0.00, 0.00),
    "half_cheetah": Truth(0.94, 0.02, 0.08, 0.20),
    "lunar_lander": Truth(0.92, 0.12, 0.12, 0.20),
    "swimmer": Truth(0.90, 0.02, 0.12, 0.12),
    "trampoline": Truth(0.94, 0.08, 0.48, 0.04),
    "unicycle": Truth(0.98, 0.16, -0.04, 0.40),
    "walker": Truth(0.92, 0.04, 0.00, 0.28),
}


def loss_episodes(
    world: dict[str, Truth],
    *,
    seeds: Iterable[int] = (0, 1, 2),
    protocols: Sequence[str] = ("paper", "fixed:4"),
    delays: Sequence[int] = (0, 1, 2, 3, 4),
    n: int = 100,
    noise: bool = False,
) -> list[pd.DataFrame]:
    """Cells of a world with known costs, the reference cells `open-loop` included.

    Without noise, episode i is solved where i + 1/2 < n times the truth: rates are the truth's to
    the last digit that n allows. With noise, outcomes are drawn and share luck across cells.
    """
    wanted = [
        (method, protocol, delay, max(delay, 1) if protocol == "paper" else int(protocol[6:]))
        for method in LOSS_METHODS
        for protocol in protocols
        for delay in delays
    ]
    horizons = sorted({s for _, _, _, s in wanted} | {1})
    wanted += [("naive", "open-loop", 0, s) for s in horizons]
    return [
        _loss_cell(truth, task, seed, *labels, n=n, noise=noise)
        for task, truth in world.items()
        for seed in seeds
        for labels in wanted
    ]


def _loss_cell(
    truth: Truth, task: str, seed: int, method: str, protocol: str, delay: int, s: int,
    *, n: int, noise: bool,
) -> pd.DataFrame:  # fmt: skip
    order = (np.arange(n) + 0.5) / n
    if noise:
        own = np.random.default_rng([seed, delay, s, *map(ord, task + (method if delay else ""))])
        luck = np.random.default_rng([seed, *map(ord, task)]).random(n)
        order = np.where(own.random(n) < 0.5, luck, own.random(n))
    solved = order < truth.success(method, delay, s)
    settings = '{"max_guidance_weight": 20.0}' if "tuned" in method else "{}"
    triple = LOSS_METHODS[method]
    return cell(
        method, task, seed, protocol, delay, s, list(solved), triple=triple, settings=settings
    )


def write_run(
    folder: Path, frames: Iterable[pd.DataFrame], *, extras: bool = True, store: str = ""
) -> Path:
    """Write a made-up run folder around some cells."""
    results = ResultStore(folder / "results" / "episodes" / store)
    for frame in frames:
        results.append(str(frame["cell"].iloc[0]), frame)
    (folder / "recipe.toml").write_text(
        'name = "synthetic"\ndescription = "Made-up numbers for tests"\nhorizon = 8\n'
        "[experts]\nmin_success = 0.65\n"
    )
    manifest = {
        "schema": 1,
        "created": "2026-01-02T03:04:05+00:00",
        "recipe": "synthetic",
        "recipe_hash": "0" * 64,
        "versions": {"rtc": "0", "python": "3.11"},
        "device": "made up",
        "git_commit": None,
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    if extras:
        _write_extras(folder)
    return folder


def _write_extras(folder: Path) -> None:
    training = folder / "results" / "training"
    training.mkdir(parents=True)
    for task in TASKS:
        for seed in (0, 1):
            for checkpoint, first in (("base", 0), ("prefix", 15)):
                epochs = list(range(first, 21))
                loss = [0.2 + 0.8 * 0.85**e + 0.01 * seed for e in epochs]
                record = {
                    "task": task,
                    "train_seed": seed,
                    "checkpoint": checkpoint,
                    "epochs": epochs,
                    "loss": loss,
                    "samples_per_s": [9000.0] * len(epochs),
                    "seconds": [2.5] * len(epochs),
                }
                (training / f"{task}-seed{seed}-{checkpoint}.json").write_text(json.dumps(record))
        for seed, success in ((0, 0.81), (1, 0.42)):
            record = {
                "task": task,
                "seed": seed,
                "success": success,
                "steps": 400_000,
                "seconds": 14.2,
            }
            path = folder / "experts" / task / f"{seed}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(record))
    (folder / "results" / "profile.json").write_text(json.dumps(profile()))


def profile() -> dict[str, Any]:
    """A made-up profile with the documented row keys."""
    rows = []
    for batch, base in ((1, 2.1), (64, 38.0)):
        for sampler, ratio in (
            ("plain", 1.0),
            ("prefix", 1.03),
            ("prefix-per-token", 1.7),
            ("pinv", 2.5),
        ):
            rows.append(
                {
                    "network": "mixer",
                    "sampler": sampler,
                    "batch": batch,
                    "horizon": 8,
                    "flow_steps": 5,
                    "compile_s": 1.2,
                    "p50_ms": base * ratio,
                    "p95_ms": base * ratio * 1.15,
                    "p99_ms": base * ratio * 1.4,
                    "ratio_to_plain": ratio,
                    "flops": 1e6 * ratio,
                    "bytes": 2e5,
                    "delay_at_hz": 1,
                    "samples_ms": [base * ratio],
                }
            )
    return {"schema": 1, "machine": {"cpu": "made up", "cores": 2}, "rows": rows}
