"""The page of a latency trace: what was found, with figures, and the recommendation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtc_cli.report.document import (
    Block,
    Code,
    Definitions,
    Document,
    Note,
    Paragraph,
    Picture,
    Section,
    Table,
)
from rtc_cli.report.latency import figures
from rtc_cli.report.latency.evaluation import evaluation_section, solved
from rtc_cli.report.writing import ReportPaths, write_document

Data = Mapping[str, Any]

GLOSSARY = (
    ("d", "delay: control steps from the start of an inference until its chunk can be used"),
    ("s", "execution horizon: control steps from one start of inference to the next, at least"),
    ("H", "horizon: actions in a chunk"),
    ("d_cond", "the delay that the sampler is told; a chunk with d > d_cond is late"),
    ("d <= s <= H - d", "in time before the next inference, and with actions left until then"),
    ("age of observation", "mean time since the observation behind an action: d + (s - 1)/2 steps"),
)


_TABLES = ("delays", "estimators", "evaluation", "differences")


def build_latency_page(folder: Path | str, data: dict[str, Any]) -> ReportPaths:
    """Write report.md, index.html, rows.json and tables from the document of `rtc latency`."""
    tables = {"rows": "percentiles"} | {name: name for name in _TABLES}
    return write_document(Path(folder), latency_document(data), data, tables)


def latency_document(data: Data) -> Document:
    """Return the page; `data` is what `rtc latency --json` prints, with `--run` or without."""
    policies = [evaluation_section(data)] if "evaluation" in data else []
    evaluated = solved(data) if policies else []
    return Document(
        title="Latency: which delay, which horizon, what to train on",
        subtitle=f"{data['trace']['rows']} chunks: `{data['trace']['source']}`.",
        question=f"What do these latencies mean at {data['hz']:g} Hz?",
        answer=[*data["trace"]["warnings"], *data["advice"], *evaluated],
        sections=[
            _trace(data),
            _distribution(data),
            _delays(data),
            _bursts(data),
            _horizons(data),
            _estimators(data),
            _recipe(data),
            *policies,
            Section("words", "Words", [Definitions(GLOSSARY)]),
        ],
    )


def _trace(data: Data) -> Section:
    blocks: list[Block] = [Paragraph(sentence) for sentence in data["findings"]]
    parts = data["trace"]["mean_ms_of_components"]
    picture = Picture(
        "trace",
        "Latency of each chunk in the order measured",
        figures.trace_figure(data),
        "Each dot is one chunk. The warm-up is shaded and left out of everything below.",
    )
    blocks.insert(0, picture)
    if len(parts) > 1:
        total = sum(parts.values())
        rows = [(name, f"{mean:.4g}", _percent(mean / total)) for name, mean in parts.items()]
        blocks.append(Table(("part", "mean ms", "share"), rows, "Parts that add up to a latency."))
    return Section("trace", "The trace", blocks)


def _distribution(data: Data) -> Section:
    drifts = data["drift"]["found"]
    level = " at the level of the slower end of the trace" if drifts else ""
    rows = []
    for row in data["rows"]:
        held = None in (row["low_ms"], row["high_ms"])
        interval = "" if held else f"{row['low_ms']:.4g} to {row['high_ms']:.4g}"
        rows.append((_name(row), f"{row['latency_ms']:.4g}", interval, str(row["delay"])))
    return Section(
        "percentiles",
        "Percentiles of the stationary part",
        [
            Picture(
                "distribution",
                "Histogram of latencies over the control ticks, and the share slower than each",
                figures.distribution_figure(data),
                f"The stationary part{level}. Shaded and plain bands are control ticks of "
                f"{1000 / data['hz']:.4g} ms; the number above is the delay that a latency in the "
                f"band means ({data['rounding']}). Thick bars: 95% intervals.",
            ),
            Table(
                ("", "ms", "95% interval", "d"),
                rows,
                "Intervals are made of order statistics and allow for autocorrelation. None where "
                "the rows are too few, and none for the maximum.",
            ),
        ],
    )


def _delays(data: Data) -> Section:
    plan = data["recommendation"]
    legal = f"Up to d = {plan['limit']} a request is legal at s = {plan['exec_horizon']} and "
    return Section(
        "delays",
        "Distribution of the delay",
        [
            Picture(
                "delays",
                "Share of chunks of each delay",
                figures.delays_figure(data),
                f"{legal}H = {plan['horizon']}. Blue: in time for what the sampler is told; "
                "orange: late; violet: beyond what s and H allow.",
            )
        ],
    )


def _bursts(data: Data) -> Section:
    caption = (
        "Autocorrelation of the latencies' ranks, which one huge value cannot dominate. A running "
        "maximum follows bursts; against independent chunks it only overstates."
    )
    picture = Picture(
        "autocorrelation",
        "Autocorrelation of latencies by lag",
        figures.correlation_figure(data),
        caption,
    )
    return Section("bursts", "Bursts", [picture])


def _horizons(data: Data) -> Section:
    rows = [
        (
            _name(row),
            *(str(row[key]) for key in ("delay", "exec_horizon", "horizon")),
            _percent(row["cycles"]["violated"]),
            f"{1000 * row['age'] / data['hz']:.0f} ms",
        )
        for row in data["choices"]
    ]
    caption = (
        "The smallest s and H that hold a share of cycles. The delay is that of the upper end of "
        "the percentile's interval. Violated: share of the measured cycles (without the warm-up) "
        "in which d <= s <= H - d fails, with one inference in flight at a time."
    )
    table = Table(("share held", "d", "s", "H", "violated", "age of observation"), rows, caption)
    return Section("horizons", "H and s", [table])


def _estimators(data: Data) -> Section:
    rows = [
        (told["estimator"], f"{told['mean']:.2f}", _span(told), _percent(told["late"]))
        for told in data["estimators"]
    ]
    caption = (
        "Over the measured cycles, at the recommended s and H. Recommended is the fixed value with "
        "the smallest mean and at most 5% late chunks; a running maximum only where it saves a "
        "quarter of a step."
    )
    columns = ("estimator", "mean d_cond", "range", "late chunks")
    return Section("estimators", "What to tell the sampler", [Table(columns, rows, caption)])


def _recipe(data: Data) -> Section:
    if data["recipe"] is None:
        text = "No recipe: its horizon may be at most 1000. Lower the control rate."
        return Section("recipe", "What to train on", [Note(text)])
    words = (
        "Keys for a recipe. 80% of training examples have the delay that the sampler will be told; "
        "20% are spread evenly over all legal delays, so that none is unknown."
    )
    return Section(
        "recipe", "What to train on", [Paragraph(words), Code(data["recipe"], language="toml")]
    )


def _name(row: Data) -> str:
    return "max" if row["percentile"] == 1 else f"p{100 * row['percentile']:g}"


def _span(told: Data) -> str:
    low, high = told["low"], told["high"]
    return str(low) if low == high else f"{low} to {high}"


def _percent(share: float) -> str:
    return f"{share:.1%}"
