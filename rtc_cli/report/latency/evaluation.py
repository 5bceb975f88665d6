"""What a trace does to a run's policies: sentences, tables and a figure from `rtc latency --run`.

Rows are those of `eval`: means per episode under delays that vary as in the trace.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.report.document import Block, Code, Paragraph, Picture, Section
from rtc_cli.report.render import Grid, difference_cell, success_cell, task_by_method_grid
from rtc_cli.report.sections import CONTROL_HZ, as_table
from rtc_cli.report.style import looks, new_figure, tidy
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import SUMMARY_INTERVAL, difference_interval_text, interval, points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Data = Mapping[str, Any]

_COUNTS = {
    "late_chunks": "late",
    "dropped_chunks": "dropped",
    "starved_ticks": "starved",
    "exceeded_requests": "exceeded",
}
_UNTOLD = ("sync", "oracle")
_ALIKE_HZ = 0.01
_MOST_SAID = 4  # rows in a sentence


def sentences(data: Data) -> list[str]:
    """Say how the policies were evaluated, what they solve, and what limits that."""
    return [_how(data), *solved(data), *_untrained(data), *_limits(data)]


def _how(data: Data) -> str:
    how, rows = data["evaluated"], _shown(data)
    told = ", ".join(how["estimators"])
    return (
        f"{_where(data)}, {max(row['episodes'] for row in rows)} episodes per method, "
        f"{', '.join(how['protocols'])} of H = {how['horizon']}, K = {how['flow_steps']}, told "
        f"{told}. Every inference takes one of the {how['rows']} latencies after the warm-up, "
        f"drawn in blocks of {how['mean_block']:.1f} rows on average; no delay is cut off."
    )


def _where(data: Data) -> str:
    tasks = _tasks(data["evaluation"])
    seeds = {row["train_seed"] for row in data["evaluation"]} - {ALL}
    what = f"mean of {len(tasks)} tasks" if len(tasks) > 1 else tasks[0]
    return f"{data['run']}: {what}, {len(seeds)} training seed{'s' if len(seeds) > 1 else ''}"


def solved(data: Data) -> list[str]:
    """Return the success of each method in a sentence; none where a table is easier to read."""
    rows = _shown(data)
    if len(rows) > _MOST_SAID:
        return []
    found = (
        f"{_name(row, data)} {points(row['success'])}% "
        f"{interval(row['success_low'], row['success_high'])}"
        for row in rows
    )
    return [f"Solved under these latencies: {', '.join(found)}."]


def _untrained(data: Data) -> list[str]:
    beyond = [row for row in _shown(data) if row["exceeded_requests"]]
    if not beyond:
        return []
    found = "; ".join(f"{_name(row, data)} {row['exceeded_requests']:.2g}" for row in beyond)
    return [
        f"Told more than it was trained for, requests per episode: {found}. Train it with the keys "
        "for a recipe."
    ]


def _limits(data: Data) -> list[str]:
    how, found = data["evaluated"], []
    if abs(how["hz"] / CONTROL_HZ - 1) > _ALIKE_HZ:
        found.append(
            f"A delay counts control steps at {how['hz']:g} Hz; a step of these tasks lasts "
            f"1/{CONTROL_HZ:g} s, so the same milliseconds would be another delay there."
        )
    if how["drifts"]:
        found.append("Latencies are drawn as measured: the drift is in them, in random order.")
    return found


def evaluation_grid(data: Data) -> Grid:
    """Success and cases per episode: one line per method, s and estimator."""
    lines = [
        [
            _method(row["method"]),
            "-" if row["schedule"] in _UNTOLD else row["estimator"],
            str(row["exec_horizon"]),
            success_cell(row),
            *(f"{row[name]:.3g}" for name in _COUNTS),
        ]
        for row in _shown(data)
    ]
    return Grid(["method", "told", "s", "solved %", *_COUNTS.values()], lines, left=2)


def difference_grid(data: Data) -> Grid:
    """Paired differences of methods that met the same delays."""
    told = {row["method"]: row["estimator"] for row in data["evaluation"]}
    whole = ALL if len(_tasks(data["evaluation"])) > 1 else _tasks(data["evaluation"])[0]
    lines = [
        [
            f"{_method(row['method'])} − {_method(row['baseline'])}",
            told[row["method"]],
            str(row["exec_horizon"]),
            difference_cell(row),
        ]
        for row in pick(data["differences"], task=whole)
    ]
    return Grid(["difference", "told", "s", "points"], lines, left=2)


def evaluation_section(data: Data) -> Section:
    """Return the part of the page about the policies."""
    figure = Picture(
        "evaluation",
        "Success of each method under these latencies",
        evaluation_figure(data),
        "Bars: 95% Wilson intervals of these checkpoints.",
    )
    counts = (
        "Late and dropped chunks, starved ticks (no action left: the robot holds) and requests "
        "beyond the trained delays are per episode. * marks such a request."
    )
    blocks: list[Block] = [Paragraph(sentence) for sentence in sentences(data)]
    blocks += [figure, as_table(evaluation_grid(data), f"{counts} {SUMMARY_INTERVAL}")]
    if len(_tasks(data["evaluation"])) > 1:
        rows = [row | {"method": _name(row, data)} for row in _pooled(data)]
        grid = task_by_method_grid(rows, lambda row: points(row["success"]))
        blocks.append(as_table(grid, "Episodes solved (%), per task."))
    if data["differences"]:
        caption = difference_interval_text(data["differences"])
        blocks.append(as_table(difference_grid(data), caption))
    blocks += [Paragraph("The same with `rtc eval`:"), Code(data["evaluated"]["command"], "sh")]
    return Section("policies", "What this does to the policies", blocks)


def evaluation_figure(data: Data) -> "Figure":
    """Draw success with its interval, one line per row of the table."""
    rows = _shown(data)
    names = [_name(row, data) for row in rows]
    colours = looks(list(dict.fromkeys(_method(row["method"]) for row in rows)))
    figure = new_figure(7.4, 1.1 + 0.34 * len(rows))
    axes = figure.subplots()
    for place, row in enumerate(rows):
        look, at = colours[_method(row["method"])], len(rows) - place
        low, high = 100 * row["success_low"], 100 * row["success_high"]
        axes.plot([low, high], [at, at], color=look.colour, linewidth=2)
        axes.plot([100 * row["success"]], [at], marker=look.marker, color=look.colour)
    axes.set_yticks(range(len(rows), 0, -1), names)
    axes.set_ylim(0.4, len(rows) + 0.6)
    axes.set_xlim(-1, 101)  # markers at the ends stay whole
    tidy(axes, x="episodes solved (%)", grid="x")
    return figure


def _shown(data: Data) -> list[Row]:
    """The rows over all tasks and training seeds."""
    tasks = _tasks(data["evaluation"])
    return pick(_pooled(data), task=ALL if len(tasks) > 1 else tasks[0])


def _pooled(data: Data) -> list[Row]:
    return pick(data["evaluation"], train_seed=ALL)


def _tasks(rows: Sequence[Row]) -> list[str]:
    return sorted({row["task"] for row in rows} - {ALL})


def _method(label: str) -> str:
    """A method's name without its delays, which all rows share."""
    return label.partition(" (delays ")[0]


def _name(row: Row, data: Data) -> str:
    """A method's name, with what tells its rows apart."""
    how = data["evaluated"]
    parts = [_method(row["method"])]
    if len(how["estimators"]) > 1 and row["schedule"] not in _UNTOLD:
        parts.append(f"told {row['estimator']}")
    if len(how["protocols"]) > 1 or how["protocols"] == ["grid"]:
        parts.append(f"s = {row['exec_horizon']}")
    return ", ".join(parts)
