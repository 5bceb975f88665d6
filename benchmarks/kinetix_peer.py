"""The Kinetix port beside Jax2D, the engine that the levels were made for.

    python benchmarks/kinetix_peer.py FOLDER_OF_LEVELS [--trials 3]

Needs Jax2D (github.com/MichaelTMatthews/Jax2D) on the Python path. Every level runs in both engines
under the same constant actions, drawn at random, without noise. Printed: the largest difference of
any moving shape's place and velocity after some control steps, median over the trials. Trials in
which an episode of ours has ended by then are left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax2d.engine import PhysicsEngine, calculate_collision_matrix, create_empty_sim
from jax2d.sim_state import SimParams, SimState, StaticSimParams

from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix import load_level
from rtc_cli.tasks.scene import SUBSTEPS, Scene, Status

MARKS = (1, 3, 10, 30)
BODY = "position rotation velocity angular_velocity inverse_mass inverse_inertia friction"
BODY += " restitution collision_mode active n_vertices vertices radius"
JOINT = "a_index b_index a_relative_pos b_relative_pos active motor_speed motor_power motor_on"
JOINT += " motor_has_joint_limits min_rotation max_rotation is_fixed_joint rotation"
THRUSTER = "object_index relative_position rotation power active"
COUNTS = ("num_polygons", "num_circles", "num_joints", "num_thrusters")


def plain(value: Any) -> Any:
    """Lists in place of objects with the keys "0", "1", and so on."""
    return [plain(value[str(i)]) for i in range(len(value))] if isinstance(value, dict) else value


def filled(record: Any, rows: list[dict[str, Any]], names: str) -> Any:
    """A Jax2D record with the values of a level file's list."""
    values = {}
    for name in names.split():
        old = getattr(record, name)
        array = np.array([plain(row[name]) for row in rows]).astype(old.dtype)
        values[name] = jnp.array(array.reshape(old.shape))
    return record.replace(**values)


class Peer:
    """One level in Jax2D."""

    def __init__(self, path: Path) -> None:
        content = json.loads(path.read_text(encoding="utf-8"))
        level, counts = content["env_state"], content["static_env_params"]
        static = StaticSimParams(**{name: counts[name] for name in COUNTS})
        state = create_empty_sim(static)
        joints = filled(state.joint, level["joint"], JOINT)
        self.start: SimState = state.replace(
            polygon=filled(state.polygon, level["polygon"], BODY),
            circle=filled(state.circle, level["circle"], BODY),
            joint=joints,
            thruster=filled(state.thruster, level["thruster"], THRUSTER),
            gravity=jnp.array(plain(level["gravity"])),
            collision_matrix=calculate_collision_matrix(static, joints),
        )
        engine, params = PhysicsEngine(static), SimParams()
        self._step = jax.jit(lambda state, action: engine.step(state, params, action)[0])
        self.bindings = [f"motor{joint['motor_binding']}" for joint in level["joint"]]
        self.bindings += [f"thruster{each['thruster_binding']}" for each in level["thruster"]]

    def run(self, actions: dict[str, float]) -> dict[int, dict[str, np.ndarray]]:
        """By control step of MARKS: place and velocity (4,) of every shape by its name."""
        action = jnp.array([actions.get(name, 0.0) for name in self.bindings])
        state, found = self.start, {}
        for tick in range(1, max(MARKS) + 1):
            for _ in range(SUBSTEPS):
                state = self._step(state, action)
            if tick in MARKS:
                found[tick] = {
                    f"{kind}{i}": np.array([*row, *speed])
                    for kind, shapes in (("polygon", state.polygon), ("circle", state.circle))
                    for i, (row, speed) in enumerate(
                        zip(shapes.position, shapes.velocity, strict=True)
                    )
                }
        return found


def ours(scene: Scene, actions: dict[str, float]) -> dict[int, dict[str, np.ndarray]]:
    """The same from this project's engine, up to the end of the episode."""
    action = np.array([[[actions[each.name] for each in scene.actions]]], np.float32)
    found: dict[int, dict[str, np.ndarray]] = {}
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        for tick in range(1, max(MARKS) + 1):
            if worlds.step(action).status[0] != Status.RUNNING:
                break
            if tick in MARKS:
                states = worlds.states[0]
                found[tick] = {scene.bodies[i].name: states[i, :4] for i in scene.moving}
    return found


def compare(path: Path, trials: int) -> dict[int, tuple[float, float]]:
    """By control step: differences (m, m/s), median over the trials that got so far."""
    scene, peer = dataclasses.replace(load_level(path), action_noise=0.0), Peer(path)
    gaps: dict[int, list[tuple[float, float]]] = {}
    for trial in range(trials):
        random = np.random.default_rng(trial)
        actions = {a.name: float(random.uniform(a.low, a.high)) for a in scene.actions}
        mine, theirs = ours(scene, actions), peer.run(actions)
        for tick, bodies in mine.items():
            apart = np.array([state - theirs[tick][name] for name, state in bodies.items()])
            place, speed = np.hypot(*apart[:, :2].T).max(), np.hypot(*apart[:, 2:].T).max()
            gaps.setdefault(tick, []).append((float(place), float(speed)))
    return {tick: tuple(np.median(rows, axis=0).tolist()) for tick, rows in gaps.items()}


def main() -> None:
    """Read the options, print a row per level."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=int, default=3)
    options = parser.parse_args()
    print("| level | " + " | ".join(f"{tick} steps" for tick in MARKS) + " |")
    print("| --- |" + " --- |" * len(MARKS))
    for path in sorted(options.folder.glob("*.json")):
        found = compare(path, options.trials)
        cells = [f"{found[t][0]:.3f} / {found[t][1]:.2f}" if t in found else "" for t in MARKS]
        print(f"| {path.stem} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
