"""Rollouts of one cell: a policy, a method and a geometry on many episodes of one task.

One cycle of an episode is one inference followed by one open-loop call of the physics. Episodes do
not wait for each other: whatever episodes are ready make up the next tile, so finished episodes
cost no inference, and physics (here) overlaps with inference (one other thread; XLA releases the
interpreter lock). An episode's result is a function of the policy, the cell, the seeds and its
number only, bit for bit, whatever the other episodes, the tiles' composition and the workers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy
from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.execution.inference import TILE, ChunkMaker
from rtc_cli.execution.methods import Method
from rtc_cli.execution.metrics import Layout, Trace, constant_layout, layout_metrics
from rtc_cli.execution.reaction import PushedWorlds, draw_pushes
from rtc_cli.execution.running import Plan, Rollout
from rtc_cli.execution.timing import Timing, count_inferences, make_clock, plain
from rtc_cli.execution.varying import VaryingPlan, VaryingRollout, count_cases, draw_delays
from rtc_cli.execution.worlds import IntArray, Worlds
from rtc_cli.samplers import Sampler, get_sampler
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

SLOTS = 256
"""Worlds that run at once if the caller brings none: enough to fill tiles, few for the caches."""

HOLDS = ("last", "zero")


def method_sampler(method: Method) -> Sampler:
    """The sampler of a method, with its settings; ``.settings`` has the defaults filled in."""
    return get_sampler(method.sampler, **dict(method.settings))


def is_beyond_trained(
    method: Method, delay: int, trained_support: Sequence[int] | None = None
) -> bool:
    """Whether the sampler conditions on a delay that the checkpoint was not trained for.

    ``trained_support`` is the support of the checkpoint's delay distribution, None for one that
    was trained without delays. Only the sampler ``prefix`` needs such training.
    """
    trained = longest_trained(method, trained_support)
    return trained is not None and delay > trained


def longest_trained(method: Method, trained_support: Sequence[int] | None = None) -> int | None:
    """The longest delay that a method's checkpoint was trained to be told; None: it is not told."""
    return max(trained_support or (0,)) if method.sampler == "prefix" else None


