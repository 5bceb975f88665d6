"""A grid ablation: every combination of settings is a run of its own, below the parent's folder.

    <run>/variants/<combination>/   a whole run; its `experts` is a link to the parent's

So each combination has its own recipe, lock, stages and results, and can be looked at with any
command; experts are trained once, in the parent.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rtc_cli.files import os_error
from rtc_cli.pipeline.executors import Job
from rtc_cli.pipeline.plan import expert_jobs, seed_plan
from rtc_cli.recipe import Recipe, Setting, with_settings
from rtc_cli.runs import Run, open_or_create_run

FOLDER = "variants"
_LONGEST_NAME = 80


@dataclass(frozen=True)
class Combination:
    """One point of a grid: `name` is its folder's, `recipe` what its run computes."""

    name: str
    recipe: Recipe


def combinations(recipe: Recipe) -> tuple[Combination, ...]:
    """Return all combinations of a recipe's grid; none where it has no grid.

    Raises UsageError for a key that does not exist or a value that does not fit.
    """
    grid = recipe.ablation.grid if recipe.ablation is not None else {}
    if not grid:
        return ()
    found = []
    for values in itertools.product(*grid.values()):
        settings = dict(zip(grid, values, strict=True))
        name = _name(settings)
        own = with_settings(recipe, settings, f"{recipe.name}.{name}"[:_LONGEST_NAME])
        found.append(Combination(name, own))
    return tuple(found)


def _name(settings: dict[str, Setting]) -> str:
    """Return a folder's name, as in "experts-4_policy_std-0.5"."""
    last = [key.rpartition(".")[2] for key in settings]
    keys = last if len(set(last)) == len(last) else list(settings)
    text = "_".join(f"{key}-{value}" for key, value in zip(keys, settings.values(), strict=True))
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)


def open_runs(run: Run) -> tuple[Run, ...]:
    """Return the runs of a grid's combinations; those that are missing are created.

    They have the training seeds of `run`, and more if they were given more.
    """
    return tuple(_open(run, combination) for combination in combinations(run.recipe))


def _open(run: Run, combination: Combination) -> Run:
    folder = run.folder / FOLDER / combination.name
    opened = open_or_create_run(combination.recipe, folder)
    link = folder / "experts"
    try:
        if not link.is_symlink():
            link.symlink_to(Path("..") / ".." / "experts", target_is_directory=True)
    except OSError as error:
        raise os_error(error, link) from error
    return opened


@contextmanager
def locked(runs: Sequence[Run]) -> Iterator[None]:
    """Be the only writer of several runs within the block; StateError where another is."""
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.lock())
        yield


def grid_plan(run: Run, runs: Sequence[Run]) -> list[Job]:
    """Return the jobs of all combinations, seed by seed, and of the experts that they share."""
    jobs = expert_jobs(run)
    shared = {job.name for job in jobs}
    for seed in run.recipe.train.seeds:
        for own in runs:
            jobs += [_of(own.folder.name, job, shared) for job in seed_plan(own, seed)]
    return jobs


def _of(name: str, job: Job, shared: set[str]) -> Job:
    """Return a combination's job under a name that no other combination's has."""
    needs = tuple(need if need in shared else f"{name} · {need}" for need in job.needs)
    return dataclasses.replace(job, name=f"{name} · {job.name}", needs=needs)
