"""Our Kinetix physics beside Kinetix itself: do they agree, and how fast is each?

    python benchmarks/kinetix_peer.py FOLDER_OF_LEVELS --kinetix PYTHON [--rounds 5] [--json FILE]
    python benchmarks/kinetix_peer.py FOLDER_OF_LEVELS        our speed alone

PYTHON is the interpreter of an environment of its own with `pip install kinetix-env==3.0.2`. Every
level runs in both under the same random actions (each value held for 8 control steps), 64 worlds,
without noise. Agreement: the largest difference of any moving shape's place, over sequences that
have not ended; the kind of end; those with ends apart. Speed: control steps a second of chunks of
8, both on one core, one after the other in every round; medians over rounds, and of the ratios
within a round. Worlds of ours whose episode has ended begin another, resets included; Kinetix' step
on (without its own resets): 64 worlds run in both.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

WORLDS, TICKS, CHUNK = 64, 256, 8
BINDINGS = 6
MARKS = (1, 10, 30)
ONE_CORE = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "NPROC": "1", "OMP_NUM_THREADS": "1"}


def draw_actions(seed: int) -> np.ndarray:
    """Actions (WORLDS, TICKS, 6): four motor bindings, two thruster bindings."""
    random = np.random.default_rng(seed)
    low = np.array([-1.0] * 4 + [0.0] * 2)
    values = random.uniform(low, 1.0, (WORLDS, TICKS // CHUNK, BINDINGS))
    return np.repeat(values, CHUNK, axis=1).astype(np.float32)


class Ours:
    """One level in this project."""

    def __init__(self, path: Path) -> None:
        from rtc_cli.tasks.batch import WorldBatch
        from rtc_cli.tasks.kinetix import load_level

        self.scene = dataclasses.replace(load_level(path), action_noise=0.0)
        self.worlds = WorldBatch(self.scene, WORLDS)
        names = [f"motor{i}" for i in range(4)] + [f"thruster{i}" for i in range(2)]
        self.columns = [names.index(action.name) for action in self.scene.actions]

    def play(self, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Places (WORLDS, TICKS, moving, 2), NaN after the end; kind and tick of the end."""
        self.worlds.reset(range(WORLDS))
        places = np.full((WORLDS, TICKS, len(self.scene.moving), 2), np.nan)
        ends = np.full(WORLDS, TICKS)
        for tick in range(TICKS):
            record = self.worlds.step(actions[:, tick : tick + 1, self.columns])
            went = record.ticks > 0
            places[went, tick] = self.worlds.states[went][:, list(self.scene.moving), :2]
            ends[went & (record.status != 0)] = tick + 1
        return {"places": places, "kind": record.status, "tick": ends}

    def time(self, actions: np.ndarray, *, resets: bool = True) -> float:
        """Control steps a second; a world whose episode has ended begins another.

        `resets`: whether the time that beginning takes is counted.
        """
        self.worlds.reset(range(WORLDS))
        seconds, steps, seed = 0.0, 0, WORLDS
        for first in range(0, TICKS, CHUNK):
            start = time.perf_counter()
            record = self.worlds.step(actions[:, first : first + CHUNK, self.columns])
            seconds += time.perf_counter() - start
            steps += int(record.ticks.sum())
            ended = np.flatnonzero(record.status != 0)
            start = time.perf_counter()
            if len(ended):
                self.worlds.reset(range(seed, seed + len(ended)), worlds=ended)
                seed += len(ended)
            seconds += (time.perf_counter() - start) * resets
        return steps / seconds


