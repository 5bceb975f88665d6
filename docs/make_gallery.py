"""Writes docs/tasks.md and docs/tasks/*.png, one small film strip per built-in task.

    python docs/make_gallery.py            # everything
    python docs/make_gallery.py catcher    # the page, and the picture of one task

Run it from a checkout when a task was added or changed, or when results were committed. The episode
shown is the first that the task's stored solver (`tests/tasks/solvers/TASK.npz`) solves; without a
solver the task's hand-written controller acts. Classes come from the committed results of the
`standard` recipe. `tests/tasks/test_gallery.py` fails where the page is not what this script would
write.
"""

from __future__ import annotations

import csv
import pkgutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from rtc_cli.tasks import get_task, library
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.render import is_flat, save_film_strip
from rtc_cli.tasks.scene import FloatArray, Scene, Status
from rtc_cli.tasks.trace import Trace, record_episode

DOCS = Path(__file__).parent
PAGE = DOCS / "tasks.md"
PICTURES = DOCS / "tasks"
RESULTS = DOCS / "results" / "standard"
PROTOCOL = "fixed:4"
EPISODES = 64  # tried, until one is solved
COLORS = 128  # of a picture's palette

INTRO = """\
# Tasks

Blue is the goal object, green the target it has to touch, orange a hazard it must not touch. Flames
are thrusters and purple arrows motors, as strong as the action asks for. Each episode is one that
the task's solver solved; time runs from left to right. `rtc tasks NAME` prints a task's
observations and actions, `rtc tasks NAME --render` draws an episode of your own.

The class says why delay hurts, as measured by `rtc run standard` at s = 4: losses that a method can
avoid (control-limited), or losses to what happens in the world meanwhile (information-limited), or
no loss (insensitive).

This page is made by `python docs/make_gallery.py`.
"""

METHODS = """\
## Pictures of methods

`rtc tasks catcher --render --by naive,prefix --run DIR --delay 4` plays one episode under each
method and shows them together. Below a picture lies a strip:

```
 1  1  2  2  2  2  3  3  3  3    one cell per control step: the chunk that acts
            [==3=]      [==4=]   an inference, in the colour of the chunk it makes
                  ^ now          what lies ahead is paler
```

An inference begins at the observation it uses and ends where its chunk can be used: its length is
the delay, and the actions above it were decided before. Grey cells hold still (`sync`).
"""


def names() -> list[str]:
    """The built-in tasks, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(library.__path__))


def solver(scene: Scene) -> Callable[[FloatArray], np.ndarray]:
    """Whoever solves the task: the stored policy, or else the hand-written controller."""
    sys.path.insert(0, str(DOCS.parent / "tests" / "helpers"))
    from episodes import Solver

    try:
        return Solver(scene)
    except FileNotFoundError:
        return get_controller(scene.name)


def solved_episode(scene: Scene) -> Trace:
    """The first episode that the solver solves."""
    act = solver(scene)
    for seed in range(EPISODES):
        trace = record_episode(scene, seed, lambda obs, tick: act(obs[None]))
        if trace.status == Status.SOLVED:
            return trace
    raise SystemExit(f"{scene.name}: none of {EPISODES} episodes was solved")


def draw(scene: Scene) -> None:
    """Write the picture of a task: a few moments of a solved episode."""
    trace = solved_episode(scene)
    path = PICTURES / f"{scene.name}.png"
    frames, columns, width = (4, 2, 450) if is_flat(scene) else (3, 3, 300)
    save_film_strip(scene, [trace], path, frames, columns, width, heading=False)
    with Image.open(path) as picture:
        picture.quantize(COLORS, dither=Image.Dither.NONE).save(path, optimize=True)


def classes() -> dict[str, str]:
    """Task -> why delay hurts it, from the committed results; empty where there are none."""
    found = {}
    for path in RESULTS.rglob("classes.csv"):
        with path.open(encoding="utf-8") as rows:
            for row in csv.DictReader(rows):
                if row["protocol"] == PROTOCOL:
                    found[row["task"]] = row["class"]
    return found


def text() -> str:
    """The whole page."""
    kinds = classes()
    head = "| task | goal | observations | actions | class |\n| --- | --- | ---: | ---: | --- |"
    rows, sections = [], []
    for name in names():
        scene = get_task(name)
        kind = kinds.get(name, "not measured yet")
        sizes = f"{scene.obs_dim} | {scene.action_dim}"
        rows.append(f"| [{name}](#{name}) | {scene.goal} | {sizes} | {kind} |")
        sections.append(
            f"## {name}\n\n![Moments of a solved episode of {name}](tasks/{name}.png)\n\n"
            f"{scene.goal} {scene.obs_dim} observations, {scene.action_dim} "
            f"action{'s' if scene.action_dim > 1 else ''}; class: {kind}.\n"
        )
    return "\n".join([INTRO, "\n".join([head, *rows]), "", *sections, METHODS])


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    for task in sys.argv[1:] or names():
        draw(get_task(task))
    PAGE.write_text(text(), encoding="utf-8")
