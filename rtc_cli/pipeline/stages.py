"""What a run computes before it evaluates: experts, data, policies.

Each function computes one artefact of a run, unless it is there already. They are the work of
jobs (`pipeline.plan`), so they take a run's folder and plain values, and import what is heavy only
when they run.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rtc_cli.errors import StateError
from rtc_cli.files import read_json, write_json
from rtc_cli.levels import short_name
from rtc_cli.pipeline.executors import Progress
from rtc_cli.recipe import DelayConfig
from rtc_cli.runs import Run, open_run
from rtc_cli.tasks import get_task

if TYPE_CHECKING:
    from rtc_cli.core.delays import DelayDistribution
    from rtc_cli.core.policy import Policy
    from rtc_cli.data.chunks import ChunkData
    from rtc_cli.experts.policy import ExpertPolicy
    from rtc_cli.training.checkpoints import CheckpointMeta
    from rtc_cli.training.loop import EpochMetrics, TrainState

SAVE_SECONDS = 10.0
"""Training is saved at the first epoch that ends so long after the last save."""

DIVERSITY_STATES = 2048
"""States of the data, evenly spread, on which experts are compared."""

PREFIX = "prefix"
"""The checkpoint trained with the recipe's own delays; an ablation's variants have other names."""


def train_expert(folder: Path, task: str, seed: int, progress: Progress) -> None:
    """Train one PPO expert of a task and keep it with its record `<seed>.json`.

    StateError where the expert of another version of the task is there.
    """
    run = open_run(folder)
    target = run.experts(task) / str(seed)
    record = run.experts(task) / f"{seed}.json"
    scene = get_task(run.source(task))
    if record.is_file():
        known = read_json(record, "record of an expert").get("scene", scene.digest)
        if known != scene.digest:
            raise StateError(
                f"{target} is an expert of another version of task {short_name(task)}: scene "
                f"{known[:12]}, now {scene.digest[:12]}",
                "restore the task, or start a new run",
            )
        return
    from rtc_cli.experts.ppo import train_expert as train

    def on_rollout(state: dict[str, Any]) -> None:
        success = state["success"]
        note = f"success {success:.2f}" if success is not None else "success ?"
        progress(state["steps"], state["max_steps"], f"{note}, {state['steps_per_s']:,.0f} steps/s")

    result = train(scene, run.recipe.experts.of(short_name(task)), seed, progress=on_rollout)
    if not target.exists():
        result.policy.save(target)
    write_json(
        record,
        {
            "task": short_name(task),
            "scene": scene.digest,
            "seed": seed,
            "success": result.success,
            "steps": result.steps,
            "seconds": result.seconds,
        },
    )


def collect_data(folder: Path, task: str, train_seed: int, progress: Progress) -> None:
    """Collect the episodes that one training seed learns from; those that are there are checked."""
    run = open_run(folder)
    from rtc_cli.data.collect import collect, first_data_episode
    from rtc_cli.experts.policy import mixture_actor

    collect(
        get_task(run.source(task)),
        mixture_actor(mixture(run, task), seed=train_seed, policy_std=run.recipe.data.policy_std),
        run.recipe.data.transitions,
        first_episode=first_data_episode(train_seed),
        seed=train_seed,
        folder=run.data(task, train_seed),
        progress=lambda state: progress(state["transitions"], state["target"], "control steps"),
    )


def measure_diversity(folder: Path, task: str, train_seed: int, progress: Progress) -> None:
    """Measure how differently the experts act, on states of one training seed's data."""
    run = open_run(folder)
    target = run.results / "diversity" / f"{short_name(task)}.json"
    if target.is_file():
        return
    import numpy as np

    from rtc_cli.data.episodes import EpisodeStore
    from rtc_cli.experts.diversity import hellinger_distances, mean_distance

    observations = EpisodeStore.open(run.data(task, train_seed)).observations
    rows = np.linspace(0, len(observations) - 1, min(DIVERSITY_STATES, len(observations)))
    distances = hellinger_distances(
        mixture(run, task), observations[rows.astype(int)], run.recipe.data.policy_std
    )
    record = {
        "task": short_name(task),
        "experts": len(distances),
        "states": len(rows),
        "distances": distances.tolist(),
        "mean_distance": mean_distance(distances),
    }
    write_json(target, record)


