"""The plan computes shared things once and orders jobs by their needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtc_cli.errors import UsageError
from rtc_cli.pipeline.checks import check_recipe
from rtc_cli.pipeline.plan import ablation_plan, eval_plan, run_plan, train_plan
from rtc_cli.recipe import Recipe, load_recipe
from rtc_cli.runs import Run


def _run(recipe: Recipe) -> Run:
    return Run(Path("nowhere"), recipe, {})


@pytest.mark.parametrize("name", ["quickstart", "standard", "kinetix", "paper"])
def test_every_need_is_an_earlier_job_and_names_are_unique(name: str) -> None:
    recipe = load_recipe(name, ["levels=nowhere"] if name == "kinetix" else [])
    jobs = run_plan(_run(recipe))
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    assert all(need in names for job in jobs for need in job.needs)
    # No cycle: repeatedly run what can run.
    left = {job.name: set(job.needs) for job in jobs}
    while left:
        ready = {name for name, needs in left.items() if needs.isdisjoint(left)}
        assert ready, f"jobs wait for each other: {sorted(left)}"
        left = {name: needs for name, needs in left.items() if name not in ready}


def test_both_policies_of_a_seed_go_on_from_one_fork() -> None:
    recipe = load_recipe("standard")
    jobs = {job.name: job for job in train_plan(_run(recipe))}
    for task in recipe.tasks:
        for seed in recipe.train.seeds:
            fork = f"fork · {task} · seed {seed}"
            assert jobs[f"base · {task} · seed {seed}"].needs == (fork,)
            assert jobs[f"prefix · {task} · seed {seed}"].needs == (fork,)


def test_an_ablation_shares_everything_up_to_the_fork() -> None:
    recipe = load_recipe("ablations/delay_distribution")
    assert recipe.ablation is not None
    names = [job.name for job in ablation_plan(_run(recipe))]
    cases = len(recipe.tasks) * len(recipe.train.seeds)
    assert sum(name.startswith("fork") for name in names) == cases
    for variant in recipe.ablation.variants:
        assert sum(name.startswith(f"{variant} ·") for name in names) == cases


def test_tuning_uses_a_seed_that_is_not_evaluated() -> None:
    recipe = load_recipe("standard")
    assert recipe.eval.tune is not None
    evaluated = [job.name for job in eval_plan(_run(recipe), recipe.eval, recipe.tasks)]
    assert not any(f"seed {recipe.eval.tune.train_seed}" in name for name in evaluated)


def test_further_evaluations_are_jobs_of_their_own() -> None:
    entries = "{flow_steps = 1}, {flow_steps = 2, methods = ['prefix']}"
    recipe = load_recipe("quickstart", [f"eval.also=[{entries}]", "eval.tune=none"])
    jobs = run_plan(_run(recipe))
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    (task,), (seed,) = recipe.tasks, recipe.train.seeds
    of_prefix = f"evaluate prefix · {task} · seed {seed}"
    further = [job for job in jobs if "also" in job.name]
    usual = [name for name in names if name.startswith("evaluate ") and "also" not in name]
    assert [job.name for job in further] == [
        *(f"{name} · also 1" for name in usual),
        f"{of_prefix} · also 2",
    ]
    # The trained policy, and the same method's earlier evaluations, which may share cells.
    trained = jobs[names.index(of_prefix)].needs
    assert further[-1].needs == (*trained, of_prefix, f"{of_prefix} · also 1")


def test_tuned_guidance_needs_something_that_tunes_it() -> None:
    for change in ("eval.methods=naive,pinv-tuned", "eval.also=[{methods=['pinv-tuned']}]"):
        with pytest.raises(UsageError, match="nothing tunes it"):
            check_recipe(load_recipe("quickstart", [change, "eval.tune=none"]))
