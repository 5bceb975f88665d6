"""The page and the tables of an evaluation at equal hardware."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.fixed_costs import say_costs
from rtc_cli.report.charge.rows import best_by_method
from rtc_cli.report.document import Bullets, Document, Fold, Paragraph, Picture, Section
from rtc_cli.report.render import Grid
from rtc_cli.report.sections import as_table
from rtc_cli.report.style import INK, MUTED, looks, new_figure, tidy
from rtc_cli.report.tables import Row, pick
from rtc_cli.report.text import interval, points
from rtc_cli.report.writing import ReportPaths, write_document

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def charge_grid(rows: Sequence[Row]) -> Grid:
    """Latency, delay and success of each method and K."""
    lines = []
    for row in rows:
        success = "not possible" if row["success"] is None else points(row["success"])
        spread = "" if row["success"] is None else interval(row["success_low"], row["success_high"])
        s = "-" if row["exec_horizon"] is None else str(row["exec_horizon"])
        head = [row["method"], str(row["flow_steps"]), f"{row['latency_ms']:.4g}"]
        lines.append([*head, str(row["delay"]), s, success, spread])
    return Grid(["method", "K", "latency (ms)", "d", "s", "success (%)", "95%"], lines)


def difference_grid(rows: Sequence[Row]) -> Grid:
    """Differences of two methods with the same K, each at its own delay."""
    lines = [
        [
            f"{row['method']} - {row['baseline']}",
            str(row["flow_steps"]),
            f"{row['delay']} and {row['baseline_delay']}",
            points(row["difference"], sign=True),
            interval(row["low"], row["high"], sign=True),
        ]
        for row in rows
    ]
    return Grid(["difference", "K", "d", "points", "95%"], lines)


def findings(content: Mapping[str, Any]) -> list[str]:
    """What follows, in sentences."""
    rows: list[Row] = content["rows"]
    found = [
        f"{row['method']} does best with K = {row['flow_steps']}: "
        f"{points(row['success'])}% {interval(row['success_low'], row['success_high'])} at "
        f"{row['latency_ms']:.4g} ms, d = {row['delay']}."
        for row in best_by_method(rows)
    ]
    lost = [row for row in rows if row["success"] is None]
    if lost:
        names = ", ".join(f"{row['method']} with K = {row['flow_steps']}" for row in lost)
        found.append(f"Too slow for chunks of {content['horizon']} actions at this rate: {names}.")
    return found


def charge_figure(content: Mapping[str, Any]) -> "Figure":
    """Draw success against latency, one line per method, a point per K."""
    rows = [row for row in content["rows"] if row["success"] is not None]
    names = list(dict.fromkeys(row["method"] for row in rows))
    figure = new_figure(7.4, 4.2)
    axes = figure.subplots()
    axes.margins(x=0.07, y=0.12)
    for name, look in looks(names).items():
        mine = sorted(pick(rows, method=name), key=lambda row: row["latency_ms"])
        at = [row["latency_ms"] for row in mine]
        success = [100 * row["success"] for row in mine]
        axes.plot(at, success, marker=look.marker, linestyle=look.line, color=look.colour)
        low, high = ([100 * row[f"success_{end}"] for row in mine] for end in ("low", "high"))
        axes.vlines(at, low, high, color=look.colour, linewidth=1.1, alpha=0.6)
        for row, x, y in zip(mine, at, success, strict=True):
            axes.annotate(
                f"K={row['flow_steps']}", (x, y), xytext=(5, 5),  # lines fall: there is room
                textcoords="offset points", fontsize=8, color=look.colour,
            )  # fmt: skip
        axes.plot([], [], marker=look.marker, linestyle=look.line, color=look.colour, label=name)
    period = 1000 / content["hz"]
    left, right = axes.get_xlim()
    for tick in range(int(left / period), int(right / period) + 2):
        if left < tick * period < right:
            axes.axvline(tick * period, color=MUTED, linewidth=0.7, linestyle=":", zorder=0)
            axes.annotate(
                f"d > {tick}", (tick * period, 1.0), xycoords=("data", "axes fraction"),
                xytext=(2, -9), textcoords="offset points", fontsize=8, color=MUTED,
            )  # fmt: skip
    tidy(axes, x="latency of one chunk, fixed costs included (ms)", y="success (%)")
    axes.legend(frameon=False, fontsize=9, labelcolor=INK, loc="lower left")
    return figure


def save_charge_page(folder: Path, content: Mapping[str, Any]) -> ReportPaths:
    """Write the page of an evaluation at equal hardware into a folder."""
    document = Document(
        title="Success at equal hardware",
        subtitle=f"{content['tasks']}. {_conditions(content)}.",
        question="What is each method worth where it pays for its own latency?",
        answer=findings(content),
        sections=[
            Section("figure", "Success against latency", [_picture(content)]),
            Section("rows", "Every method and K", [as_table(charge_grid(content["rows"]))]),
            Section(
                "differences",
                "Differences with the same K",
                [as_table(difference_grid(content["differences"]))],
            ),
            Section("how", "How to read it", [Bullets(_READING)]),
        ],
    )
    return write_document(folder, document, dict(content), {})


def charge_section(content: Mapping[str, Any]) -> Section:
    """The same as one section of a run's report."""
    return Section(
        "charge",
        "Success at equal hardware",
        [
            Paragraph(
                "Here every method, with each number of flow steps K, acts at the delay of its own "
                f"latency. {_conditions(content)}."
            ),
            Bullets(findings(content)),
            _picture(content),
            as_table(charge_grid(content["rows"]), "Every method and K"),
            as_table(difference_grid(content["differences"]), "Differences with the same K"),
            Fold("How to read it", [Bullets(_READING)]),
        ],
    )


def _conditions(content: Mapping[str, Any]) -> str:
    fixed = say_costs(content["fixed_ms"])
    added = f", plus {fixed}" if fixed else ""
    return (
        f"Latencies: {content['profile']}{added}; delays are whole control steps at "
        f"{content['hz']:g} Hz ({content['rounding']})"
    )


def _picture(content: Mapping[str, Any]) -> Picture:
    return Picture(
        "charge",
        "Success against the latency of one chunk, by method and flow steps",
        charge_figure(content),
        "Bars: 95% Wilson intervals of these checkpoints. Dotted: where the next control step of "
        "delay begins.",
    )


_READING = [
    "Every method runs at the delay that its own latency means: a guided sampler, or more flow "
    "steps, are worth their time only where the success says so.",
    "Differences are paired by episode and, with two or more training seeds, by seed; the two "
    "methods act at different delays.",
    "The latencies are those of another network than the evaluated one where the profile's is not "
    "the run's own: a statement about delay, not about that network's actions.",
]