def mixture(run: Run, task: str) -> list[ExpertPolicy]:
    """Return the experts that make data: the good ones, or the first by seed (`data.experts`).

    StateError where there are none, or fewer than the recipe asks for.
    """
    from rtc_cli.experts.policy import ExpertPolicy

    config = run.recipe.experts
    records = [
        read_json(run.experts(task) / f"{seed}.json", "record of an expert")
        for seed in config.seeds
    ]
    good = [record["seed"] for record in records if record["success"] >= config.min_success]
    if not good:
        best = max(record["success"] for record in records)
        raise StateError(
            f"no expert of task {short_name(task)} is good enough: the best succeeds in {best:.2f} "
            f"of its episodes, experts.min_success is {config.min_success}",
            "add experts.seeds, raise experts.max_steps or lower experts.min_success",
        )
    wanted = run.recipe.data.experts
    if wanted is not None and len(good) < wanted:
        raise StateError(
            f"task {task} has {len(good)} experts that succeed in at least {config.min_success} "
            f"of their episodes; data.experts is {wanted}",
            "add experts.seeds, or lower data.experts or experts.min_success",
        )
    acting = good if wanted is None else sorted(good)[:wanted]
    return [ExpertPolicy.load(run.experts(task) / str(seed)) for seed in acting]


def train_policy(folder: Path, task: str, train_seed: int, kind: str, progress: Progress) -> None:
    """Train one checkpoint: "fork", "base" (on from the fork), "prefix" or an ablation's variant.

    `base` and the prefix checkpoints go on from the same fork, through the same minibatches and
    learning rates; they differ in the simulated delays only. Resumes from the last whole epoch.
    """
    run = open_run(folder)
    target = run.checkpoint(task, train_seed, kind)
    if target.exists():
        return
    from rtc_cli.training.checkpoints import save_checkpoint

    fit_ = _Fit(run, task, train_seed, kind)
    state = fit_.run(progress)
    save_checkpoint(target, state, fit_.meta)
    fit_.clean_up()


class _Fit:
    """One call of `training.loop.fit` with its start, its checkpoints and its curve."""

    def __init__(self, run: Run, task: str, train_seed: int, kind: str) -> None:
        from rtc_cli.training.loop import fork_epoch

        self.run_, self.task, self.train_seed, self.kind = run, task, train_seed, kind
        self.config = run.recipe.train
        self.fork_epoch = fork_epoch(self.config)
        self.stop_epoch = self.fork_epoch if kind == "fork" else self.config.epochs
        self.delays = delay_distribution(delays_of(run, kind))
        self.data = _windows(run, task, train_seed)
        self.policy, self.meta = self._new_policy()
        self.partial = run.folder / "partial" / short_name(task) / f"seed-{train_seed}" / kind
        self.curve = _Curve(curve_path(run, task, train_seed, kind), task, train_seed, kind)

    def run(self, progress: Progress) -> TrainState:
        """Train from the newest state there is until this checkpoint's last epoch."""
        from rtc_cli.training.checkpoints import save_progress
        from rtc_cli.training.loop import Progress as Step
        from rtc_cli.training.loop import fit

        state = self._start()
        self.curve.cut(state.epoch if state is not None else 0)

        saved = -math.inf

        def on_epoch(state: TrainState, metrics: EpochMetrics) -> None:
            nonlocal saved
            self.curve.add(metrics)
            if state.epoch < self.stop_epoch and time.monotonic() - saved > SAVE_SECONDS:
                save_progress(self.partial, state, self.meta)
                saved = time.monotonic()

        def on_step(step: Step) -> None:
            note = f"loss {step.loss:.3f}, {step.samples_per_s:,.0f} samples/s"
            progress(step.step, step.steps, note)

        result = fit(
            self.policy,
            self.data,
            self.config,
            seed=self.train_seed,
            delays=self.delays,
            stop_epoch=self.stop_epoch,
            state=state,
            on_epoch=on_epoch,
            on_progress=on_step,
        )
        return result.state

    def clean_up(self) -> None:
        """Remove the states of unfinished training, once the checkpoint stands."""
        shutil.rmtree(self.partial, ignore_errors=True)

    def _start(self) -> TrainState | None:
        from rtc_cli.training.checkpoints import Expected, latest_progress, load_checkpoint

        newest = latest_progress(self.partial)
        if newest is not None:
            return load_checkpoint(newest, expect=self.meta)[0]
        if self.kind == "fork":
            return None
        if self.kind == "base":
            self.curve.start_from(curve_path(self.run_, self.task, self.train_seed, "fork"))
        fork = self.run_.checkpoint(self.task, self.train_seed, "fork")
        expected = dataclasses.replace(Expected.of(self.meta), kind="fork")
        return load_checkpoint(fork, expect=expected)[0]

    def _new_policy(self) -> tuple[Policy, CheckpointMeta]:
        import jax

        from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
        from rtc_cli.training.checkpoints import CheckpointMeta

        scene, recipe = get_task(self.run_.source(self.task)), self.run_.recipe
        config = PolicyConfig(
            network=recipe.network.kind,
            options=tuple(sorted(recipe.network.options().items())),
            horizon=recipe.horizon,
            obs_dim=scene.obs_dim,
            action_dim=scene.action_dim,
        )
        data = self.data
        normaliser = Normaliser.from_data(data.observations, data.actions, data.valid)
        policy = Policy.init(config, normaliser, jax.random.key(self.train_seed))
        meta = CheckpointMeta(
            task=short_name(self.task),
            kind=_kind_of(self.kind),
            train_seed=self.train_seed,
            epoch=0,
            epochs=self.config.epochs,
            config=config,
            normaliser=normaliser,
            delays=self.delays,
            recipe_hash=recipe.content_hash,
            scene_digest=scene.digest,
        )
        return policy, meta


