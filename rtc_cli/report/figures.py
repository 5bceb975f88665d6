"""The figures of a report. Every function takes rows of `tables` and returns a matplotlib Figure.

Shaded bands and bars are the 95% intervals of the rows they are drawn from.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.report.selection import fits_protocol, method_order
from rtc_cli.report.style import (
    INK,
    MUTED,
    OLD_CHUNK,
    PAPER,
    Look,
    looks,
    new_figure,
    spread,
    tidy,
)
from rtc_cli.report.tables import ALL, Row, pick

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DELAY_AXIS = "delay (control steps)"
SUCCESS_AXIS = "episodes solved (%)"


# -- success against delay -------------------------------------------------------------------


def success_figure(
    summary: Sequence[Row], protocol: str, *, series: str = "method", flow_steps: int | None = None
) -> "Figure":
    """Draw success against delay: the mean over tasks large, one small panel per task.

    `series` is the key that names a line: `method`, or `variant` for an ablation.
    """
    rows = pick(summary, protocol=protocol, train_seed=ALL)
    if flow_steps is not None:
        rows = pick(rows, flow_steps=flow_steps)
    tasks = sorted({row["task"] for row in rows} - {ALL})
    names = _series_order(rows, series)
    small = tasks if len(tasks) > 1 else []
    columns = min(3, max(len(small), 1))
    lines = -(-len(small) // columns) if small else 0
    figure = new_figure(7.4, 3.7 + 2.1 * lines)
    grid = figure.add_gridspec(
        1 + lines, columns, height_ratios=[3.6, *([2.0] * lines)] if lines else [1]
    )
    main = figure.add_subplot(grid[0, :])
    only = tasks[0] if tasks else "-"
    title = f"Mean of {len(tasks)} tasks" if small else f"Task: {only}"
    style = looks(names)
    _success_panel(main, pick(rows, task=ALL), names, style, series)
    tidy(main, title=title, x=DELAY_AXIS, y=SUCCESS_AXIS)
    _label_lines(main, pick(rows, task=ALL), names, style, series)
    for place, task in enumerate(small):
        axes = figure.add_subplot(grid[1 + place // columns, place % columns])
        _success_panel(axes, pick(rows, task=task), names, style, series)
        tidy(axes, title=task)
    return figure


def success_panel(axes: "Axes", rows: Sequence[Row], title: str = "") -> None:
    """Draw success against delay in one panel, one line per method, named at its right end."""
    names = _series_order(rows, "method")
    style = looks(names)
    _success_panel(axes, rows, names, style, "method")
    tidy(axes, title=title, x=DELAY_AXIS, y=SUCCESS_AXIS)
    _label_lines(axes, rows, names, style, "method")


def _series_order(rows: Sequence[Row], series: str) -> list[str]:
    names = list(dict.fromkeys(str(row[series]) for row in rows))
    return method_order(names) if series == "method" else names


def _success_panel(
    axes: "Axes", rows: Sequence[Row], names: Sequence[str], style: Mapping[str, Look], series: str
) -> None:
    for name in names:
        curve = sorted(pick(rows, **{series: name}), key=lambda row: row["delay"])
        if not curve:
            continue
        look = style[name]
        delays = [row["delay"] for row in curve]
        low = [100 * row["success_low"] for row in curve]
        high = [100 * row["success_high"] for row in curve]
        axes.fill_between(delays, low, high, color=look.colour, alpha=0.16, linewidth=0)
        axes.plot(
            delays,
            [100 * row["success"] for row in curve],
            color=look.colour,
            linestyle=look.line,
            marker=look.marker,
            markersize=5,
            linewidth=1.9,
        )
    axes.set_ylim(0, 103)
    _integer_ticks(axes, [row["delay"] for row in rows])


def _integer_ticks(axes: "Axes", values: Sequence[int]) -> None:
    if values:
        axes.set_xticks(range(min(values), max(values) + 1))


def _label_lines(
    axes: "Axes", rows: Sequence[Row], names: Sequence[str], style: Mapping[str, Look], series: str
) -> None:
    """Write each line's name and last value beside its right end instead of a legend."""
    ends = []
    for name in names:
        curve = sorted(pick(rows, **{series: name}), key=lambda row: row["delay"])
        if curve:
            ends.append((name, curve[-1]["delay"], 100 * curve[-1]["success"]))
    if not ends:
        return
    first = min(row["delay"] for row in rows)
    last = max(row["delay"] for row in rows)
    span = max(last - first, 1)
    places = spread([end[2] for end in ends], gap=7.5)
    for (name, delay, value), place in zip(ends, places, strict=True):
        axes.annotate(
            f"{name} {value:.0f}%",
            xy=(delay, value),
            xytext=(last + 0.05 * span, place),
            color=style[name].colour,
            fontsize=9.5,
            fontweight="bold",
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": style[name].colour, "lw": 0.6, "shrinkA": 0},
        )
    longest = max(len(end[0]) for end in ends) + 4
    axes.set_xlim(first - 0.06 * span, last + span * (0.06 + 0.021 * longest))


