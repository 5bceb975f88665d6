"""What a terminal shows of a whole report, whichever kind it is."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rtc_cli.report.grid.tables import render_grid
from rtc_cli.report.render import render_d90, render_differences, render_summary
from rtc_cli.report.selection import fits_protocol
from rtc_cli.report.tables import ALL, Row
from rtc_cli.report.varying import constant, render_varying

if TYPE_CHECKING:
    from rich.table import Table


def render_report(data: Mapping[str, Any]) -> "list[Table]":
    """Return the tables that a terminal shows after a report: success, differences, D90."""
    if "grid" in data:
        return render_grid(data)
    rows: list[Row] = data["rows"]
    gaps: list[Row] = data["differences"]
    series = "variant" if rows and "variant" in rows[0] else "method"
    named = [row for row in rows if "+" not in row["method"]]
    if series == "variant":
        return [*render_summary(named, series=series), *_render_gaps(rows, gaps)]
    tables = [*render_summary(constant(named)), *_render_gaps(rows, constant(gaps))]
    tables += render_varying(named, gaps)
    d90 = [row for row in data.get("d90", []) if "+" not in row["method"]]
    return [*tables, *render_d90(d90)]


def _render_gaps(rows: Sequence[Row], gaps: Sequence[Row]) -> "list[Table]":
    protocols = dict.fromkeys(row["protocol"] for row in rows)
    return [
        render_differences(gaps, protocol)
        for protocol in protocols
        if any(row["task"] == ALL and fits_protocol(row, protocol) for row in gaps)
    ]
