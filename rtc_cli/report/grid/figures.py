"""The figure of a grid ablation: success and differences of every setting at one delay.

Columns of panels are the levels of one factor (the execution noise, where it varies), the axis is
another, lines are the rest. Method is colour, line factor is dashes and filling, in every panel.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.report.grid.rows import NOISE
from rtc_cli.report.grid.text import factor_name, setting_text, value_text
from rtc_cli.report.selection import method_order
from rtc_cli.report.style import INK, MUTED, PAPER, Look, looks, new_figure, tidy
from rtc_cli.report.tables import ALL, Row, pick

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Settings = list[dict[str, Any]]

SHOWN = (("prefix", "naive"), ("prefix", "pinv"))
_DASHES = ((0, (4, 2)), "-", (0, (1, 1.4)), "-.")


class _Plot:
    """What every panel shares: which factor is where, colours, dashes."""

    def __init__(self, factors: Mapping[str, Sequence[Any]], methods: Sequence[str]) -> None:
        keys = list(factors)
        self.column = NOISE if NOISE in factors and len(keys) > 1 else None
        rest = [key for key in keys if key != self.column]
        self.x = max(rest, key=lambda key: len(factors[key]))  # the first of the longest
        self.places = list(factors[self.x])
        self.columns = list(factors[self.column]) if self.column else [None]
        self.lines = _combinations({key: factors[key] for key in rest if key != self.x})
        self.methods = method_order(list(methods))
        self.looks = looks(self.methods)

    def curve(self, rows: Sequence[Row], line: Mapping[str, Any], column: Any) -> list[Row | None]:
        """Return the row at each place of the axis, None where there is none."""
        wanted = dict(line) | ({self.column: column} if self.column else {})
        found = [pick(rows, **wanted, **{self.x: place}) for place in self.places]
        return [match[0] if match else None for match in found]

    def style(self, method: str, place: int) -> dict[str, Any]:
        """Return how a method's curve of the given line is drawn."""
        look: Look = self.looks[method]
        filled = place % 2 == 1 or len(self.lines) == 1
        return {
            "color": look.colour,
            "linestyle": "-" if len(self.lines) == 1 else _DASHES[place % len(_DASHES)],
            "marker": look.marker,
            "markersize": 5.5,
            "linewidth": 1.7,
            "markerfacecolor": look.colour if filled else PAPER,
        }


def _combinations(factors: Mapping[str, Sequence[Any]]) -> Settings:
    found: Settings = [{}]
    for key, values in factors.items():
        found = [{**setting, key: value} for setting in found for value in values]
    return found


def grid_figure(
    rows: Sequence[Row],
    gaps: Sequence[Row],
    factors: Mapping[str, Sequence[Any]],
    cell: Mapping[str, int],
    *,
    task: str = ALL,
) -> "Figure":
    """Draw success of each method, and what prefix wins over naive and pinv, in every setting.

    All panels of differences have one scale.

    `rows` and `gaps` are those of one protocol; `cell` names delay and exec horizon.
    """
    mine = pick(rows, task=task, train_seed=ALL, **cell)
    plot = _Plot(factors, list(dict.fromkeys(row["method"] for row in mine)))
    pairs = [pair for pair in SHOWN if set(pair) <= set(plot.methods)]
    limits = _limits([row for pair in pairs for row in _gaps(gaps, task, pair, cell)])
    heights = [3.0, *([2.2] * len(pairs))]
    figure = new_figure(7.4, 1.0 + sum(heights) * 0.95)
    panels = figure.subplots(
        len(heights), len(plot.columns), sharex=True, sharey="row", squeeze=False,
        height_ratios=heights,
    )  # fmt: skip
    for place, column in enumerate(plot.columns):
        title = f"{factor_name(plot.column)} {value_text(column)}" if plot.column else ""
        _success_panel(panels[0, place], mine, plot, column)
        tidy(
            panels[0, place],
            title=title,
            y=f"solved at d = {cell['delay']} (%)" if place == 0 else "",
        )
        for axes, (method, baseline) in zip(panels[1:, place], pairs, strict=True):
            found = _gaps(gaps, task, (method, baseline), cell)
            _gap_panel(axes, found, plot, method, column)
            label = f"{method} − {baseline}\n(points)" if place == 0 else ""
            axes.set_ylim(*limits)
            tidy(axes, y=label)
        _ticks(panels[-1, place], plot)
    figure.supxlabel(factor_name(plot.x), color=MUTED, fontsize=9.5)
    _legend(figure, plot)
    return figure


def _gaps(
    gaps: Sequence[Row], task: str, pair: tuple[str, str], cell: Mapping[str, int]
) -> list[Row]:
    return pick(gaps, task=task, method=pair[0], baseline=pair[1], **cell)


def _limits(gaps: Sequence[Row]) -> tuple[float, float]:
    """Return one scale for all panels of differences: it holds every interval, and 0."""
    ends = [0.0]
    for row in gaps:
        values = (row["difference"], row["low"], row["high"])
        ends += [100 * value for value in values if value is not None]
    margin = 0.06 * max(max(ends) - min(ends), 5.0)
    return min(ends) - margin, max(ends) + margin


def _success_panel(axes: "Axes", rows: Sequence[Row], plot: _Plot, column: Any) -> None:
    for method in plot.methods:
        for place, line in enumerate(plot.lines):
            curve = plot.curve(pick(rows, method=method), line, column)
            values = [100 * row["success"] if row else float("nan") for row in curve]
            axes.plot(range(len(values)), values, **plot.style(method, place))
    axes.set_ylim(0, 103)


def _gap_panel(axes: "Axes", gaps: Sequence[Row], plot: _Plot, method: str, column: Any) -> None:
    """Draw differences with their intervals; lines stand a little apart so that both are seen."""
    axes.axhline(0, color=INK, linewidth=1.1)
    for place, line in enumerate(plot.lines):
        shift = 0.14 * (place - (len(plot.lines) - 1) / 2)
        curve = plot.curve(gaps, line, column)
        points = [(x + shift, row) for x, row in enumerate(curve) if row is not None]
        style = plot.style(method, place)
        for x, row in points:
            if row["low"] is not None:
                axes.vlines(x, 100 * row["low"], 100 * row["high"], style["color"], linewidth=1.4)
        values = [100 * row["difference"] for _, row in points]
        axes.plot([x for x, _ in points], values, **style)


def _ticks(axes: "Axes", plot: _Plot) -> None:
    axes.set_xticks(range(len(plot.places)), [value_text(place) for place in plot.places])
    axes.set_xlim(-0.35, len(plot.places) - 0.65)


def _legend(figure: "Figure", plot: _Plot) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], **(plot.style(name, 1) | {"linestyle": "-"}), label=name)
        for name in plot.methods
    ]
    if len(plot.lines) > 1:
        for place, line in enumerate(plot.lines):
            style = plot.style(plot.methods[-1], place)
            grey = {"color": MUTED, "marker": "o"}
            fill = {} if style["markerfacecolor"] == PAPER else {"markerfacecolor": MUTED}
            handles.append(Line2D([], [], **(style | grey | fill), label=setting_text(line)))
    figure.legend(
        handles=handles, loc="outside upper left", ncols=min(len(handles), 5), frameon=False,
        fontsize=9, labelcolor=INK, handlelength=2.8, columnspacing=1.4,
    )  # fmt: skip
