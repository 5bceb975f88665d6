"""The jobs of a run and the order of their needs.

Jobs come in the order in which they should start. What a recipe's stages share is one job: experts
belong to a task, data and the fork to a training seed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, product

from rtc_cli.execution.methods import METHODS, Method
from rtc_cli.levels import short_name
from rtc_cli.pipeline import evaluation, profiling, stages
from rtc_cli.pipeline.charging import Charged, charged_by
from rtc_cli.pipeline.executors import Job
from rtc_cli.recipe import EvalConfig
from rtc_cli.runs import Run

EXPERTS, DATA, TRAINING, TUNING, EVALUATION, PROFILE = (
    "experts",
    "data",
    "training",
    "tuning",
    "evaluation",
    "profile",
)


def run_plan(run: Run) -> list[Job]:
    """Return the jobs of `rtc run` but for the profile, which must not share the machine.

    Seed by seed, so that an interrupted run holds whole seeds, and the first numbers come early.
    """
    seeds = (seed_plan(run, seed) for seed in run.recipe.train.seeds)
    return [*expert_jobs(run), *chain.from_iterable(seeds)]


def seed_plan(run: Run, seed: int) -> list[Job]:
    """Return what `run_plan` does for one training seed; the first one's has what is done once."""
    recipe = run.recipe
    first = seed == recipe.train.seeds[0]
    return [
        *_training(run, seed),
        *(_diversity(run, seed) if first else ()),
        *_evaluations(run, seed),
        *charged_plan(run, charged_by(recipe.eval, recipe.horizon), recipe.tasks, (seed,)),
        *(_tuning(run) if first else ()),
    ]


def _evaluations(run: Run, seed: int) -> list[Job]:
    """Return the jobs of `[eval]` and of `eval.also`, these named after their place in the list.

    Each comes after the same method's earlier ones: they may share a cell, which is then computed
    once.
    """
    jobs = eval_plan(run, run.recipe.eval, run.recipe.tasks, (seed,))
    for i, config in enumerate(run.recipe.eval.further, start=1):
        known = {job.name for job in jobs}
        for job in eval_plan(run, config, run.recipe.tasks, (seed,)):
            earlier = [job.name, *(_also(job.name, k) for k in range(1, i))]
            needs = (*job.needs, *(name for name in earlier if name in known))
            jobs.append(dataclasses.replace(job, name=_also(job.name, i), needs=needs))
    return jobs


def _also(name: str, place: int) -> str:
    return f"{name} · also {place}"


def train_plan(run: Run) -> list[Job]:
    """Return the jobs of `rtc train`: experts, data, and both checkpoints of every seed."""
    seeds = run.recipe.train.seeds
    trainings = (_training(run, seed) for seed in seeds)
    return [*expert_jobs(run), *chain.from_iterable(trainings), *_diversity(run, seeds[0])]


def _training(run: Run, seed: int) -> list[Job]:
    return [*_data_and_forks(run, (seed,)), *_policies(run, (seed,), ("base", stages.PREFIX))]


def ablation_plan(run: Run) -> list[Job]:
    """Return the jobs of `rtc ablate`: the variants go on from one fork per training seed."""
    recipe = run.recipe
    variants = tuple(recipe.ablation.variants) if recipe.ablation is not None else ()
    jobs = [
        *expert_jobs(run),
        *_data_and_forks(run, recipe.train.seeds),
        *_policies(run, recipe.train.seeds, variants),
    ]
    return [*jobs, *_variant_evaluations(run, variants)]


def _variant_evaluations(run: Run, variants: Sequence[str]) -> list[Job]:
    """Return one job per variant; methods of the base policy have no part in an ablation."""
    config = run.recipe.eval
    methods = [m for m in evaluation.methods_of(config) if m.checkpoint == "prefix"]
    cells = evaluation.cells_of(config, run.recipe.horizon, methods)
    jobs: list[Job] = []
    for task, seed, variant in product(run.recipe.tasks, run.recipe.train.seeds, variants):
        target = evaluation.target_of(run, config, task, seed, variant)
        name = f"evaluate {variant} · {short_name(task)} · seed {seed}"
        work = partial(evaluation.evaluate, target, cells)
        jobs.append(Job(name, EVALUATION, work, (_policy_name(task, seed, variant),)))
    return jobs


