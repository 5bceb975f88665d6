"""A report as data: sections of blocks, written once and rendered as Markdown and as HTML.

Running text may use `code` and **bold**; everything else is taken literally.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Note:
    """Something that is missing, or a limit that the reader must know."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """Short points."""

    items: Sequence[str]


@dataclass(frozen=True)
class Definitions:
    """Terms with their meanings."""

    items: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table of text; the first column names the row, the others are right-aligned."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    left: int = 1
    """How many of the first columns hold names."""


@dataclass(frozen=True)
class Picture:
    """A figure with its caption; `name` is its file name and id, `label` says what it shows."""

    name: str
    label: str
    figure: "Figure"
    caption: str = ""


@dataclass(frozen=True)
class Code:
    """Literal text."""

    text: str
    language: str = ""


@dataclass(frozen=True)
class Fold:
    """Blocks behind a line that opens them."""

    title: str
    blocks: Sequence["Block"]


Block = Paragraph | Note | Bullets | Definitions | Table | Picture | Code | Fold


@dataclass(frozen=True)
class Section:
    """A titled part of the report; `key` is its anchor."""

    key: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Document:
    """A whole report; `answer` stands above all sections."""

    title: str
    subtitle: str
    question: str
    answer: Sequence[str]
    sections: Sequence[Section] = field(default_factory=tuple)


def pictures(blocks: Sequence[Block]) -> list[Picture]:
    """Return all pictures in some blocks, those inside folds too."""
    found: list[Picture] = []
    for block in blocks:
        if isinstance(block, Picture):
            found.append(block)
        elif isinstance(block, Fold):
            found.extend(pictures(block.blocks))
    return found
