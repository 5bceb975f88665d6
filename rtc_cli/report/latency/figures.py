"""The figures of a latency page, drawn from the document that `rtc latency --json` prints."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtc_cli.report.style import FILLS, INK, LOOKS, MUTED, PAPER, new_figure, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BODY, WARM_UP, OUTLIER = LOOKS[0].colour, LOOKS[1].colour, LOOKS[7].colour
LEVEL, BAND = LOOKS[2].colour, FILLS["rest"].colour
_LOG_FROM = 12.0  # slowest over median: beyond it a linear axis hides the body
_DRAWN_AS_IMAGE = 3000  # points
_MOST_BOUNDARIES, _NAMED_BOUNDARIES = 24, 18
_MOST_TICKS = 500
_FILL, _HOLLOW = 0.55, 0.14

Document = Mapping[str, Any]


def trace_figure(data: Document) -> "Figure":
    """Draw each chunk's latency in order, with warm-up, outliers and level."""
    values = np.array(data["samples_ms"])
    warm, limit = int(data["warm_up"]["rows"]), data["outliers"]["limit_ms"]
    figure = new_figure(7.4, 3.5)
    axes = figure.add_subplot()
    number = np.arange(1, values.size + 1)
    level = _level(data, values.size)
    # The limit belongs to the level of the slower end.
    high = limit * level / data["drift"]["slower_end"]
    first = number <= warm
    outlying = ~first & (values > high)
    for chosen, colour in ((~first & ~outlying, BODY), (outlying, OUTLIER), (first, WARM_UP)):
        axes.scatter(
            number[chosen],
            values[chosen],
            s=7,
            color=colour,
            alpha=_FILL if chosen is not first else 1.0,
            linewidths=0,
            rasterized=values.size > _DRAWN_AS_IMAGE,
        )
    kept = number > warm
    median = float(np.median(values[kept] / level[kept]))
    axes.plot(number[kept], median * level[kept], color=LEVEL, linewidth=2)
    axes.plot(number[kept], high[kept], color=OUTLIER, linewidth=1, linestyle="--")
    if warm:
        axes.axvspan(0.5, warm + 0.5, color=WARM_UP, alpha=_HOLLOW, linewidth=0)
    _latency_axis(axes, values)
    tidy(axes, x="chunk, in the order measured", y="latency (ms)")
    axes.set_xlim(-0.01 * values.size, 1.01 * values.size)
    _key(figure, data, warm, int(outlying.sum()))
    return figure


def _level(data: Document, count: int) -> NDArray[np.float64]:
    """(count,) level at each row, 1 in the middle of the stationary part; 1 without drift."""
    drift = data["drift"]
    if not drift["found"]:
        return np.ones(count)
    rows = np.arange(count) - data["warm_up"]["rows"]
    return np.maximum(1 + drift["change"] * ((rows + 0.5) / drift["rows"] - 0.5), 0.1)


def _key(figure: "Figure", data: Document, warm: int, outlying: int) -> None:
    """Name the colours above the panel."""
    from matplotlib.lines import Line2D

    drift = data["drift"]
    level = f"level ({drift['change']:+.0%})" if drift["found"] else "level (no drift found)"
    dot: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 5}
    named = [(f"warm-up ({warm})", WARM_UP, dot)] if warm else []
    named += [("other chunks", BODY, dot), (level, LEVEL, {"linewidth": 2})]
    named += [(f"outliers ({outlying})", OUTLIER, dot)]
    named += [("limit of outliers", OUTLIER, {"linewidth": 1, "linestyle": "--"})]
    figure.legend(
        handles=[Line2D([], [], color=colour, label=text, **look) for text, colour, look in named],
        loc="outside upper left",
        ncols=len(named),
        frameon=False,
        fontsize=9,
        handletextpad=0.4,
        columnspacing=1.3,
        labelcolor=INK,
    )


def _latency_axis(axes: "Axes", values: NDArray[np.float64]) -> None:
    if values.min() > 0 and values.max() > _LOG_FROM * np.median(values):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, 1.05 * float(values.max()) or 1.0)


