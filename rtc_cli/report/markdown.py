"""A report document as Markdown; figures are PNG files beside it."""

from collections.abc import Sequence

from rtc_cli.report.document import (
    Block,
    Bullets,
    Code,
    Definitions,
    Document,
    Fold,
    Note,
    Paragraph,
    Picture,
    Table,
)


def render_markdown(document: Document, figures: str = "figures") -> str:
    """Return the document as Markdown; pictures refer to `<figures>/<name>.png`."""
    parts = [f"# {document.title}", document.subtitle, f"**{document.question}**"]
    parts.append("\n\n".join(f"> {sentence}" for sentence in document.answer))
    for section in document.sections:
        parts.append(f"## {section.title}")
        parts.extend(_block(block, figures) for block in section.blocks)
    return "\n\n".join(part for part in parts if part) + "\n"


def _block(block: Block, figures: str) -> str:
    match block:
        case Paragraph(text):
            return text
        case Note(text):
            return f"*Note:* {text}"
        case Bullets(items):
            return "\n".join(f"- {item}" for item in items)
        case Definitions(items):
            return "\n".join(f"- **{term}**: {meaning}" for term, meaning in items)
        case Table():
            table = markdown_table(block.columns, block.rows, block.left)
            return f"{table}\n\n{block.caption}" if block.caption else table
        case Picture(name, label, _, caption):
            image = f"![{label}]({figures}/{name}.png)"
            return f"{image}\n\n{caption}" if caption else image
        case Code(text, language):
            return f"```{language}\n{text.rstrip()}\n```"
        case Fold(title, blocks):
            inner = "\n\n".join(_block(part, figures) for part in blocks)
            return f"<details><summary>{title}</summary>\n\n{inner}\n\n</details>"


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table: the first `left` columns left-aligned, the others right."""
    rule = [":---" if place < left else "---:" for place in range(len(columns))]
    lines = [columns, rule, *rows]
    return "\n".join("| " + " | ".join(_cell(text) for text in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")
