"""Evaluation of a run's checkpoints: which cells are wanted, which are missing, and tuning.

A cell that is present is never computed again, under whatever method or protocol it is shown.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.errors import DivergedError, PartialResult, StateError, UsageError
from rtc_cli.execution.delay_models import constant, read_delay_model
from rtc_cli.execution.estimators import read_estimator
from rtc_cli.execution.methods import METHODS, Method, get_method, get_methods
from rtc_cli.execution.timing import Timing
from rtc_cli.files import read_json, write_json
from rtc_cli.levels import short_name
from rtc_cli.pipeline.executors import Progress
from rtc_cli.pipeline.stages import PREFIX
from rtc_cli.recipe import EvalConfig, TuneConfig
from rtc_cli.runs import Run, open_run
from rtc_cli.tasks import get_task

if TYPE_CHECKING:
    from rtc_cli.core.geometry import ChunkGeometry
    from rtc_cli.core.policy import Policy
    from rtc_cli.execution.delay_models import DelayModel
    from rtc_cli.results import ResultStore
    from rtc_cli.tasks.scene import Scene

TUNED = "pinv-tuned"
"""pinv with the settings that did best on validation episodes of a development seed."""


@dataclass(frozen=True)
class Cell:
    """One point to evaluate: a method under a protocol at (H, s, d).

    `action_noise` replaces the task's own in the worlds of this cell; None leaves it. `timing` has
    delays that vary and the like; None is the geometry's delay, always.
    """

    method: Method
    protocol: str
    geometry: ChunkGeometry
    action_noise: float | None = None
    timing: Timing | None = None

    def scene(self, own: Scene) -> Scene:
        """Return the scene to evaluate in, from the task's own."""
        if self.action_noise is None:
            return own
        return dataclasses.replace(own, action_noise=self.action_noise)


@dataclass(frozen=True)
class Target:
    """Whose checkpoints are evaluated, on which episodes, and where the rows go."""

    folder: Path
    task: str
    train_seed: int
    store: Path
    first_episode: int
    episodes: int
    flow_steps: int
    eval_seed: int
    hold: str = "last"
    reaction_episodes: int = 0
    prefix_kind: str = PREFIX


def episode_store(run: Run, variant: str = "") -> Path:
    """Return the folder of a run's episodes; an ablation's variants have folders of their own."""
    return run.results / "episodes" / variant if variant else run.results / "episodes"


def methods_of(config: EvalConfig) -> tuple[Method, ...]:
    """Return the methods of an evaluation, guided ones with the recipe's settings.

    `pinv-tuned` is left out: its settings are known only once tuning has run (`tuned_method`).
    """
    names = [name for name in config.methods if name != TUNED]
    return tuple(
        _with_guidance(method, config) for method in get_methods(names, matrix=config.matrix)
    )


def _with_guidance(method: Method, config: EvalConfig) -> Method:
    if method.sampler not in ("pinv", "pinv-detached"):
        return method
    return method.with_settings(name=method.name, **config.pinv.model_dump())


def cells_of(config: EvalConfig, horizon: int, methods: Sequence[Method]) -> tuple[Cell, ...]:
    """Return all cells of an evaluation; every one is checked before any is run.

    Cells of one action noise follow each other. Beside `oracle`, `naive` is evaluated without delay
    too, open loop: that is what the losses under delay are measured from.
    """
    from rtc_cli.execution.protocols import OPEN_LOOP, open_loop_cells

    points = {protocol: _points(config, horizon, protocol) for protocol in config.protocols}
    cells = [
        Cell(method, protocol, geometry, timing=None if timing.is_plain else timing)
        for protocol, own in points.items()
        for geometry, timing in own
        for method in methods
    ]
    naive = [method for method in methods if method.name == "naive"]
    if naive and "oracle" in config.methods:
        every = [geometry for own in points.values() for geometry, _ in own]
        cells += [Cell(naive[0], OPEN_LOOP, geometry) for geometry in open_loop_cells(every)]
    noises = config.action_noise or (None,)
    return tuple(dataclasses.replace(cell, action_noise=n) for n in noises for cell in cells)


def timings_of(config: EvalConfig, horizon: int) -> tuple[Timing, ...]:
    """Return all timings of an evaluation: each constant delay or model with each estimator."""
    cap = horizon - 1 if config.delay_cap is None else config.delay_cap
    models: list[DelayModel] = [read_delay_model(text).capped(cap) for text in config.delay_models]
    models = models or [constant(delay) for delay in config.delays]
    estimators = [read_estimator(text) for text in config.estimators]
    timings = (
        Timing(model, estimator, config.on_late, config.on_exceed, config.observation_lag)
        for estimator in estimators
        for model in models
    )
    # Where nothing can be late, what happens to late chunks does not tell cells apart.
    plain = (dataclasses.replace(t, on_late="play") if t.is_plain else t for t in timings)
    return tuple(dict.fromkeys(plain))