# -- paired differences ----------------------------------------------------------------------


def differences_figure(rows: Sequence[Row], protocol: str) -> "Figure":
    """Draw paired differences by delay, one panel per pair, with intervals and a zero line."""
    mine = [row for row in pick(rows, task=ALL) if fits_protocol(row, protocol)]
    pairs = list(dict.fromkeys((row["method"], row["baseline"]) for row in mine))
    columns = min(2, max(len(pairs), 1))
    lines = -(-len(pairs) // columns) or 1
    figure = new_figure(7.4, 0.4 + 2.5 * lines)
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False).flatten()
    style = looks(list(dict.fromkeys(pair[0] for pair in pairs)))
    for axes, (method, baseline) in zip(panels, pairs, strict=False):
        points = sorted(pick(mine, method=method, baseline=baseline), key=lambda row: row["delay"])
        _difference_panel(axes, points, style[method])
        tidy(axes, title=f"{method} minus {baseline}")
    for axes in panels[len(pairs) :]:
        axes.set_visible(False)
    figure.supxlabel(DELAY_AXIS, color=MUTED, fontsize=9.5)
    figure.supylabel("difference (percentage points)", color=MUTED, fontsize=9.5)
    return figure


def _difference_panel(axes: "Axes", points: Sequence[Row], look: Look) -> None:
    axes.axhline(0, color=INK, linewidth=1.1)
    for row in points:
        delay, value = row["delay"], 100 * row["difference"]
        clear = False
        if row["low"] is not None and row["high"] is not None:
            clear = row["low"] > 0 or row["high"] < 0
            axes.vlines(delay, 100 * row["low"], 100 * row["high"], look.colour, linewidth=2)
        axes.plot(
            delay,
            value,
            marker=look.marker,
            markersize=7,
            markeredgewidth=1.6,
            color=look.colour,
            markerfacecolor=look.colour if clear else PAPER,
        )
        axes.annotate(
            f"{value:+.1f}",
            (delay, value),
            xytext=(7, 0),
            textcoords="offset points",
            fontsize=8.5,
            color=INK,
            va="center",
            bbox={"facecolor": PAPER, "edgecolor": "none", "pad": 0.6},
        )
    delays = [row["delay"] for row in points]
    _integer_ticks(axes, delays)
    axes.set_xlim(min(delays) - 0.4, max(delays) + 0.7)
    axes.margins(y=0.12)


# -- one cycle -------------------------------------------------------------------------------


