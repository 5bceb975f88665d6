"""Episodes of random extreme actions over all tasks: no crash, no unnoticed NaN, flat memory.

    python benchmarks/stress.py [--episodes 10000] [--worlds 64] [TASK ...]

Every action component is at one of its bounds, held for a random number of control steps. After
every chunk observations have to be finite, and states too unless the world says that it is
invalid. Prints per task the episodes, how they ended and the steps per second, and the memory
after a tenth of the episodes and at the end.
"""

import argparse
import gc
import resource
import time
from pathlib import Path

import numpy as np

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

CHUNK = 8


def resident_mb() -> float:
    """Resident memory of this process in MB."""
    gc.collect()  # closed worlds are part of reference cycles
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Extremes:
    """Actions at the bounds, one of them per component and world, changed at random."""

    def __init__(self, scene: Scene, n: int, rng: np.random.Generator) -> None:
        self.rng = rng
        self.low, self.high = scene.action_low, scene.action_high
        self.now = np.where(rng.random((n, scene.action_dim)) < 0.5, self.low, self.high)

    def chunk(self) -> np.ndarray:
        """The next (n, CHUNK, A)."""
        out = np.empty((len(self.now), CHUNK, len(self.low)), np.float32)
        for tick in range(CHUNK):
            change = self.rng.random(self.now.shape) < 0.2
            other = np.where(self.rng.random(self.now.shape) < 0.5, self.low, self.high)
            self.now = np.where(change, other, self.now)
            out[:, tick] = self.now
        return out


def run(scene: Scene, episodes: int, n: int) -> tuple[dict[str, int], float]:
    """How episodes ended, and control steps per second; SystemExit at an unnoticed NaN."""
    extremes = Extremes(scene, n, np.random.default_rng(0))
    ends = dict.fromkeys((status.name.lower() for status in Status), 0)
    steps, given = 0, min(n, episodes)
    began = time.perf_counter()
    with WorldBatch(scene, n) as worlds:
        active = np.arange(given)
        worlds.reset(active, active)
        while len(active):
            record = worlds.step(extremes.chunk()[active], worlds=active)
            steps += int(record.ticks.sum())
            valid = record.status != Status.INVALID
            if (
                not np.isfinite(record.obs).all()
                or not np.isfinite(worlds.states[active[valid]]).all()
            ):
                raise SystemExit(f"{scene.name}: NaN that no status tells of")
            done = active[record.status != Status.RUNNING]
            for status in record.status[record.status != Status.RUNNING]:
                ends[Status(int(status)).name.lower()] += 1
            again = done[: max(episodes - given, 0)]
            worlds.reset(given + np.arange(len(again)), again)
            given += len(again)
            active = np.setdiff1d(active, done[len(again) :])
    return ends, steps / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    parser.add_argument("--episodes", type=int, default=10_000, help="over all tasks")
    parser.add_argument("--worlds", type=int, default=64)
    options = parser.parse_args()
    names = options.tasks or list_tasks()
    each = -(-options.episodes // len(names))
    for share in (0.1, 0.9):
        for name in names:
            ends, rate = run(get_task(name), max(1, round(share * each)), options.worlds)
            counts = ", ".join(f"{count} {end}" for end, count in ends.items() if count)
            print(f"{name:18s} {sum(ends.values()):6d} episodes: {counts}; {rate:,.0f} steps/s")
        print(f"after {share if share == 0.1 else 1.0:.0%} of the episodes: {resident_mb():.0f} MB")


if __name__ == "__main__":
    main()