def _points(config: EvalConfig, horizon: int, protocol: str) -> list[tuple[ChunkGeometry, Timing]]:
    """Return the geometries of a protocol, each with each of its timings."""
    from rtc_cli.execution.protocols import protocol_cells

    timings = timings_of(config, horizon)
    delays = dict.fromkeys(timing.delay for timing in timings)
    try:
        geometries = protocol_cells(protocol, horizon, delays)
    except UsageError as error:
        if not config.delay_models:
            raise
        shown = ", ".join(dict.fromkeys(f"{t.model.text} as {t.delay}" for t in timings))
        why = f"{error.message}; a delay model counts as its mean in whole steps: {shown}"
        raise UsageError(why, error.hint) from None
    return [(g, timing) for timing in timings for g in geometries if g.delay == timing.delay]


def target_of(
    run: Run, config: EvalConfig, task: str, train_seed: int, variant: str = ""
) -> Target:
    """Return what an evaluation with these settings runs on; `variant` is an ablation's."""
    return Target(
        folder=run.folder,
        task=task,
        train_seed=train_seed,
        store=episode_store(run, variant),
        first_episode=config.first_episode,
        episodes=config.episodes,
        flow_steps=config.flow_steps,
        eval_seed=config.seed,
        hold=config.hold,
        reaction_episodes=config.reaction_episodes,
        prefix_kind=variant or PREFIX,
    )


def evaluate(
    target: Target,
    cells: Sequence[Cell],
    progress: Progress,
    on_diverged: Callable[[Cell, DivergedError], None] | None = None,
) -> None:
    """Evaluate the cells that are missing, and label those that are there under another name.

    A cell in which the policy's chunks become NaN or infinite ends the evaluation with
    DivergedError, or is handed to `on_diverged` and passed over. A cell that exceeds the trained
    delays although it must not ends it with PartialResult; cells that are done are kept.
    """
    from rtc_cli.execution.rollout import SLOTS
    from rtc_cli.results import ResultStore
    from rtc_cli.tasks.batch import WorldBatch

    store = ResultStore(target.store)
    checkpoints = _Checkpoints(target)
    missing = [cell for cell in cells if not _is_present(store, checkpoints, cell)]
    numbered = enumerate(missing)
    for _, group in itertools.groupby(numbered, key=lambda pair: pair[1].action_noise):
        alike = list(group)
        scene = alike[0][1].scene(checkpoints.scene)
        with WorldBatch(scene, min(SLOTS, target.episodes)) as worlds:
            for index, cell in alike:
                done = index * target.episodes

                def on_episode(ended: int, _: int, done: int = done, cell: Cell = cell) -> None:
                    progress(done + ended, len(missing) * target.episodes, _note(cell))

                on_episode(0, 0)
                try:
                    _evaluate_cell(store, checkpoints, cell, worlds, on_episode)
                except DivergedError as error:
                    if on_diverged is None:
                        raise
                    on_diverged(cell, error)
                except PartialResult as error:
                    raise _stopped(target, cell, error) from error


def _stopped(target: Target, cell: Cell, why: PartialResult) -> PartialResult:
    """Say which cell ends an evaluation under `on_exceed` "fail", and what is left of it."""
    where = f"{short_name(target.task)}, training seed {target.train_seed}, {_note(cell)}"
    return PartialResult(
        f"{where}: {why.message}; with --on-exceed fail the evaluation stops there, cells that are "
        "done are kept",
        why.hint,
    )


def _note(cell: Cell) -> str:
    noise = "" if cell.action_noise is None else f", noise {cell.action_noise:g}"
    geometry = cell.geometry
    timing = "" if cell.timing is None else f", {cell.timing.model.text}"
    told = "" if cell.timing is None else f", {cell.timing.estimator.text}"
    point = f"d = {geometry.delay}, s = {geometry.exec_horizon}"
    return f"{cell.method.name}, {point}{timing}{told}{noise}"


