"""Speed of stepping worlds, against what one would write with pymunk.

    python benchmarks/worlds.py [--worlds 512] [--rounds 7] [--clock cpu] [--json FILE] [TASK ...]

Every contender runs the same episodes (same seeds, same actions, noise and clipping included)
through the first 64 control steps in open-loop chunks of 8; worlds that have finished are left
out by all. One core. Contenders are alternated round by round; medians over rounds, ratios within
a round. `lockstep`: pymunk by attribute access, one loop over all worlds per control step.
`sharded`: the same calls, but 64 worlds at a time, a whole chunk per world in turn, and states read
at its end only. `ours`: `WorldBatch`, observations included. The last table compares worker
processes (wall clock; worthless on a machine that does other work).

Other work on the machine disturbs the wall clock more than the CPU clock, and both through the
caches: read ratios, not seconds, where it is busy.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.randomness import action_noise, jitter_numbers
from rtc_cli.tasks.scene import Role, Scene
from rtc_cli.tasks.world import Drives, World

TICKS = 64
CHUNK = 8
SHARD = 64
CLOCKS: dict[str, Callable[[], float]] = {"cpu": time.process_time, "wall": time.perf_counter}


class PlainWorlds:
    """n worlds in plain pymunk: the usual loop, in two orders."""

    def __init__(self, scene: Scene, n: int) -> None:
        self.scene = scene
        self.drives = Drives.of(scene)
        self.touched: list[list[Role]] = [[] for _ in range(n)]
        self.worlds = [World(scene, touched.append) for touched in self.touched]
        self.noise = np.array([action_noise(scene, seed) for seed in range(n)])
        numbers = np.array([jitter_numbers(scene, seed) for seed in range(n)])
        starts = scene.initial_states(numbers)[:, list(scene.moving)]
        for world, start in zip(self.worlds, starts, strict=True):
            world.place(start)

    def commands(self, actions: np.ndarray) -> tuple[list, list]:
        """Motor rates and thruster forces as lists (n, TICKS, ...)."""
        noisy = actions + self.noise[:, :TICKS]
        applied = np.clip(noisy, self.scene.action_low, self.scene.action_high)
        return self.drives.rates(applied).tolist(), self.drives.forces(applied).tolist()

    def lockstep(self, actions: np.ndarray) -> int:
        """All worlds, tick by tick; executed control steps."""
        rates, forces = self.commands(actions)
        done = 0
        for tick in range(TICKS):
            states = []
            for w, world in enumerate(self.worlds):
                if self.touched[w]:
                    continue
                world.tick(rates[w][tick], forces[w][tick])
                states.append(_read(world))
                done += 1
            np.array(states, np.float32)
        return done

    def sharded(self, actions: np.ndarray) -> int:
        """64 worlds at a time, chunk by chunk; executed control steps."""
        rates, forces = self.commands(actions)
        done = 0
        for first in range(0, len(self.worlds), SHARD):
            shard = range(first, min(first + SHARD, len(self.worlds)))
            for start in range(0, TICKS, CHUNK):
                states = []
                for w in shard:
                    world = self.worlds[w]
                    for tick in range(start, start + CHUNK):
                        if self.touched[w]:
                            break
                        world.tick(rates[w][tick], forces[w][tick])
                        done += 1
                    states.append(_read(world))
                np.array(states, np.float32)
        return done


def _read(world: World) -> list[float]:
    numbers: list[float] = []
    for body in world.bodies:
        x, y = body.position
        vx, vy = body.velocity
        numbers += (x, y, vx, vy, body.angle, body.angular_velocity)
    return numbers


def ours(worlds: WorldBatch, actions: np.ndarray) -> int:
    """`WorldBatch` in the same open-loop chunks, observations included."""
    chunks = [actions[:, at : at + CHUNK] for at in range(0, TICKS, CHUNK)]
    return sum(int(worlds.step(chunk).ticks.sum()) for chunk in chunks)


def compare(scene: Scene, n: int, rounds: int, clock: Callable[[], float]) -> dict[str, list]:
    """Raw samples of one task: control steps per second of each contender, reset times in µs."""
    rng = np.random.default_rng(0)
    low, high = scene.action_low, scene.action_high
    actions = rng.uniform(low, high, (n, TICKS, scene.action_dim)).astype(np.float32)
    samples: dict[str, list[float]] = {k: [] for k in ("lockstep", "sharded", "ours", "reset_us")}
    with WorldBatch(scene, n) as worlds:
        for _ in range(rounds):
            counts = []
            for name in ("lockstep", "sharded"):
                plain = PlainWorlds(scene, n)
                begin = clock()
                counts.append(getattr(plain, name)(actions))
                samples[name].append(counts[-1] / (clock() - begin))
            begin = clock()
            worlds.reset(range(n))
            between = clock()
            counts.append(ours(worlds, actions))
            samples["ours"].append(counts[-1] / (clock() - between))
            samples["reset_us"].append((between - begin) / n * 1e6)
            # The plain loops do not check bounds and speed limits, so their counts may be larger.
            if max(counts) > 1.05 * min(counts):
                print(f"{scene.name}: contenders executed {counts} control steps")
    return samples


def compare_workers(scene: Scene, n: int, rounds: int) -> dict[str, list[float]]:
    """Control steps per second (wall clock) with 1 and 2 workers."""
    actions = np.zeros((n, TICKS, scene.action_dim), np.float32)
    samples: dict[str, list[float]] = {"1": [], "2": []}
    with WorldBatch(scene, n, workers=1) as one, WorldBatch(scene, n, workers=2) as two:
        for _ in range(rounds):
            for name, worlds in (("1", one), ("2", two)):
                worlds.reset(range(n))
                begin = time.perf_counter()
                count = ours(worlds, actions)
                samples[name].append(count / (time.perf_counter() - begin))
    return samples


def ratio(samples: dict[str, list[float]], over: str, under: str) -> float:
    """Median over rounds of a ratio within the round."""
    pairs = zip(samples[over], samples[under], strict=True)
    return statistics.median(a / b for a, b in pairs)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", default=list_tasks())
    parser.add_argument("--worlds", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--clock", choices=CLOCKS, default="wall")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: dict[str, dict] = {}
    print(f"{options.worlds} worlds, {options.clock} clock, control steps per second (medians)")
    print("task                 lockstep   sharded      ours   /lockstep  /sharded   reset µs")
    for task in options.tasks:
        scene = get_task(task)
        raw = compare(scene, options.worlds, options.rounds, CLOCKS[options.clock])
        middle = {name: statistics.median(values) for name, values in raw.items()}
        print(
            f"{task:20} {middle['lockstep']:8.0f}  {middle['sharded']:8.0f}  {middle['ours']:8.0f}"
            f"   {ratio(raw, 'ours', 'lockstep'):8.2f}  {ratio(raw, 'ours', 'sharded'):8.2f}"
            f"   {middle['reset_us']:8.1f}"
        )
        found[task] = {"one_core": raw}
    print("task                 1 worker  2 workers  ratio (wall clock)")
    for task in options.tasks:
        raw = compare_workers(get_task(task), options.worlds, options.rounds)
        one, two = (statistics.median(raw[k]) for k in ("1", "2"))
        print(f"{task:20} {one:8.0f}   {two:8.0f}  {ratio(raw, '2', '1'):5.2f}")
        found[task]["workers"] = raw
    if options.json:
        options.json.write_text(json.dumps({"schema": 1, **vars_of(options), "tasks": found}))


def vars_of(options: argparse.Namespace) -> dict[str, object]:
    """The settings that belong into the file."""
    return {"worlds": options.worlds, "rounds": options.rounds, "clock": options.clock}


if __name__ == "__main__":
    main()