def eval_plan(
    run: Run, config: EvalConfig, tasks: Sequence[str], seeds: Sequence[int] | None = None
) -> list[Job]:
    """Return one job per task, training seed and distinct way of making chunks.

    Methods that differ in their name only share a job: no two jobs compute the same cell.
    """
    horizon = run.recipe.horizon
    groups: dict[tuple[object, ...], list[Method]] = {}
    for method in evaluation.methods_of(config):
        content = (method.checkpoint, method.sampler, method.settings, method.schedule)
        groups.setdefault(content, []).append(method)
    plans = [
        (methods, evaluation.cells_of(config, horizon, methods)) for methods in groups.values()
    ]
    tuned = evaluation.TUNED in config.methods or config.tune is not None
    jobs: list[Job] = []
    for task, seed in product(tasks, run.recipe.train.seeds if seeds is None else seeds):
        target = evaluation.target_of(run, config, task, seed)
        for methods, cells in plans:
            work = partial(evaluation.evaluate, target, cells)
            jobs.append(_evaluation(task, seed, methods[0], work))
        if tuned:
            work = partial(evaluation.evaluate_tuned, target, config)
            jobs.append(_evaluation(task, seed, METHODS["pinv"], work, tuned=True))
    return jobs


def charged_plan(
    run: Run, charged: Sequence[Charged], tasks: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    """Return the jobs of all evaluations at equal hardware that are possible.

    Each comes after the method's usual evaluation, if that is in the same plan: they may share
    a cell, which is then computed once.
    """
    jobs = []
    for each in charged:
        if each.config is None:
            continue
        label = f"K = {each.charge.flow_steps}, d = {each.charge.delay}"
        for job in eval_plan(run, each.config, tasks, seeds):
            needs = (*job.needs, job.name)
            jobs.append(dataclasses.replace(job, name=f"{job.name} · {label}", needs=needs))
    return jobs


def _evaluation(
    task: str, seed: int, method: Method, work: Callable[..., None], *, tuned: bool = False
) -> Job:
    name = (
        f"evaluate {evaluation.TUNED if tuned else method.name} · {short_name(task)} · seed {seed}"
    )
    needs = (_policy_name(task, seed, method.checkpoint), *((_CHOOSE,) if tuned else ()))
    return Job(name, EVALUATION, work, needs)


def profile_plan(run: Run) -> list[Job]:
    """Return the one job that times the samplers; nothing else may run beside it."""
    return [Job("profile", PROFILE, partial(profiling.profile, run.folder))]


def expert_jobs(run: Run) -> list[Job]:
    """Return the jobs that train a run's experts."""
    return [
        Job(
            _expert_name(task, seed),
            EXPERTS,
            partial(stages.train_expert, run.folder, task, seed),
        )
        for task, seed in product(run.recipe.tasks, run.recipe.experts.seeds)
    ]


def _data_and_forks(run: Run, seeds: Sequence[int]) -> list[Job]:
    jobs: list[Job] = []
    for task, seed in product(run.recipe.tasks, seeds):
        experts = tuple(_expert_name(task, expert) for expert in run.recipe.experts.seeds)
        data = _data_name(task, seed)
        collect = partial(stages.collect_data, run.folder, task, seed)
        jobs.append(Job(data, DATA, collect, experts))
        jobs.append(_policy(run, task, seed, "fork", data))
    return jobs


def _diversity(run: Run, seed: int) -> list[Job]:
    return [
        Job(
            f"diversity · {short_name(task)}",
            EXPERTS,
            partial(stages.measure_diversity, run.folder, task, seed),
            (_data_name(task, seed),),
        )
        for task in run.recipe.tasks
    ]


def _policies(run: Run, seeds: Sequence[int], kinds: Sequence[str]) -> list[Job]:
    return [
        _policy(run, task, seed, kind, _policy_name(task, seed, "fork"))
        for task, seed, kind in product(run.recipe.tasks, seeds, kinds)
    ]


def _policy(run: Run, task: str, seed: int, kind: str, need: str) -> Job:
    work = partial(stages.train_policy, run.folder, task, seed, kind)
    return Job(_policy_name(task, seed, kind), TRAINING, work, (need,))


def _expert_name(task: str, seed: int) -> str:
    return f"expert · {short_name(task)} · seed {seed}"


def _data_name(task: str, seed: int) -> str:
    return f"data · {short_name(task)} · seed {seed}"


def _policy_name(task: str, seed: int, kind: str) -> str:
    return f"{kind} · {short_name(task)} · seed {seed}"


_CHOOSE = "choose pinv's settings"


def _tuning(run: Run) -> list[Job]:
    config = run.recipe.eval.tune
    if config is None:
        return []
    cells = evaluation.tuning_cells(config, run.recipe.horizon)
    seeds = (config.train_seed,)
    jobs = [*_data_and_forks(run, seeds), *_policies(run, seeds, ("base",))]
    names = []
    for task in run.recipe.tasks:
        name = f"tune pinv · {short_name(task)}"
        target = evaluation.tuning_target(run, config, task)
        need = (_policy_name(task, config.train_seed, "base"),)
        jobs.append(Job(name, TUNING, partial(evaluation.try_settings, target, cells), need))
        names.append(name)
    choose = partial(evaluation.choose_tuned, run.folder)
    return [*jobs, Job(_CHOOSE, TUNING, choose, tuple(names))]