class _Checkpoints:
    """The two policies that a target's methods use, read once."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.run = open_run(target.folder)
        self.scene = get_task(self.run.source(target.task))
        self._read: dict[str, tuple[Policy, str, tuple[int, ...] | None]] = {}

    def get(self, kind: str) -> tuple[Policy, str, tuple[int, ...] | None]:
        """Return the policy, its digest and the support of its simulated delays."""
        if kind not in self._read:
            self._read[kind] = self._load(self.target.prefix_kind if kind == "prefix" else kind)
        return self._read[kind]

    def _load(self, kind: str) -> tuple[Policy, str, tuple[int, ...] | None]:
        from rtc_cli.training.checkpoints import Expected, load_policy, policy_digest, read_meta

        folder = self.run.checkpoint(self.target.task, self.target.train_seed, kind)
        if not folder.exists():
            raise StateError(f"checkpoint {folder} is missing", 'run "rtc train" on this run first')
        meta = read_meta(
            folder,
            expect=Expected(
                task=short_name(self.target.task),
                train_seed=self.target.train_seed,
                horizon=self.run.recipe.horizon,
                recipe_hash=self.run.recipe.content_hash,
                scene_digest=self.scene.digest,
            ),
        )
        policy = load_policy(folder)
        support = tuple(meta.delays.support) if meta.delays is not None else None
        return policy, policy_digest(policy), support

    def key(self, cell: Cell) -> str:
        """Return the content key of a cell."""
        from rtc_cli.execution import reaction
        from rtc_cli.execution.inference import TILE
        from rtc_cli.execution.rollout import method_sampler
        from rtc_cli.results import cell_key

        target, geometry = self.target, cell.geometry
        _, digest, support = self.get(cell.method.checkpoint)
        return cell_key(
            policy=digest,
            task=short_name(target.task),
            scene=cell.scene(self.scene).digest,
            sampler=cell.method.sampler,
            settings=method_sampler(cell.method).settings,
            horizon=geometry.horizon,
            exec_horizon=int(geometry.exec_horizon),
            delay=int(geometry.delay),
            schedule=cell.method.schedule,
            hold=target.hold,
            flow_steps=target.flow_steps,
            eval_seed=target.eval_seed,
            first_episode=target.first_episode,
            episodes=target.episodes,
            reaction_episodes=target.reaction_episodes,
            reaction=reaction.definition(),
            tile=TILE,
            timing=_timing_content(cell, support),
        )


def _timing_content(cell: Cell, support: tuple[int, ...] | None) -> dict[str, Any] | None:
    """Return what decides the delays of a cell; a clamp is to the longest trained delay."""
    from rtc_cli.execution.rollout import longest_trained

    if cell.timing is None:
        return None
    return cell.timing.content | {"trained": longest_trained(cell.method, support)}


def _is_present(store: ResultStore, checkpoints: _Checkpoints, cell: Cell) -> bool:
    labels = {"method": cell.method.name, "protocol": cell.protocol}
    key = checkpoints.key(cell)
    if cell.timing is None:
        return store.has(key, **labels)
    # The key of a trace is its content: a file under a new name needs a new label.
    rows = store.find(key, **labels)
    return rows is not None and rows["delay_model"].iloc[0] == cell.timing.model.text


def _evaluate_cell(
    store: ResultStore, checkpoints: _Checkpoints, cell: Cell, worlds: Any, progress: Any
) -> None:
    from rtc_cli.execution.rollout import evaluate_cell
    from rtc_cli.results import relabel

    target, key = checkpoints.target, checkpoints.key(cell)
    policy, digest, support = checkpoints.get(cell.method.checkpoint)
    rows = store.find(key)
    if rows is None:
        first = target.first_episode
        rows = evaluate_cell(
            cell.scene(checkpoints.scene),
            policy,
            cell.method,
            cell.geometry,
            flow_steps=target.flow_steps,
            episodes=range(first, first + target.episodes),
            eval_seed=target.eval_seed,
            hold=target.hold,  # type: ignore[arg-type]
            trained_support=support,
            reaction_episodes=target.reaction_episodes,
            timing=cell.timing,
            worlds=worlds,
            progress=progress,
        )
    if cell.timing is not None:
        rows = rows.assign(delay_model=cell.timing.model.text)
    labels = {"method": cell.method.name, "protocol": cell.protocol}
    store.append(key, relabel(rows, train_seed=target.train_seed, policy=digest, **labels))


# -- tuning ----------------------------------------------------------------------------------


def tuning_grid(config: TuneConfig) -> tuple[Method, ...]:
    """Return pinv with every combination of the grid's settings."""
    combinations = itertools.product(config.mask, config.max_guidance_weight, config.prior_std)
    return tuple(
        METHODS["pinv"].with_settings(
            name=f"pinv[{mask},{weight:g},{std:g}]",
            mask=mask,
            max_guidance_weight=weight,
            prior_std=std,
        )
        for mask, weight, std in combinations
    )


