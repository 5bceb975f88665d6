"""Stacked bars: what is around the network, then the flow steps, one by one, against the ticks."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rtc_cli.fixed_costs import typical_ms
from rtc_cli.report.profile.published import PUBLISHED
from rtc_cli.report.style import INK, LOOKS, MUTED, RULE, looks, new_figure, tidy
from rtc_cli.report.tables import Row
from rtc_cli.units import three_digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GREYS = ("#b9c1c9", "#d3d9de", "#9aa4ad", "#e3e7ea")
_MAX_TICKS = 12
_NAMED_FROM = 0.09  # of the longest bar: narrower parts have no room for their name


def chunk_figure(groups: dict[str, list[Row]], *, published: bool) -> "Figure":
    """Draw one panel per group of comparable rows; `published` adds one of published chunks."""
    first = next(iter(groups.values()))[0]
    counts = [len(rows) for rows in groups.values()] + ([len(PUBLISHED)] if published else [])
    figure = new_figure(7.4, 0.9 + sum(0.42 * count + 0.75 for count in counts))
    panels = figure.subplots(len(counts), 1, squeeze=False, height_ratios=counts).flatten()
    for axes, (title, rows) in zip(panels, groups.items(), strict=False):
        _measured(axes, rows)
        tidy(axes, title=title, grid="")
    if published:
        _published(panels[-1])
        tidy(panels[-1], title="published, for comparison (5 flow steps, other devices)", grid="")
    for axes in panels:
        _ticks(axes, first["hz"])
        axes.tick_params(axis="y", labelsize=9.5, labelcolor=INK)
    panels[-1].set_xlabel(
        "ms: grey = fixed costs, colour = flow steps (medians), line = to the 95th percentile.\n"
        f"Numbers on top: control steps of {1000 / first['hz']:.3g} ms ({first['hz']:g} Hz)",
        color=MUTED,
        fontsize=9.5,
    )
    return figure


def _measured(axes: "Axes", rows: Sequence[Row]) -> None:
    names = [str(row["sampler"]) for row in rows]
    style = looks([{"plain": "naive"}.get(name, name) for name in names])
    widest = max(row["total_p95_ms"] for row in rows)
    for place, (row, look) in enumerate(zip(rows, style.values(), strict=True)):
        fixed = {name: typical_ms(cost) for name, cost in row["fixed_ms"].items()}
        left = _stack(axes, place, fixed, widest)
        step = row["p50_ms"] / row["flow_steps"]
        for index in range(row["flow_steps"]):
            _bar(axes, place, left + index * step, step, look.colour)
        axes.plot([row["total_p50_ms"], row["total_p95_ms"]], [place] * 2, color=INK, linewidth=1.4)
        words = f"{three_digits(row['total_p95_ms'])} ms, d = {row['delay_at_hz']}"
        _say(axes, place, row["total_p95_ms"], words)
    _names(axes, names, widest)


def _published(axes: "Axes") -> None:
    widest = max(chunk.total_ms for chunk in PUBLISHED)
    for place, chunk in enumerate(PUBLISHED):
        fixed = {name: ms for name, ms in chunk.parts.items() if name != "flow steps"}
        left = _stack(axes, place, fixed, widest)
        if "flow steps" in chunk.parts:
            colour = (LOOKS[1] if chunk.sampler == "plain" else LOOKS[0]).colour
            _bar(axes, place, left, chunk.parts["flow steps"], colour)
        _say(axes, place, chunk.total_ms, f"{chunk.total_ms:g} ms")
    _names(axes, [chunk.label for chunk in PUBLISHED], widest)


def _stack(axes: "Axes", place: int, parts: dict[str, float], widest: float) -> float:
    """Draw the fixed costs one after another; return where they end (ms)."""
    left = 0.0
    for index, (name, ms) in enumerate(parts.items()):
        _bar(axes, place, left, ms, _GREYS[index % len(_GREYS)])
        if ms >= _NAMED_FROM * widest:
            axes.text(left + ms / 2, place, name, ha="center", va="center", fontsize=8, color=INK)
        left += ms
    return left


def _bar(axes: "Axes", place: int, left: float, width: float, colour: str) -> None:
    axes.barh(place, width, left=left, height=0.62, color=colour, edgecolor="white", linewidth=0.7)


def _say(axes: "Axes", place: int, right: float, words: str) -> None:
    axes.annotate(
        words,
        (right, place),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=9,
        color=INK,
    )


def _names(axes: "Axes", names: Sequence[str], widest: float) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.3 * widest)


def _ticks(axes: "Axes", hz: float) -> None:
    """Mark the control steps, thinned out where there are many."""
    right = axes.get_xlim()[1]
    count = int(right * hz / 1000)
    every = max(1, -(-count // _MAX_TICKS))
    marks = list(range(0, count + 1, every))
    for mark in marks[1:]:
        axes.axvline(1000 * mark / hz, color=RULE, linewidth=0.8, zorder=0)
    top = axes.secondary_xaxis("top")
    top.set_xticks([1000 * mark / hz for mark in marks], [str(mark) for mark in marks])
    top.tick_params(length=0, labelsize=8, colors=MUTED, pad=0)
    top.spines["top"].set_visible(False)
