"""A saved profile: report.md and index.html with the figure, and the rows with raw samples."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtc_cli.fixed_costs import say_costs
from rtc_cli.report.document import Bullets, Document, Picture, Section, Table
from rtc_cli.report.figures import profile_groups
from rtc_cli.report.profile.figure import chunk_figure
from rtc_cli.report.profile.published import PUBLISHED
from rtc_cli.report.tables import Row
from rtc_cli.report.writing import ReportPaths, write_document
from rtc_cli.units import three_digits

_TIMES = {
    "p50_ms": "p50 (ms)",
    "p95_ms": "p95 (ms)",
    "p99_ms": "p99 (ms)",
    "per_step_ms": "per step (ms)",
}


def save_profile_page(folder: Path, content: Mapping[str, Any]) -> ReportPaths:
    """Write the page of a profile's JSON document into a folder."""
    rows: list[Row] = list(content["rows"])
    groups = profile_groups(rows)
    large = any("expert" in str(row["network"]) for row in rows)
    first = rows[0]
    machine = content["machine"]
    drawing = Picture(
        "profile",
        "Time of one chunk per sampler, fixed costs and flow steps stacked",
        chunk_figure(groups, published=large),
        "One bar per sampler. d is made of the 95th percentile, fixed costs included "
        f"({first['rounding']}).",
    )
    sections = [Section("chunk", "Where the time goes", [drawing])]
    sections += [
        Section(f"cell-{number}", title, [_times(group), _programs(group), _meaning(group)])
        for number, (title, group) in enumerate(groups.items())
    ]
    if large:
        sections.append(Section("published", "Published latencies", [_published()]))
    sections.append(Section("how", "How it was measured", [Bullets(_method(first, machine))]))
    document = Document(
        title=f"Profile of {first['network']}",
        subtitle=f"{machine['cpu']}, {machine['cores']} cores; {first['dtype']}; random weights "
        "have the same cost as trained ones.",
        question="What does a chunk cost with each sampler, and which delay follows?",
        answer=[_sentence(group) for group in groups.values()],
        sections=sections,
    )
    return write_document(folder, document, dict(content), {})


def _sentence(rows: list[Row]) -> str:
    first = rows[0]
    parts = [
        f"{row['sampler']} {row['ratio_to_plain']:.2f} ({row['ratio_low']:.2f} to "
        f"{row['ratio_high']:.2f})"
        for row in rows[1:]
    ]
    return (
        f"Batch {first['batch']}, {first['flow_steps']} flow steps: plain takes "
        f"{three_digits(first['p50_ms'])} ms. Times relative to it: {', '.join(parts)}."
    )


def _times(rows: list[Row]) -> Table:
    lines = [
        [
            str(row["sampler"]),
            *(three_digits(row[key]) for key in _TIMES),
            f"{row['ratio_to_plain']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})",
        ]
        for row in rows
    ]
    caption = f"One chunk, {rows[0]['rounds']} rounds"
    return Table(["sampler", *_TIMES.values(), "x plain"], lines, caption)


def _programs(rows: list[Row]) -> Table:
    lines = [
        [
            str(row["sampler"]),
            _giga(row["flops"]),
            _giga(row["bytes"]),
            _giga(row["floor_bytes"]),
            three_digits(row["floor_ms"]),
            f"{row['over_floor']:.2f}",
            _giga(row["memory_bytes"]),
            f"{row['compile_s']:.1f}",
        ]
        for row in rows
    ]
    columns = ["sampler", "GFLOP", "GB (compiler)", "GB to be read", "floor (ms)"]
    return Table([*columns, "p50 / floor", "memory (GB)", "compile (s)"], lines, "Programs")


def _meaning(rows: list[Row]) -> Table:
    first = rows[0]
    rates = [d for d in ("1", "2", "4", "8") if d in first["highest_hz"]]
    lines = [
        [
            str(row["sampler"]),
            three_digits(row["total_p95_ms"]),
            *(str(row[f"delay_{name}"]) for name in ("ceil", "nearest", "floor")),
            f"{row['chunk_share']:.0%}",
            *(f"{row['highest_hz'][d]:.3g}" for d in rates),
        ]
        for row in rows
    ]
    columns = ["sampler", "p95, all (ms)", "d ceil", "d nearest", "d floor", "of the chunk"]
    fixed = say_costs(first["fixed_ms"]) or "none"
    caption = f"What it means at {first['hz']:g} Hz; fixed costs: {fixed}"
    return Table([*columns, *(f"highest Hz for d = {d}" for d in rates)], lines, caption)


def _published() -> Table:
    lines = [
        [
            chunk.label,
            chunk.source,
            " + ".join(f"{name} {ms:g}" for name, ms in chunk.parts.items()),
            f"{chunk.total_ms:g}",
        ]
        for chunk in PUBLISHED
    ]
    return Table(["chunk", "source", "parts (ms)", "total (ms)"], lines, left=3)


def _method(first: Row, machine: Mapping[str, Any]) -> list[str]:
    return [
        f"jax {machine['jax']}; all programs warm, called in turns in a new order each round, each "
        "waited for.",
        f"x plain: {first['ratio_method']}.",
        "A context's keys and values are computed once per chunk by another network: they are not "
        "in the times, enter them as a fixed cost.",
        f"floor: the larger of the bytes to be read at {first['ceiling_bytes_per_s'] / 1e9:.3g} "
        f"GB/s (a large copy) and the flops at {first['ceiling_flops_per_s'] / 1e9:.4g} GFLOP/s (a "
        f"large matrix product, {first['dtype']}), both measured in the same run.",
        "GB to be read: every weight and cached key, as often as a product reads it.",
    ]


def _giga(value: float | None) -> str:
    return "?" if value is None else f"{value / 1e9:.3g}"