def tuning_cells(config: TuneConfig, horizon: int) -> tuple[Cell, ...]:
    """Return the validation cells: every setting at every tuning delay, s = max(d, 1)."""
    from rtc_cli.execution.protocols import protocol_cells

    return tuple(
        Cell(method, "paper", geometry)
        for geometry in protocol_cells("paper", horizon, config.delays)
        for method in tuning_grid(config)
    )


def tuning_target(run: Run, config: TuneConfig, task: str) -> Target:
    """Return what tuning runs on: the development seed's base, validation episodes."""
    return Target(
        folder=run.folder,
        task=task,
        train_seed=config.train_seed,
        store=run.results / "validation",
        first_episode=config.first_episode,
        episodes=config.episodes,
        flow_steps=run.recipe.eval.flow_steps,
        eval_seed=run.recipe.eval.seed,
    )


def try_settings(target: Target, cells: Sequence[Cell], progress: Progress) -> None:
    """Evaluate every setting of the grid; one that diverges is noted and left out.

    Strong guidance may overflow. That rules the setting out; it is no reason to stop.
    """

    def note(cell: Cell, error: DivergedError) -> None:
        write_json(_diverged_path(target, cell), {"method": cell.method.name, "why": str(error)})

    tried = [cell for cell in cells if not _diverged_path(target, cell).is_file()]
    evaluate(target, tried, progress, on_diverged=note)


def _diverged_path(target: Target, cell: Cell) -> Path:
    settings = "_".join(str(value) for _, value in cell.method.settings)
    name = short_name(target.task)
    return target.store / "diverged" / f"{name}_d{cell.geometry.delay}_{settings}.json"


def _diverged_methods(store: Path) -> set[str]:
    files = (store / "diverged").glob("*.json")
    return {read_json(file, "result of tuning")["method"] for file in files}


def choose_tuned(folder: Path, progress: Progress) -> None:
    """Keep the settings with the best mean success over tasks and tuning delays.

    A setting that diverged anywhere is out. Ties go to the setting that comes first in the grid.
    Writes `results/tuned.json`.
    """
    from rtc_cli.results import ResultStore

    run = open_run(folder)
    config = _tune_config(run)
    store = run.results / "validation"
    rows, diverged = ResultStore(store).load(), _diverged_methods(store)
    per_cell = rows.groupby(["method", "task", "delay"])["solved"].mean()
    success = per_cell.groupby("method").mean()
    grid = tuning_grid(config)
    ranked: list[dict[str, Any]] = [
        {
            "settings": dict(method.settings),
            "success": None if method.name in diverged else float(success[method.name]),
        }
        for method in grid
    ]
    finite = [entry for entry in ranked if entry["success"] is not None]
    if not finite:
        raise DivergedError(
            f"all {len(ranked)} settings of eval.tune diverged", "try smaller guidance weights"
        )
    best = max(finite, key=lambda entry: float(entry["success"]))
    write_json(
        tuned_path(run),
        {
            "method": TUNED,
            "settings": best["settings"],
            "success": best["success"],
            "grid": ranked,
            "train_seed": config.train_seed,
            "first_episode": config.first_episode,
            "episodes": config.episodes,
            "delays": list(config.delays),
            "tasks": list(run.recipe.tasks),
        },
    )


def tuned_path(run: Run) -> Path:
    """Return the file that holds the chosen settings."""
    return run.results / "tuned.json"


def tuned_method(run: Run) -> Method:
    """Return pinv with the tuned settings; StateError before tuning."""
    path = tuned_path(run)
    if not path.is_file():
        raise StateError(
            f'method "{TUNED}" has no settings yet: {path} is missing',
            'give the recipe an [eval.tune] section and run it with "rtc run"',
        )
    settings = read_json(path, "result of tuning")["settings"]
    return get_method("pinv").with_settings(name=TUNED, **settings)


def evaluate_tuned(target: Target, config: EvalConfig, progress: Progress) -> None:
    """Evaluate `pinv-tuned` in every cell of an evaluation."""
    run = open_run(target.folder)
    evaluate(target, cells_of(config, run.recipe.horizon, (tuned_method(run),)), progress)


def _tune_config(run: Run) -> TuneConfig:
    if run.recipe.eval.tune is None:
        raise StateError(f'the recipe "{run.recipe.name}" has no [eval.tune] section')
    return run.recipe.eval.tune