def distribution_figure(data: Document) -> "Figure":
    """Draw the stationary part: histogram over the ticks, and the share slower than x."""
    values = stationary(data)
    figure = new_figure(7.4, 5.4)
    grid = figure.add_gridspec(2, 1, height_ratios=[1.0, 1.1])
    upper = figure.add_subplot(grid[0])
    lower = figure.add_subplot(grid[1], sharex=upper)
    left, right = _range(values)
    upper.hist(values, bins=np.linspace(left, right, 90).tolist(), color=BODY, alpha=0.85)
    slower = 1 - np.arange(values.size) / values.size
    lower.plot(np.sort(values), slower, color=BODY, linewidth=1.8, drawstyle="steps-pre")
    upper.set_ylim(0, 1.18 * upper.get_ylim()[1])  # room for the delays
    lower.set_yscale("log")
    lower.set_ylim(0.5 / values.size, 1.3)
    lower.set_yticks(ticks := _decades(values.size), [f"{100 * tick:g}%" for tick in ticks])
    lower.minorticks_off()
    for axes in (upper, lower):
        axes.set_xlim(left, right)
    _boundaries(upper, lower, data)
    _percentiles(lower, data["rows"])
    tidy(upper, title="How many chunks take how long", y="chunks", grid="")
    tidy(lower, title="Share of chunks slower than this", x="latency (ms)", y="share, log scale")
    return figure


def stationary(data: Document) -> NDArray[np.float64]:
    """The rows after the warm-up, at the level of the slower end, as the percentiles have it."""
    values = np.array(data["samples_ms"])
    level = _level(data, values.size)
    return (values / level * data["drift"]["slower_end"])[data["warm_up"]["rows"] :]


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    margin = 0.04 * float(np.ptp(values)) or 0.05 * float(values.max()) or 1.0
    return max(0.0, float(values.min()) - margin), float(values.max()) + margin


def _decades(count: int) -> list[float]:
    return [10.0**-power for power in range(int(np.floor(np.log10(count))) + 1)]