class _Curve:
    """The training curve of one checkpoint, `results/training/<task>-seed<k>-<kind>.json`."""

    _COLUMNS = ("epochs", "loss", "learning_rate", "samples_per_s", "seconds")

    def __init__(self, path: Path, task: str, train_seed: int, kind: str) -> None:
        self.path = path
        self.labels = {"task": short_name(task), "train_seed": train_seed, "checkpoint": kind}
        self.columns: dict[str, list[float]] = {name: [] for name in self._COLUMNS}
        if path.is_file():
            self._read(path)

    def start_from(self, path: Path) -> None:
        """Begin with the epochs of another curve."""
        if not self.columns["epochs"] and path.is_file():
            self._read(path)

    def cut(self, epoch: int) -> None:
        """Forget epochs after `epoch`: they are about to be run again."""
        kept = sum(1 for number in self.columns["epochs"] if number <= epoch)
        self.columns = {name: values[:kept] for name, values in self.columns.items()}

    def add(self, metrics: EpochMetrics) -> None:
        """Add one epoch and write the file."""
        values = (
            metrics.epoch,
            metrics.loss,
            metrics.learning_rate,
            metrics.samples_per_s,
            metrics.seconds,
        )
        for name, value in zip(self._COLUMNS, values, strict=True):
            self.columns[name].append(value)
        write_json(self.path, self.labels | self.columns)

    def _read(self, path: Path) -> None:
        found = read_json(path, "training curve")
        self.columns = {name: list(found[name]) for name in self._COLUMNS}


def _kind_of(name: str) -> Literal["base", "fork", "prefix"]:
    """Return what kind a checkpoint is; an ablation's variants are prefix checkpoints."""
    return "fork" if name == "fork" else "base" if name == "base" else "prefix"


def curve_path(run: Run, task: str, train_seed: int, kind: str) -> Path:
    """Return the file of one training curve."""
    return run.results / "training" / f"{short_name(task)}-seed{train_seed}-{kind}.json"


def delays_of(run: Run, kind: str) -> DelayConfig | None:
    """Return the simulated delays that a checkpoint is trained with; None is none."""
    if kind in ("fork", "base"):
        return None
    if kind == PREFIX:
        return run.recipe.train.delays
    if run.recipe.ablation is None or kind not in run.recipe.ablation.variants:
        raise StateError(f'the recipe "{run.recipe.name}" has no checkpoint "{kind}"')
    return run.recipe.ablation.variants[kind]


def delay_distribution(config: DelayConfig | None) -> DelayDistribution | None:
    """Return the delay distribution that a recipe declares."""
    from rtc_cli.core.delays import DelayDistribution

    if config is None:
        return None
    makers: dict[str, Callable[[], DelayDistribution]] = {
        "uniform": lambda: DelayDistribution.uniform(config.support),
        "exponential": lambda: DelayDistribution.exponential(config.support, config.rate),
        "constant": lambda: DelayDistribution.constant(config.value or 0),
        "weights": lambda: DelayDistribution.weights_(config.support, config.weights or ()),
    }
    return makers[config.kind]()


def _windows(run: Run, task: str, train_seed: int) -> ChunkData:
    """Return exactly `data.transitions` windows: with equal shapes, seeds share a program."""
    from rtc_cli.data.chunks import ChunkData, chunk_windows
    from rtc_cli.data.episodes import EpisodeStore

    store = EpisodeStore.open(run.data(task, train_seed))
    windows = chunk_windows(store, run.recipe.horizon)
    count = run.recipe.data.transitions
    return ChunkData(windows.observations[:count], windows.actions[:count], windows.valid[:count])