def timeline_figure(horizon: int = 8, exec_horizon: int = 4, delay: int = 2) -> "Figure":
    """Draw one cycle of asynchronous execution: which chunk's action acts at each control step."""
    from rtc_cli.execution.timeline import timeline

    start = exec_horizon  # the second inference: both neighbours are ordinary chunks
    stop = start + exec_horizon + delay + max(1, exec_horizon - delay)
    plan = timeline(
        horizon=horizon, exec_horizon=exec_horizon, delay=delay, ticks=start + 4 * horizon
    )
    old, new, following = 1, 2, 3
    style = dict(
        zip((old, new, following), (OLD_CHUNK, *looks(["pinv", "prefix"]).values()), strict=True)
    )
    figure = new_figure(7.4, 3.9)
    axes = figure.subplots()
    names = {old: "old chunk", new: "new chunk", following: "next chunk"}
    for line, chunk in enumerate((old, new, following)):
        _chunk_line(axes, plan, chunk, 3.2 - line, (start, stop), style[chunk])
        _lane_label(axes, 3.2 - line, start, names[chunk])
    for tick in range(start, stop):
        chunk, index = int(plan.chunk[tick]), int(plan.index[tick])
        _box(axes, tick, -0.25, str(index), style[chunk], "solid")
    _lane_label(axes, -0.25, start, "robot executes")
    for chunk in (new, following):
        window = plan.inferences[chunk - 1]
        _thinking(axes, window.start, min(window.ready, stop), 3.2 - chunk + 1, style[chunk])
    _seams(axes, plan, start, stop)
    _timeline_axis(axes, start, stop, exec_horizon, delay)
    return figure


def _chunk_line(
    axes: "Axes", plan: Any, chunk: int, y: float, window: tuple[int, int], look: Look
) -> None:
    """Draw the actions of one chunk at the ticks they are due."""
    born = plan.inferences[chunk - 1]
    acting = {int(t) for t in range(*window) if int(plan.chunk[t]) == chunk}
    for tick in range(max(born.start, window[0]), min(born.start + plan.horizon, window[1])):
        kind = "solid" if tick in acting else "empty"
        if kind == "empty" and tick < born.ready:
            kind = "past"
        _box(axes, tick, y, str(tick - born.start), look, kind)


def _box(axes: "Axes", tick: int, y: float, text: str, look: Look, kind: str) -> None:
    from matplotlib.patches import Rectangle

    solid = kind == "solid"
    axes.add_patch(
        Rectangle(
            (tick + 0.04, y - 0.27),
            0.92,
            0.54,
            facecolor=look.colour if solid else PAPER,
            edgecolor=look.colour,
            linewidth=1.2,
            linestyle="-" if solid or kind == "past" else (0, (2, 2)),
            hatch="////" if kind == "past" else None,
            alpha=1.0 if solid else 0.75,
        )
    )
    halo = {"facecolor": PAPER, "edgecolor": "none", "pad": 1.2} if kind == "past" else None
    axes.text(
        tick + 0.5,
        y,
        text,
        ha="center",
        va="center",
        fontsize=9.5,
        color=PAPER if solid else MUTED,
        fontweight="bold" if solid else "normal",
        bbox=halo,
    )


def _lane_label(axes: "Axes", y: float, start: int, text: str) -> None:
    axes.text(start - 0.2, y, text, ha="right", va="center", fontsize=9.5, color=INK)


def _thinking(axes: "Axes", start: int, ready: int, y: float, look: Look) -> None:
    axes.annotate(
        "",
        xy=(ready, y + 0.44),
        xytext=(start, y + 0.44),
        arrowprops={"arrowstyle": "-|>", "color": look.colour, "lw": 1.8, "shrinkA": 0},
    )
    axes.text(
        ready + 0.12,
        y + 0.44,
        f"computed for {ready - start} steps, then usable",
        fontsize=8.5,
        color=look.colour,
        va="center",
    )


def _seams(axes: "Axes", plan: Any, start: int, stop: int) -> None:
    for tick in (int(t) for t in plan.handovers if start < t < stop):
        axes.plot([tick, tick], [-0.62, 0.12], color=INK, linewidth=2.2)
        axes.text(tick, -0.68, "hand-over", ha="center", va="top", fontsize=8.5, color=INK)


def _timeline_axis(axes: "Axes", start: int, stop: int, exec_horizon: int, delay: int) -> None:
    marks = {0: "t", delay: "t+d", exec_horizon: "t+s", exec_horizon + delay: "t+s+d"}
    axes.set_xticks(
        [start + offset for offset in marks],
        list(marks.values()),
    )
    axes.set_xlim(start - 2.9, stop + 0.3)
    axes.set_ylim(-1.0, 4.0)
    tidy(axes, grid="x", x=f"control steps   (here s = {exec_horizon}, d = {delay})")
    axes.set_yticks([])
    axes.spines["bottom"].set_visible(False)