def _boundaries(upper: "Axes", lower: "Axes", data: Document) -> None:
    """Shade every other tick and write the delay that a latency in it means, as space allows."""
    period = 1000 / data["hz"]
    shift = {"ceil": 0.0, "nearest": -0.5, "floor": -1.0}[data["rounding"]]
    left, right = upper.get_xlim()
    if (right - left) / period > _MOST_TICKS:
        return
    delays = range(max(0, int(left / period) - 1), int(right / period) + 3)
    spans = [(d, (d - 1 - shift) * period, (d - shift) * period) for d in delays]
    seen = [span for span in spans if span[2] > left and span[1] < right]
    step = -(-len(seen) // _MOST_BOUNDARIES)
    for delay, start, stop in seen:
        if delay % 2 and step == 1:
            for axes in (upper, lower):
                axes.axvspan(max(start, left), min(stop, right), color=BAND, lw=0, zorder=0)
        middle = (max(start, left) + min(stop, right)) / 2
        if delay % step == 0 and (min(stop, right) - max(start, left)) > 0.3 * period:
            upper.annotate(
                f"d={delay}" if len(seen) <= _NAMED_BOUNDARIES else str(delay),
                (middle, 0.93),
                xycoords=("data", "axes fraction"),
                ha="center",
                fontsize=8.5,
                color=MUTED,
            )


def _percentiles(axes: "Axes", rows: Sequence[Document]) -> None:
    """Mark each percentile with its interval and name it."""
    for row in rows:
        share = 1 - row["percentile"]
        if share <= 0:
            continue
        ends = [row["low_ms"], row["high_ms"]]
        if None not in ends:
            axes.plot(ends, [share, share], color=INK, linewidth=4, alpha=0.45)
        axes.plot([row["latency_ms"]], [share], "o", color=INK, markersize=4.5)
        axes.annotate(
            f"p{100 * row['percentile']:g}: {row['latency_ms']:.4g} ms",
            (row["latency_ms"], share),
            xytext=(9, 4),
            textcoords="offset points",
            fontsize=9,
            color=INK,
            bbox={"boxstyle": "round,pad=0.15", "fc": PAPER, "ec": "none", "alpha": 0.7},
        )


def delays_figure(data: Document) -> "Figure":
    """Draw the share of chunks of each delay, with what the sampler is told and s."""
    plan, rows = data["recommendation"], data["delays"]
    figure = new_figure(7.4, 3.2)
    axes = figure.add_subplot()
    delays = [row["delay"] for row in rows]
    told = plan["delay_cond"]
    longest = plan["limit"] if told is None else told
    colours = [BODY if d <= longest else WARM_UP if d <= plan["limit"] else OUTLIER for d in delays]
    shares = [100 * row["share"] for row in rows]
    axes.bar(delays, shares, color=colours, width=0.8)
    for delay, share in zip(delays, shares, strict=True):
        if len(delays) <= _MOST_BOUNDARIES:
            text = f"{share:.0f}%" if share >= 9.5 else f"{max(share, 0.1):.1f}%"
            text = f"<{text}" if share < 0.05 else text
            axes.annotate(
                text,
                (delay, share),
                xytext=(0, 2),
                textcoords="offset points",
                ha="center",
                fontsize=8.5,
                color=MUTED,
            )
    last = max(*delays, plan["limit"]) + 1
    if last <= 40:
        axes.set_xticks(range(last + 1))
    axes.set_xlim(min(*delays, 0) - 0.6, last + 0.1)
    axes.set_ylim(0, 1.12 * max(shares))
    _lines(axes, plan)
    tidy(
        axes,
        x=f"delay d in control steps at {data['hz']:g} Hz ({data['rounding']})",
        y="chunks (%)",
    )
    return figure


def _lines(axes: "Axes", plan: Document) -> None:
    """Mark d_cond and the largest delay that s and H allow."""
    limit, told = plan["limit"], plan["delay_cond"]
    legal = f"s = {plan['exec_horizon']}, H = {plan['horizon']}: up to d = {limit}"
    marks = [(limit, f"{legal},\nbeyond violates d \u2264 s \u2264 H \u2212 d", OUTLIER)]
    if told is not None and told < limit:
        marks.append((told, f"d_cond = {told},\nbeyond comes late", WARM_UP))
    right_edge = axes.get_xlim()[1]
    for place, (delay, text, colour) in enumerate(marks):
        axes.axvline(delay + 0.5, color=colour, linewidth=1.2, linestyle=("--", ":")[place])
        side = "right" if delay > 0.6 * right_edge else "left"
        axes.annotate(
            text,
            (delay + 0.5, (0.95, 0.7)[place]),
            xycoords=("data", "axes fraction"),
            xytext=(-5 if side == "right" else 5, 0),
            textcoords="offset points",
            ha=side,
            va="top",
            fontsize=9,
            color=colour,
            bbox={"boxstyle": "round,pad=0.1", "fc": PAPER, "ec": "none", "alpha": 0.8},
        )


def correlation_figure(data: Document) -> "Figure":
    """Draw the autocorrelation of ranks over lags, with the band of noise."""
    bursts = data["autocorrelation"]
    values = bursts["correlation"][1:]
    figure = new_figure(7.4, 2.7)
    axes = figure.add_subplot()
    lags = np.arange(1, len(values) + 1)
    noise = bursts["noise"]
    axes.axhspan(-noise, noise, color=BAND, lw=0)
    axes.bar(lags, values, width=0.7, color=[BODY if abs(v) > noise else MUTED for v in values])
    axes.axhline(0, color=MUTED, linewidth=0.8)
    axes.annotate(
        "band: 95% of what independent chunks show",
        (0.995, 0.97),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=9,
        color=MUTED,
        bbox={"boxstyle": "round,pad=0.1", "fc": PAPER, "ec": "none"},
    )
    low, high = min([*values, -2 * noise]), max([*values, 2 * noise])
    axes.set_ylim(low - 0.05 * (high - low), high + 0.2 * (high - low))
    tidy(axes, x="lag (chunks)", y="autocorrelation")
    return figure