def evaluate_cell(
    scene: Scene,
    policy: Policy,
    method: Method,
    geometry: ChunkGeometry,
    *,
    flow_steps: int,
    episodes: Sequence[int],
    eval_seed: int,
    hold: Literal["last", "zero"] = "last",
    tile: int = TILE,
    workers: int = 1,
    trained_support: Sequence[int] | None = None,
    reaction_episodes: int = 0,
    timing: Timing | None = None,
    worlds: Worlds | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> pd.DataFrame:
    """Run every episode of a cell once.

    Args:
        scene: the task.
        policy: the checkpoint that ``method.checkpoint`` names.
        method: sampler, settings and schedule.
        geometry: H, s and d; H must be the policy's. With a ``timing``, d is ``timing.delay``.
        flow_steps: Euler steps K of the sampler.
        episodes: numbers (and world seeds) of the episodes, each once.
        eval_seed: seed of the chunks' initial noise.
        hold: what ``sync`` executes while it waits: the last action, or zero in physical units.
        tile: rows of one inference.
        workers: processes that step the worlds; ignored if ``worlds`` is given.
        trained_support: support of the delay distribution the checkpoint was trained with.
        reaction_episodes: the first so many episodes run once more, with a push, to measure the
            reaction (``rtc_cli.execution.reaction``).
        timing: delays that vary, what the sampler is told of them, and how old observations are;
            None is the geometry's delay, always.
        worlds: a batch of this scene to reuse, of any size; it is left as it ends up.
        progress: called with (finished episodes, all episodes).

    Returns:
        One row per episode, in the order of ``episodes``: the columns of
        ``rtc_cli.results.EPISODE_COLUMNS`` but ``train_seed``, ``protocol``, ``policy`` and
        ``cell``, which only the caller knows (``rtc_cli.results.relabel``).

    Raises:
        UsageError: the arguments do not fit each other.
        DivergedError: the policy produced NaN or infinity.
        PartialResult: a conditioned delay exceeds the trained ones, and ``timing`` says "fail".
    """
    _check(scene, policy, geometry, episodes, hold, tile)
    maker = ChunkMaker(
        policy,
        _asked(geometry, method),
        flow_steps=flow_steps,
        task=scene.name,
        eval_seed=eval_seed,
        tile=tile,
    )
    sampler = method_sampler(method)
    numbers = np.asarray(episodes, np.int64)
    trained = longest_trained(method, trained_support)
    plan = _plan(scene, method, geometry, hold, timing, trained, eval_seed, numbers)
    with _worlds(scene, len(episodes), workers, worlds) as batch, ThreadPoolExecutor(1) as thread:
        run = _rollout(plan, maker, sampler, batch, thread, numbers)
        run.run(progress or (lambda done, total: None))
        reaction = np.full(len(numbers), np.nan)
        if reaction_episodes:
            first = numbers[:reaction_episodes]
            pushes = draw_pushes(scene, first, run.lengths[: len(first)], geometry.horizon)
            pushed = PushedWorlds(batch, first, pushes)
            twin = _rollout(plan, maker, sampler, pushed, thread, first)
            twin.run(lambda done, total: None)
            reaction[: len(first)] = run.reaction_to(pushes, twin)
    return _rows(scene, method, run, sampler, timing, trained).assign(
        measured_reaction_ticks=reaction,
        flow_steps=flow_steps,
    )


def _plan(
    scene: Scene,
    method: Method,
    geometry: ChunkGeometry,
    hold: str,
    timing: Timing | None,
    trained: int | None,
    eval_seed: int,
    episodes: IntArray,
) -> Plan:
    if timing is None:
        return Plan(geometry, method.schedule, hold, scene.max_ticks)
    exec_horizon = int(geometry.exec_horizon)
    count = count_inferences(exec_horizon, scene.max_ticks, timing.observation_lag)
    clock = make_clock(
        draw_delays(timing.model, scene, eval_seed, episodes)[:, :count],
        timing,
        horizon=geometry.horizon,
        exec_horizon=exec_horizon,
        schedule=method.schedule,
        trained=trained,
    )
    fails_beyond = trained if timing.on_exceed == "fail" else None
    return VaryingPlan(geometry, method.schedule, hold, scene.max_ticks, clock, fails_beyond)


def _rollout(
    plan: Plan,
    maker: ChunkMaker,
    sampler: Sampler,
    worlds: Worlds,
    thread: ThreadPoolExecutor,
    episodes: IntArray,
) -> Rollout:
    if isinstance(plan, VaryingPlan):
        return VaryingRollout(plan, maker, sampler, worlds, thread, episodes)
    return Rollout(plan, maker, sampler, worlds, thread, episodes)


def _check(
    scene: Scene,
    policy: Policy,
    geometry: ChunkGeometry,
    episodes: Sequence[int],
    hold: str,
    tile: int,
) -> None:
    config = policy.config
    if geometry.horizon != config.horizon:
        raise UsageError(
            f"horizon {geometry.horizon} does not fit a policy of horizon {config.horizon}",
            "evaluate with the horizon that the policy was trained with",
        )
    if (scene.obs_dim, scene.action_dim) != (config.obs_dim, config.action_dim):
        raise UsageError(
            f"task {scene.name} has {scene.obs_dim} observations and {scene.action_dim} actions, "
            f"the policy {config.obs_dim} and {config.action_dim}",
            "evaluate the policy on the task that it was trained on",
        )
    if hold not in HOLDS:
        raise UsageError(f'unknown hold "{hold}".{did_you_mean(hold, HOLDS)}')
    if tile < 1:
        raise UsageError(f"tile {tile} is not possible", "give an integer >= 1")
    if not len(episodes) or len(set(episodes)) != len(episodes):
        raise UsageError(
            f"{len(episodes)} episodes, {len(set(episodes))} of them different: must be at least "
            "one, each once",
            "give every episode number once",
        )


def _asked(geometry: ChunkGeometry, method: Method) -> ChunkGeometry:
    """What the sampler is asked for: only under ``async`` does it begin at index d of its chunk."""
    return geometry if method.schedule == "async" else replace(geometry, delay=0)


@contextmanager
def _worlds(scene: Scene, count: int, workers: int, given: Worlds | None) -> Iterator[Worlds]:
    if given is not None:
        yield given
        return
    with WorldBatch(scene, min(count, SLOTS), workers=workers) as made:
        yield made


def _rows(
    scene: Scene,
    method: Method,
    run: Rollout,
    sampler: Sampler,
    timing: Timing | None,
    trained: int | None,
) -> pd.DataFrame:
    solved = run.status == Status.SOLVED
    trace = Trace(
        actions=run.executed[:, : scene.max_ticks],
        lengths=run.lengths,
        solved=solved,
        seam_gap=run.seam_gap,
        prefix_error=run.prefix_error,
    )
    layout, cases = _layout(run, trained)
    exceeded = cases["exceeded_requests"] > 0
    if timing is not None and timing.on_exceed == "clamp":
        exceeded = np.zeros_like(exceeded)
    columns: dict[str, NDArray[np.generic] | str | float | None] = {
        "task": scene.name,
        "method": method.name,
        "checkpoint": method.checkpoint,
        "sampler": method.sampler,
        "settings": json.dumps(sampler.settings, sort_keys=True),
        "schedule": method.schedule,
        "delay": run.plan.delay,
        "exec_horizon": run.plan.exec_horizon,
        "action_noise": scene.action_noise,
        "episode": run.episodes,
        "status": run.status.astype(np.int64),
        "solved": solved,
        "solved_last_substep": run.solved_last if scene.last_substep_rule else None,
        "length": run.lengths,
        "scene": scene.digest,
        "beyond_trained": exceeded,
    }
    columns |= (timing or plain(run.plan.delay)).columns
    return pd.DataFrame(columns | cases | layout_metrics(trace, layout, scene.control_hz))


def _layout(run: Rollout, trained: int | None) -> tuple[Layout, dict[str, IntArray]]:
    """What acts when in the episodes of a rollout, and its special cases."""
    plan = run.plan
    if isinstance(plan, VaryingPlan):
        return plan.layout(), count_cases(plan.clock, run.lengths)
    layout = constant_layout(
        horizon=plan.geometry.horizon,
        exec_horizon=plan.exec_horizon,
        delay=plan.delay,
        ticks=plan.max_ticks,
        schedule=plan.schedule,
    )
    none = np.zeros(len(run.lengths), np.int64)
    asked = ((layout.ready - plan.delay) < run.lengths[:, None]).sum(axis=1)
    beyond = trained is not None and plan.delay > trained
    cases = {"exceeded_requests": asked if beyond else none}
    return layout, {"dropped_chunks": none, "clipped_requests": none} | cases