# -- profile ---------------------------------------------------------------------------------


def profile_figure(rows: Sequence[Row]) -> "Figure":
    """Draw the time of one chunk per sampler: p50 as a bar, p95 as a tick, ratio to plain."""
    groups = profile_groups(rows)
    counts = [len(group) for group in groups.values()]
    figure = new_figure(7.4, 0.7 + sum(0.42 * count + 0.6 for count in counts))
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=counts).flatten()
    for axes, (title, group) in zip(panels, groups.items(), strict=True):
        _profile_panel(axes, group)
        tidy(axes, title=title, grid="x")
        axes.tick_params(axis="y", labelsize=9.5, labelcolor=INK)
    panels[-1].set_xlabel("time of one chunk (ms): bar = median, tick = 95th percentile")
    return figure


def profile_groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group profile rows that may be compared with each other."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        title = (
            f"{row['network']}, batch {row['batch']}, horizon {row['horizon']}, "
            f"{row['flow_steps']} flow steps"
        )
        groups.setdefault(title, []).append(row)
    return groups


def _profile_panel(axes: "Axes", rows: Sequence[Row]) -> None:
    names = [str(row["sampler"]) for row in rows]
    style = looks([{"plain": "naive"}.get(name, name) for name in names])
    widest = max(row["p95_ms"] for row in rows)
    for place, (row, look) in enumerate(zip(rows, style.values(), strict=True)):
        axes.barh(place, row["p50_ms"], height=0.62, color=look.colour)
        axes.plot([row["p50_ms"], row["p95_ms"]], [place, place], color=INK, linewidth=1.1)
        axes.plot([row["p95_ms"]] * 2, [place - 0.2, place + 0.2], color=INK, linewidth=1.6)
        axes.text(
            max(row["p95_ms"], row["p50_ms"]) + 0.015 * widest,
            place,
            f"{row['p50_ms']:.3g} ms, {row['ratio_to_plain']:.2f} x plain",
            va="center",
            fontsize=9,
            color=INK,
        )
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.42 * widest)


# -- training --------------------------------------------------------------------------------


def training_figure(curves: Sequence[Row]) -> "Figure":
    """Draw the training loss by epoch, one panel per task, one thin line per training seed."""
    tasks = sorted({curve["task"] for curve in curves})
    columns = min(3, len(tasks))
    lines = -(-len(tasks) // columns)
    figure = new_figure(7.4, 0.3 + 2.5 * lines)
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False).flatten()
    names = list(dict.fromkeys(str(curve["checkpoint"]) for curve in curves))
    style = looks([{"base": "naive"}.get(name, name) for name in names])
    colours = dict(zip(names, style.values(), strict=True))
    for axes, task in zip(panels, tasks, strict=False):
        for curve in pick(curves, task=task):
            look = colours[str(curve["checkpoint"])]
            axes.plot(curve["epochs"], curve["loss"], color=look.colour, linewidth=1.3, alpha=0.85)
        axes.set_yscale("log")
        tidy(axes, title=task, x="epoch")
    _cut_first_epoch(panels[0], curves)
    for axes in panels[len(tasks) :]:
        axes.set_visible(False)
    panels[0].set_ylabel("training loss")
    _plain_log_ticks(panels[0])
    figure.legend(
        handles=[_handle(colours[name], f"{name} policy") for name in names],
        loc="outside upper right",
        ncols=len(names),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
    )
    return figure


def _cut_first_epoch(axes: "Axes", curves: Sequence[Row]) -> None:
    """Let the scale begin at the second epoch: the first loss would flatten all that follows."""
    late = [loss for curve in curves for loss in curve["loss"][1:]]
    if len(late) > 1 and max(late) > min(late) > 0:
        margin = (max(late) / min(late)) ** 0.1
        axes.set_ylim(min(late) / margin, max(late) * margin)


def _plain_log_ticks(axes: "Axes") -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _handle(look: Look, label: str) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], color=look.colour, linewidth=2, label=label)
