"""The figures of the loss decomposition, and the main figure.

Bars of the stacked figure run from 0 to 100% of the episodes: success of naive, avoidable,
irreducible and open-loop cost, and what is not solved without any delay. A negative part is a
hatched strip over the parts that it overlaps, so that bars stay within 100%.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rtc_cli.report.figures import success_panel
from rtc_cli.report.losses.grids import by_class
from rtc_cli.report.selection import method_order
from rtc_cli.report.style import FILLS, INK, MUTED, PAPER, looks, new_figure, tidy
from rtc_cli.report.tables import ALL, Row, pick

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

PART_NAMES = {
    "success": "solved by naive",
    "avoidable": "avoidable",
    "irreducible": "irreducible",
    "open_loop_cost": "open-loop",
    "rest": "not solved at d = 0, s = 1",
}
FEWEST = 4
"""Room is left for this many bars, so that few bars do not grow fat."""
MAIN_METHODS = ("naive", "pinv", "pinv-tuned", "prefix", "oracle")


@dataclass(frozen=True)
class Segment:
    """A part of one bar in percent: `start` to `stop`, its signed `value`, and if it overlaps."""

    part: str
    start: float
    stop: float
    value: float
    negative: bool = False


def segments(row: Row) -> list[Segment]:
    """Return the parts of one task's bar, from 0 to 100.

    Parts follow each other upwards through the levels naive, oracle, S(0, s), S(0, 1). What is
    visible of a part begins where all earlier parts end; a negative part is a strip of its own.
    """
    found = [Segment("success", 0.0, 100 * row["success_naive"], 100 * row["success_naive"])]
    level = reached = found[0].stop
    for part in ("avoidable", "irreducible", "open_loop_cost"):
        if row[part] is None:
            continue
        value = 100 * row[part]
        below, level = level, level + value
        if value < 0:
            found.append(Segment(part, level, below, value, negative=True))
        else:
            found.append(Segment(part, min(reached, level), level, value))
        reached = max(reached, level)
    return [*found, Segment("rest", reached, 100.0, 100 - reached)]


def losses_figure(rows: Sequence[Row], classes: Mapping[str, str], delay: int) -> "Figure":
    """Draw the stacked losses of every task at one delay of one protocol."""
    tasks = {row["task"] for row in rows}
    figure = new_figure(7.4, 1.5 + 0.36 * max(len(tasks), FEWEST))
    axes = figure.subplots()
    losses_panel(axes, rows, classes, delay)
    _part_legend(figure)
    return figure


def losses_panel(
    axes: "Axes", rows: Sequence[Row], classes: Mapping[str, str], delay: int, title: str = ""
) -> None:
    """Draw one bar per task, grouped by class, and one for the mean."""
    mine = {row["task"]: row for row in pick(rows, delay=delay)}
    tasks = by_class([task for task in mine if task != ALL], classes)
    names = [*tasks, ALL] if ALL in mine and len(tasks) > 1 else tasks
    places, ticks = _places(names, classes)
    for task, place in zip(names, places, strict=True):
        for segment in segments(mine[task]):
            _bar(axes, place, segment)
    tidy(axes, title=title, x="episodes (%)", grid="x")
    axes.set_yticks(places, ticks)
    axes.tick_params(axis="y", labelsize=9, labelcolor=INK)
    axes.set_xlim(0, 100)
    axes.set_ylim(max(*places, FEWEST - 1) + 0.6, -0.6)
    _class_labels(axes, names, places, classes)


def _places(names: Sequence[str], classes: Mapping[str, str]) -> tuple[list[float], list[str]]:
    """Return the height of each bar, with a gap between classes, and its label."""
    places: list[float] = []
    for place, task in enumerate(names):
        gap = place > 0 and classes.get(task) != classes.get(names[place - 1])
        places.append((places[-1] + 1 + 0.45 * gap) if places else 0.0)
    labels = ["mean" if t == ALL else t for t in names]
    return places, labels


def _bar(axes: "Axes", place: float, segment: Segment) -> None:
    width = segment.stop - segment.start
    fill = FILLS[segment.part]
    if segment.negative:
        axes.barh(
            place, width, left=segment.start, height=0.34, facecolor=PAPER, edgecolor=fill.colour,
            hatch="//////", linewidth=0.8,
        )  # fmt: skip
    elif width > 0:
        axes.barh(place, width, left=segment.start, height=0.74, color=fill.colour, linewidth=0)
    if segment.part != "rest" and width >= 4.5:
        axes.text(
            segment.start + width / 2, place, f"{segment.value:.0f}", ha="center", va="center",
            fontsize=8, color=INK if segment.negative else fill.text,
            bbox={"facecolor": PAPER, "edgecolor": "none", "pad": 0.4}
            if segment.negative
            else None,
        )  # fmt: skip


def _class_labels(
    axes: "Axes", names: Sequence[str], places: Sequence[float], classes: Mapping[str, str]
) -> None:
    """Write each class beside its group of bars, at the right."""
    groups: dict[str, list[float]] = {}
    for task, place in zip(names, places, strict=True):
        if task in classes:
            groups.setdefault(classes[task], []).append(place)
    for name, members in groups.items():
        middle = (members[0] + members[-1]) / 2
        axes.plot(
            [101.2] * 2, [members[0] - 0.37, members[-1] + 0.37], color=MUTED, linewidth=1.2,
            clip_on=False,
        )  # fmt: skip
        axes.text(102.4, middle, name.replace("-", "-\n"), fontsize=8.5, color=INK, va="center")


def _part_legend(figure: "Figure | SubFigure") -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=FILLS[part].colour, label=name) for part, name in PART_NAMES.items()]
    handles.append(Patch(facecolor=PAPER, edgecolor=MUTED, hatch="//////", label="negative part"))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8.5,
        labelcolor=INK, handlelength=1.2, columnspacing=1.4,
    )  # fmt: skip


# -- seam against reaction -------------------------------------------------------------------


def seam_rows(summary: Sequence[Row], protocol: str) -> list[Row]:
    """Return the rows of the mean that have both a seam jump and a measured reaction."""
    rows = pick(summary, protocol=protocol, task=ALL, train_seed=ALL)
    return [
        row
        for row in rows
        if row.get("seam_jump") is not None
        and row.get("measured_reaction_ticks") is not None
        and "+" not in row["method"]
    ]


def seam_figure(summary: Sequence[Row], protocol: str) -> "Figure":
    """Draw seam jump against measured reaction: one point per method and delay."""
    figure = new_figure(7.4, 4.4)
    axes = figure.subplots()
    seam_panel(axes, seam_rows(summary, protocol))
    return figure


def seam_panel(axes: "Axes", rows: Sequence[Row], title: str = "") -> None:
    """Draw the points of each method, joined by delay; the number at a point is its delay."""
    names = method_order(list(dict.fromkeys(row["method"] for row in rows)))
    for name, look in looks(names).items():
        curve = sorted(pick(rows, method=name), key=lambda row: row["delay"])
        x = [row["measured_reaction_ticks"] for row in curve]
        y = [row["seam_jump"] for row in curve]
        axes.plot(
            x, y, color=look.colour, linestyle=look.line, linewidth=1.0, marker=look.marker or ".",
            markersize=6, label=name,
        )  # fmt: skip
        for row, here, there in zip(curve, x, y, strict=True):
            axes.annotate(
                str(row["delay"]), (here, there), xytext=(4, 3), textcoords="offset points",
                fontsize=7.5, color=look.colour,
            )  # fmt: skip
    tidy(axes, title=title, x="measured reaction (control steps)", y="seam jump (1 = no seam)")
    axes.margins(0.08)
    axes.legend(frameon=False, fontsize=8.5, labelcolor=INK, handlelength=1.8)


# -- main figure -----------------------------------------------------------------------------


def main_seam_rows(summary: Sequence[Row], protocol: str) -> list[Row]:
    """Return the rows of `seam_rows` that the main figure shows."""
    return [row for row in seam_rows(summary, protocol) if row["method"] in MAIN_METHODS]


def main_figure(
    summary: Sequence[Row],
    decomposition: Sequence[Row],
    classes: Mapping[str, str],
    protocol: str,
) -> "Figure":
    """Draw the main panels: success against delay, stacked losses, seam against reaction.

    The third one is left out where no reaction was measured.
    """
    points = main_seam_rows(summary, protocol)
    costs = pick(decomposition, protocol=protocol)
    mean = pick(summary, protocol=protocol, task=ALL, train_seed=ALL)
    mean = [row for row in mean if row["method"] in MAIN_METHODS]
    s = protocol.partition(":")[2]
    figure = new_figure(11.6, 7.2 if points else 4.6)
    grid = figure.add_gridspec(1, 2, width_ratios=[1.0, 1.12])
    left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    heights = [1.15, 1.0] if points else [1.0]
    upper, *lower = left.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    tasks = {row["task"] for row in costs} - {ALL}
    what = f"mean of {len(tasks)} tasks" if len(tasks) > 1 else next(iter(tasks), "")
    success_panel(upper, mean, title=f"(a) Success, {what}, s = {s}")
    delay = max((row["delay"] for row in costs), default=0)
    bars = right.subplots()
    losses_panel(bars, costs, classes, delay, title=f"(b) Where success is lost, d = {delay}")
    _part_legend(right)
    for axes in lower:
        seam_panel(axes, points, title="(c) Seam and reaction; numbers are delays")
    return figure
