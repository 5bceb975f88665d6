"""The files of a report: report.md with PNG figures, index.html, rows.json, CSV tables."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from rtc_cli.files import write_bytes, write_json, write_text
from rtc_cli.report.document import Document, pictures
from rtc_cli.report.html import render_html
from rtc_cli.report.markdown import render_markdown
from rtc_cli.report.style import png

# Keys of the JSON document that are also written as CSV, and the names of the files.
TABLES = {
    "rows": "success",
    "differences": "differences",
    "decomposition": "decomposition",
    "recovered": "recovered",
    "classes": "classes",
    "controls": "controls",
    "d90": "d90",
    "effects": "effects",
}
CSV_DIGITS = 5


@dataclass(frozen=True)
class ReportPaths:
    """The files of a report, and the JSON document that `rtc report --json` prints."""

    markdown: Path
    html: Path
    rows: Path
    figures: tuple[Path, ...]
    tables: tuple[Path, ...]
    data: dict[str, Any]


def write_document(
    folder: Path, document: Document, data: dict[str, Any], tables: Mapping[str, str] = TABLES
) -> ReportPaths:
    """Write a document into a folder, replacing an older one; `tables`: keys of `data` as CSV."""
    images = []
    for section in document.sections:
        for picture in pictures(section.blocks):
            path = folder / "figures" / f"{picture.name}.png"
            write_bytes(path, png(picture.figure))
            images.append(path)
    markdown, html, rows = folder / "report.md", folder / "index.html", folder / "rows.json"
    write_text(markdown, render_markdown(document))
    write_text(html, render_html(document))
    write_json(rows, data)
    written = _write_tables(folder, data, tables)
    return ReportPaths(markdown, html, rows, tuple(images), written, data)


def _write_tables(
    folder: Path, data: Mapping[str, Any], tables: Mapping[str, str]
) -> tuple[Path, ...]:
    """Write the rows of each kind that has some as CSV, rounded, for spreadsheets and diffs."""
    written = []
    for key, name in tables.items():
        if data.get(key):
            table = pd.DataFrame(data[key]).round(CSV_DIGITS)
            path = folder / "tables" / f"{name}.csv"
            write_text(path, table.to_csv(index=False))
            written.append(path)
    return tuple(written)
