"""A report document as one HTML page that needs nothing else: inline style, inline figures."""

import re
from collections.abc import Sequence
from html import escape

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
from rtc_cli.report.style import CSS_VARIABLES, FILLS, LOOKS, svg


def render_html(document: Document) -> str:
    """Return the document as a self-contained page, readable in light and dark and on a phone."""
    answer = "".join(f"<p>{_inline(sentence)}</p>" for sentence in document.answer)
    links = "".join(
        f'<a href="#{section.key}">{escape(section.title)}</a>' for section in document.sections
    )
    body = "".join(
        f'<section id="{section.key}"><h2>{escape(section.title)}</h2>'
        f"{_blocks(section.blocks)}</section>\n"
        for section in document.sections
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(document.title)}</title>\n<style>{_style()}</style>\n</head>\n"
        f"<body>\n<header><h1>{escape(document.title)}</h1>"
        f'<p class="sub">{_inline(document.subtitle)}</p>'
        f'<div class="answer"><p class="question">{_inline(document.question)}</p>{answer}</div>'
        f'<nav aria-label="Sections">{links}</nav></header>\n<main>\n{body}</main>\n'
        "</body>\n</html>\n"
    )


def _blocks(blocks: Sequence[Block]) -> str:
    return "\n".join(_block(block) for block in blocks)


def _block(block: Block) -> str:
    match block:
        case Paragraph(text):
            return f"<p>{_inline(text)}</p>"
        case Note(text):
            return f'<p class="note">{_inline(text)}</p>'
        case Bullets(items):
            return "<ul>" + "".join(f"<li>{_inline(item)}</li>" for item in items) + "</ul>"
        case Definitions(items):
            pairs = (f"<dt>{_inline(term)}</dt><dd>{_inline(text)}</dd>" for term, text in items)
            return "<dl>" + "".join(pairs) + "</dl>"
        case Table():
            return _table(block)
        case Picture(name, label, figure, caption):
            text = f"<figcaption>{_inline(caption)}</figcaption>" if caption else ""
            drawing = svg(figure, name, escape(label, quote=True))
            return f'<figure><div class="scroll">{drawing}</div>{text}</figure>'
        case Code(text, _):
            return f"<pre><code>{escape(text)}</code></pre>"
        case Fold(title, blocks):
            return f"<details><summary>{_inline(title)}</summary>{_blocks(blocks)}</details>"


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{_inline(name)}</th>' for name in table.columns)
    lines = "".join(f"<tr>{_cells(row, table.left)}</tr>" for row in table.rows)
    caption = f'<p class="caption">{_inline(table.caption)}</p>' if table.caption else ""
    return (
        f'<div class="scroll"><table class="names{table.left}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>{caption}"
    )


def _cells(row: Sequence[str], left: int) -> str:
    cells = []
    for place, text in enumerate(row):
        # An interval behind a value is secondary: smaller, on its own line where space is short.
        inner = re.sub(r" (\([^()]*\))(\**)$", r"\2 <small>\1</small>", _inline(str(text)))
        tag = 'th scope="row"' if place == 0 else f"td{' class=name' if place < left else ''}"
        cells.append(f"<{tag}>{inner}</{tag.split()[0]}>")
    return "".join(cells)


def _inline(text: str) -> str:
    safe = escape(text, quote=False)
    safe = re.sub(r"`([^`]+)`", r"<code>\1</code>", safe)
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)


def _style() -> str:
    places = {look.colour: look.dark for look in LOOKS}
    places |= {fill.colour: fill.dark for fill in FILLS.values()}
    dark = {"--ink": "#e6e8eb", "--muted": "#a3abb5", "--rule": "#353b43", "--paper": "#16191d"}
    light_lines = "".join(f"{name}:{colour};" for colour, name in CSS_VARIABLES.items())
    dark_lines = "".join(
        f"{name}:{dark.get(name) or places[colour]};" for colour, name in CSS_VARIABLES.items()
    )
    light_lines += "--shade:#f4f6f8;--link:#0b5fa5;"
    dark_lines += "--shade:#1f242a;--link:#7dbcf5;"
    return (
        f":root{{{light_lines}}}\n"
        f"@media (prefers-color-scheme:dark){{:root{{{dark_lines}}}}}\n{_RULES}"
    )


_RULES = """
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);line-height:1.55;
 font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
header,main{max-width:60rem;margin:0 auto;padding:0 1.1rem}
h1{font-size:1.7rem;line-height:1.25;margin:2.2rem 0 .3rem}
h2{font-size:1.25rem;margin:0 0 .7rem}
p,ul,dl{margin:.6rem 0;max-width:46rem}
.sub,.caption,figcaption,.note{color:var(--muted);font-size:.9rem}
.caption,figcaption{margin:.4rem 0 1rem;max-width:46rem}
.answer{background:var(--shade);border-left:4px solid var(--c0);border-radius:4px;
 padding:.5rem 1.1rem;margin:1.2rem 0}
.answer p{max-width:none}
.question{font-weight:600}
.note{border-left:3px solid var(--rule);padding-left:.8rem}
nav{display:flex;flex-wrap:wrap;gap:.2rem 1rem;font-size:.9rem;margin:1rem 0}
a{color:var(--link);text-decoration:none}
a:hover{text-decoration:underline}
section{border-top:1px solid var(--rule);padding:1.5rem 0 1rem}
figure{margin:1rem 0}
figure svg{display:block;width:100%;max-width:52rem;height:auto}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:.92rem;font-variant-numeric:tabular-nums;margin:.6rem 0}
th,td{padding:.32rem .8rem .32rem 0;text-align:right;vertical-align:top;white-space:nowrap}
th:first-child,td.name,.names2 th:nth-child(2),.names3 th:nth-child(-n+3),
.names4 th:nth-child(-n+4),.names5 th:nth-child(-n+5),.names6 th:nth-child(-n+6){text-align:left}
thead th{border-bottom:2px solid var(--rule);color:var(--muted);font-weight:600}
tbody tr+tr>*{border-top:1px solid var(--rule)}
tbody th{font-weight:600}
small{color:var(--muted);font-weight:400;display:block;font-size:.82em}
dt{font-weight:600;margin-top:.6rem}
dd{margin:0 0 0 1.1rem}
code{font:.88em ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace}
pre{background:var(--shade);padding:.8rem 1rem;border-radius:4px;overflow-x:auto}
details{margin:.8rem 0}
summary{cursor:pointer;color:var(--link)}
@media print{nav{display:none}}
"""