class Theirs:
    """One level in Kinetix, in a process of its own."""

    def __init__(self, python: Path, path: Path) -> None:
        environment = {**os.environ, **ONE_CORE, "WANDB_MODE": "disabled"}
        self._process = subprocess.Popen(
            [str(python), __file__, "--serve", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            text=True,
        )

    def ask(self, what: str, seed: int) -> Any:
        """One answer of the other process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{what} {seed}\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def play(self, seed: int) -> dict[str, np.ndarray]:
        """What `Ours.play` gives."""
        with np.load(self.ask("play", seed)) as found:
            return {name: found[name] for name in found.files}

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def serve(path: str) -> None:
    """Answer `Theirs`: runs under Kinetix' own interpreter."""
    answers, sys.stdout = sys.stdout, sys.stderr
    import jax
    import jax.numpy as jnp
    from kinetix.environment.env import make_kinetix_env
    from kinetix.environment.spaces import ActionType, ObservationType
    from kinetix.util.saving import load_from_json_file

    state, static, params = load_from_json_file(path)
    params = params.replace(dense_reward_scale=0.0)
    kinds = ActionType.CONTINUOUS, ObservationType.SYMBOLIC_FLAT
    env = make_kinetix_env(*kinds, None, params, static, auto_reset=False)
    start = jax.tree.map(lambda x: jnp.repeat(x[None], WORLDS, 0), state)
    masses = np.concatenate([state.polygon.inverse_mass, state.circle.inverse_mass])
    active = np.concatenate([state.polygon.active, state.circle.active])
    moving = np.flatnonzero(active & (masses > 0))

    def step(now: Any, action: Any) -> Any:
        _, then, reward, _, _ = env.step(jax.random.key(0), now, action, params)
        places = jnp.concatenate([then.polygon.position, then.circle.position])[moving]
        return then, (places, reward)

    chunk = jax.jit(lambda now, actions: jax.lax.scan(jax.vmap(step), now, actions))
    while line := sys.stdin.readline():
        what, seed = line.split()
        actions = jnp.array(draw_actions(int(seed)).swapaxes(0, 1))
        began, now, found = time.perf_counter(), start, []
        for first in range(0, TICKS, CHUNK):
            now, seen = jax.block_until_ready(chunk(now, actions[first : first + CHUNK]))
            found.append(seen)
        seconds = time.perf_counter() - began
        answer: Any = WORLDS * TICKS / seconds
        if what == "play":
            places, rewards = (np.concatenate([f[i] for f in found]).swapaxes(0, 1) for i in (0, 1))
            answer = _keep(places, rewards)
        print(json.dumps(answer), file=answers, flush=True)


def _keep(places: np.ndarray, rewards: np.ndarray) -> str:
    ended = rewards != 0
    tick = np.where(ended.any(axis=1), ended.argmax(axis=1) + 1, TICKS)
    last = rewards[np.arange(len(rewards)), tick - 1]
    kind = np.where(last > 0, 1, np.where(last < 0, 2, 3))
    with tempfile.NamedTemporaryFile(suffix=".npz", delete=False) as file:
        np.savez(file, places=places, kind=kind, tick=tick)
    return file.name


def agreement(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, Any]:
    """Median difference of places (m) after MARKS control steps, and how many ends are alike."""
    apart = np.abs(ours["places"] - theirs["places"]).max(axis=(2, 3))
    running = np.arange(TICKS) < theirs["tick"][:, None]
    found: dict[str, Any] = {}
    for mark in MARKS:
        rows = running[:, mark - 1]
        values = apart[rows, mark - 1]
        found[f"after_{mark}"] = float(np.nanmedian(values)) if rows.any() else None
    found["same_kind"] = int((ours["kind"] == theirs["kind"]).sum())
    found["same_tick"] = int(
        ((ours["kind"] == theirs["kind"]) & (ours["tick"] == theirs["tick"])).sum()
    )
    return found


def compare(path: Path, python: Path, rounds: int) -> dict[str, Any]:
    """One row: agreement and speed of a level."""
    ours, theirs = Ours(path), Theirs(python, path)
    row: dict[str, Any] = {"level": path.stem}
    row |= agreement(ours.play(draw_actions(0)), theirs.play(0))
    samples = []
    for seed in range(1, rounds + 1):
        pair = (ours.time(draw_actions(seed)), theirs.ask("time", seed))
        samples.append(pair)
    theirs.close()
    row["ours_per_s"], row["kinetix_per_s"] = (
        statistics.median(s) for s in zip(*samples, strict=True)
    )
    row["ratio"] = statistics.median(mine / other for mine, other in samples)
    return row | {"samples": samples}


def show_own(folder: Path, rounds: int) -> None:
    """Print the speed of our physics on every level, with and without resets."""
    print("| level | steps /s | with resets |\n| --- | ---: | ---: |")
    rows = []
    for path in sorted(folder.glob("*.json")):
        ours = Ours(path)
        pairs = [
            [ours.time(draw_actions(seed), resets=resets) for resets in (False, True)]
            for seed in range(rounds + 1)
        ][1:]
        rows.append([statistics.median(values) for values in zip(*pairs, strict=True)])
        print(f"| {path.stem} | {rows[-1][0]:,.0f} | {rows[-1][1]:,.0f} |", flush=True)
    for name, values in zip(("steps", "with resets"), zip(*rows, strict=True), strict=True):
        mean = statistics.geometric_mean(values)
        print(f"{name}: geometric mean {mean:,.0f}, least {min(values):,.0f}")


def main() -> None:
    """Read the options, print a row per level."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--kinetix", type=Path, help="the interpreter that has kinetix-env")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve)
        return
    if options.folder is None:
        parser.error("a folder of levels is needed")
    os.environ.update(ONE_CORE)
    if options.kinetix is None:
        show_own(options.folder, options.rounds)
        return
    heads = [f"after {mark}" for mark in MARKS]
    print("| level | " + " | ".join(heads) + " | same end | ours /s | Kinetix /s | ratio |")
    print("| --- |" + " ---: |" * (len(MARKS) + 4))
    rows = []
    for path in sorted(options.folder.glob("*.json")):
        row = compare(path, options.kinetix, options.rounds)
        cells = ["" if row[f"after_{m}"] is None else f"{row[f'after_{m}']:.0e}" for m in MARKS]
        cells += [f"{row['same_kind']} of {WORLDS}", f"{row['ours_per_s']:,.0f}"]
        cells += [f"{row['kinetix_per_s']:,.0f}", f"{row['ratio']:.0f}"]
        print(f"| {path.stem} | {' | '.join(cells)} |", flush=True)
        rows.append(row)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))
    speeds = [row["ours_per_s"] for row in rows]
    print(f"\ngeometric mean {statistics.geometric_mean(speeds):,.0f}, least {min(speeds):,.0f}")


if __name__ == "__main__":
    main()
