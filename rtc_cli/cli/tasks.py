"""`rtc tasks`: list, describe and render the tasks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtc_cli.cli.options import JsonOption, RunOption
from rtc_cli.cli.output import output, progress
from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.levels import expand

if TYPE_CHECKING:
    from rich.table import Table

    from rtc_cli.tasks.scene import Scene
    from rtc_cli.tasks.trace import Trace

app = typer.Typer()

CONTROLLER = "controller"
MOST_ACTORS = 4


def _task_names(incomplete: str) -> list[str]:
    from rtc_cli.tasks import list_tasks

    return [name for name in list_tasks() if name.startswith(incomplete)]


@app.command(
    epilog="Examples:  rtc tasks   |   rtc tasks catcher   |   rtc tasks catcher --render   |   "
    "rtc tasks catcher --render --by naive,prefix --delay 4"
)
def tasks(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="Task to describe, or kinetix:PATH: a Kinetix level file, or a folder of them.",
            autocompletion=_task_names,
        ),
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Write NAME.gif and NAME.png (a film strip).")
    ] = False,
    by: Annotated[
        str | None,
        typer.Option(
            "--by",
            metavar="WHO",
            help="Who acts: controller (written by hand, for some tasks), random, or a method such "
            "as naive, with a run's checkpoints; several, as in naive,prefix, are shown side by "
            "side in the same episode.  [default: controller (random where there is none), or "
            "naive with --run]",
        ),
    ] = None,
    run: RunOption = None,
    train_seed: Annotated[
        int | None,
        typer.Option("--train-seed", help="Whose checkpoints.  [default: the run's first]"),
    ] = None,
    delay: Annotated[
        int, typer.Option("--delay", min=0, metavar="D", help="Delay in control steps.")
    ] = 0,
    exec_horizon: Annotated[
        int | None,
        typer.Option(
            "--exec-horizon",
            min=1,
            metavar="S",
            help="Control steps between starts of inference.  [default: max(delay, 1)]",
        ),
    ] = None,
    episode: Annotated[int, typer.Option("--episode", min=0, help="Number of the episode.")] = 0,
    frames: Annotated[int, typer.Option("--frames", min=2, help="Pictures in the strip.")] = 8,
    out_dir: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the pictures.")
    ] = Path(),
    as_json: JsonOption = False,
) -> None:
    """List, describe and render the tasks."""
    from rtc_cli.tasks import get_task, list_tasks
    from rtc_cli.tasks.library import has_controller

    with output(as_json) as out:
        names = list_tasks() if name is None else expand([name])
        if name is None or len(names) > 1:
            if render:
                raise UsageError("--render needs one task.", "name one: rtc tasks catcher --render")
            scenes = [get_task(each) for each in names]
            rows = [_summary(scene) for scene in scenes]
            hint = "More about one: rtc tasks NAME. Pictures: rtc tasks NAME --render."
            out.result({"schema": 1, "rows": rows}, _list_table(rows), hint)
            return
        scene = get_task(names[0])
        if not render:
            out.result({"schema": 1, **_description(scene)}, *_description_parts(scene))
            return
        scripted = CONTROLLER if has_controller(scene.name) else "random"
        actors = _actors(by or (scripted if run is None else "naive"))
        s = exec_horizon if exec_horizon is not None else max(delay, 1)
        record = partial(_trace, scene, run, train_seed, delay, s, episode)
        traces, files = _render(scene, actors, record, out_dir, frames)
        rows, words = [], []
        for who, trace in zip(actors, traces, strict=True):
            end = {"length": trace.ticks, "status": trace.status.name.lower()}
            rows.append({"task": scene.name, "by": who, "episode": episode, **end, "files": files})
            words.append(
                f"{scene.name}, {trace.caption}: {end['status']} after {trace.ticks} control steps"
            )
        out.result({"schema": 1, "rows": rows}, *words, *(f"wrote {file}" for file in files))


def _summary(scene: Scene) -> dict[str, Any]:
    return {
        "task": scene.name,
        "goal": scene.goal,
        "observations": scene.obs_dim,
        "actions": scene.action_dim,
        "max_ticks": scene.max_ticks,
        "control_hz": scene.control_hz,
        "action_noise": scene.action_noise,
        "digest": scene.digest,
    }


def _description(scene: Scene) -> dict[str, Any]:
    observed = [
        {"name": c.name, "unit": c.unit, "low": c.low, "high": c.high} for c in scene.components
    ]
    actions = [
        {"name": a.name, "unit": a.unit, "low": a.low, "high": a.high} for a in scene.actions
    ]
    return {
        **_summary(scene),
        "description": scene.description.strip(),
        "observation_components": observed,
        "action_components": actions,
    }


def _list_table(rows: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("task", "goal", "observations", "actions"):
        table.add_column(heading, justify="left" if heading in ("task", "goal") else "right")
    for row in rows:
        numbers = (str(row["observations"]), str(row["actions"]))
        table.add_row(row["task"], row["goal"], *numbers)
    return table


def _description_parts(scene: Scene) -> tuple[Any, ...]:
    from rich.table import Table
    from rich.text import Text

    description = _description(scene)
    tables = []
    for title, key in (
        ("observations (scaled)", "observation_components"),
        ("actions", "action_components"),
    ):
        table = Table(title=title, title_justify="left", box=None, header_style="bold")
        for heading in ("name", "unit", "low", "high"):
            table.add_column(heading, justify="left" if heading in ("name", "unit") else "right")
        for part in description[key]:
            low, high = f"{part['low']:g}", f"{part['high']:g}"
            table.add_row(part["name"], part["unit"], low, high)
        tables += ["", table]
    seconds = scene.max_ticks / scene.control_hz
    facts = (
        f"{scene.control_hz:g} control steps per second, at most {scene.max_ticks} ({seconds:.1f} "
        f"s); action noise {scene.action_noise:g}; digest {scene.digest[:12]}"
    )
    return (Text(scene.name, style="bold"), Text(_prose(scene)), *tables, "", facts)


def _prose(scene: Scene) -> str:
    """The description without its tables, one line per paragraph: the terminal wraps it."""
    paragraphs = scene.description.strip().split("\n\n")
    kept = [each.replace("\n", " ") for each in paragraphs if not each.startswith("|")]
    return "\n\n".join(kept)


def _actors(by: str) -> tuple[str, ...]:
    """The names in --by, each once; UsageError for one that nobody has."""
    from rtc_cli.execution.methods import list_methods

    names = tuple(dict.fromkeys(part.strip() for part in by.split(",")))
    known = (CONTROLLER, "random", *list_methods())
    for name in names:
        if name not in known:
            raise UsageError(f'--by "{name}" is unknown.' + did_you_mean(name, known))
    if len(names) > MOST_ACTORS:
        raise UsageError(f"--by names {len(names)}; at most {MOST_ACTORS} fit side by side.")
    return names


def _render(
    scene: Scene,
    actors: tuple[str, ...],
    record: Callable[[str], Trace],
    folder: Path,
    frames: int,
) -> tuple[list[Trace], list[str]]:
    """Record an episode of every actor and write the pictures: traces and names of the files."""
    from rtc_cli.errors import StateError
    from rtc_cli.tasks.render import save_film_strip, save_gif

    if not folder.is_dir():
        raise StateError(f"there is no folder {folder}", "create it, or name another with --out")
    traces = []
    gif, strip = folder / f"{scene.name}.gif", folder / f"{scene.name}.png"
    with progress() as bars:
        bar = bars.add_task("episodes", total=len(actors), note="")
        for who in actors:
            bars.update(bar, note=who)
            traces.append(record(who))
            bars.update(bar, advance=1)
        bars.update(bar, note="pictures")
        save_gif(scene, traces, gif)
        save_film_strip(scene, traces, strip, frames=frames)
    return traces, [str(gif), str(strip)]


def _trace(
    scene: Scene,
    run: Path | None,
    train_seed: int | None,
    delay: int,
    exec_horizon: int,
    episode: int,
    who: str,
) -> Trace:
    """One episode, with whoever acts."""
    from rtc_cli.execution.methods import list_methods

    if who in list_methods():
        from rtc_cli.pipeline.showing import record_method
        from rtc_cli.runs import newest_run, open_run

        opened = newest_run() if run is None else open_run(run)
        return record_method(opened, scene, who, train_seed, exec_horizon, delay, episode)
    if run is not None or delay or exec_horizon != 1:
        raise UsageError(
            f'--by {who} takes no --run, --delay and --exec-horizon: "{who}" computes no chunks.',
            "name a method, as in --by naive",
        )
    return _scripted(scene, who, episode)


def _scripted(scene: Scene, who: str, episode: int) -> Trace:
    import numpy as np

    from rtc_cli.tasks.library import get_controller
    from rtc_cli.tasks.trace import record_episode

    if who == CONTROLLER:
        controller = get_controller(scene.name)
        return record_episode(
            scene, episode, lambda obs, tick: controller(obs[None]), "a controller written by hand"
        )
    random = np.random.Generator(np.random.Philox(episode))
    low, high = scene.action_low, scene.action_high
    return record_episode(
        scene, episode, lambda obs, tick: random.uniform(low, high), "random actions"
    )
