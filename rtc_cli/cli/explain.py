"""`rtc profile --explain`: what guidance does in every denoising step of a trained policy."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.errors import StateError, UsageError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rtc_cli.core.policy import Policy
    from rtc_cli.runs import Run
    from rtc_cli.samplers import Sampler

HAND_OVERS = 256


def explain_run(
    folder: Path | None,
    samplers: list[str],
    task: str | None,
    exec_horizon: int | None,
    delay: int | None,
    flow_steps: int | None,
) -> dict[str, Any]:
    """Explain a run's policies on its own recorded observations; the JSON document's content."""
    from rtc_cli.analysis.explain import explain, findings, recorded_seams
    from rtc_cli.core.geometry import ChunkGeometry
    from rtc_cli.data.episodes import EpisodeStore
    from rtc_cli.runs import newest_run, open_run

    run = newest_run() if folder is None else open_run(folder)
    recipe = run.recipe
    name, seed = task or recipe.tasks[0], recipe.train.seeds[0]
    if name not in recipe.tasks:
        raise UsageError(f'run {run.folder} has no task "{name}"', f"use {', '.join(recipe.tasks)}")
    s = exec_horizon or max(1, recipe.horizon // 2)
    geometry = ChunkGeometry(
        recipe.horizon, s, min(s, recipe.horizon - s) if delay is None else delay
    )
    steps = flow_steps or recipe.eval.flow_steps
    base = _policy(run, name, seed, "base")
    store = EpisodeStore.open(run.data(name, seed), verify=False)
    seam = recorded_seams(
        base, store.observations, store.lengths, geometry, count=HAND_OVERS, flow_steps=steps
    )
    found: dict[str, Any] = {"steps": [], "seams": []}
    for sampler_name in dict.fromkeys(("plain", *samplers)):
        policy = _policy(run, name, seed, "prefix") if sampler_name == "prefix" else base
        part = explain(
            policy, seam, [(sampler_name, _sampler(run, sampler_name))], flow_steps=steps
        )
        found = {key: found[key] + part[key] for key in found}
    return {
        "schema": 1,
        "run": str(run.folder),
        "policy": f"{recipe.name}, {name}, training seed {seed}",
        "horizon": geometry.horizon,
        "exec_horizon": s,
        "delay": int(geometry.delay),
        "flow_steps": steps,
        "examples": HAND_OVERS,
        "findings": findings(found),
        **found,
    }


def render_explanation(content: dict[str, Any]) -> "list[RenderableType]":
    """Tables by sampler, the seams, and the findings."""
    from rich.text import Text

    from rtc_cli.report.profile.explain import SEAM_COLUMNS, STEP_COLUMNS, cell
    from rtc_cli.report.render import Grid, rich_table

    tables: list[RenderableType] = []
    for name in dict.fromkeys(row["sampler"] for row in content["steps"]):
        rows = [row for row in content["steps"] if row["sampler"] == name]
        lines = [[cell(row, key) for key in STEP_COLUMNS] for row in rows]
        tables.append(rich_table(Grid([*STEP_COLUMNS.values()], lines), title=name))
    seams = [
        [row["sampler"], *(cell(row, key) for key in SEAM_COLUMNS)] for row in content["seams"]
    ]
    tables.append(rich_table(Grid(["sampler", *SEAM_COLUMNS.values()], seams), title="seams"))
    return [*tables, *(Text(line) for line in content["findings"])]


def _policy(run: "Run", task: str, seed: int, kind: str) -> "Policy":
    from rtc_cli.training.checkpoints import load_policy

    folder = run.checkpoint(task, seed, kind)
    if not folder.is_dir():
        raise StateError(
            f"run {run.folder} has no {kind} policy of {task}", "run `rtc train` first"
        )
    return load_policy(folder)


def _sampler(run: "Run", name: str) -> "Sampler":
    """The sampler with the run's guidance settings, where it takes them."""
    from rtc_cli.samplers import get_sampler

    settings = run.recipe.eval.pinv.model_dump() if name.startswith("pinv") else {}
    return get_sampler(name, **settings)
