"""Colours, marks and text of figures: one look per method, colour-blind safe, light and dark.

Figures are drawn once in the light palette. Colours of the SVG are then replaced by CSS variables
so that a page can follow the reader's light or dark setting. Matplotlib is imported on first use.
"""

import base64
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, RULE, PAPER = "#1c2024", "#5b636d", "#d8dce1", "#ffffff"


@dataclass(frozen=True)
class Look:
    """How one series is drawn: colour on light, colour on dark, marker (or none) and line."""

    colour: str
    dark: str
    marker: str
    line: str


# After Okabe and Ito (2008); marker and line differ too, so colour is never the only mark.
LOOKS = (
    Look("#0072b2", "#62b6f2", "o", "-"),
    Look("#d55e00", "#ff9350", "s", "-"),
    Look("#009e73", "#3fd0a1", "D", "-"),
    Look("#6e7781", "#a7b0ba", "v", "--"),
    Look("#56b4e9", "#a5d8fa", "o", "--"),
    Look("#cc79a7", "#eba6cb", "P", "-."),
    Look("#b07d00", "#e8b53c", "^", "-"),
    Look("#7b5ea7", "#b79ae0", "X", "--"),
    Look("#878f98", "#929ba5", "", "--"),
)
OLD_CHUNK = LOOKS[3]
_METHOD_LOOKS = {
    "pinv": 0,
    "naive": 1,
    "prefix": 2,
    "sync": 6,
    "pinv-tuned": 4,
    "pinv-detached": 5,
    "oracle": 8,  # a reference, not a contestant
}


@dataclass(frozen=True)
class Fill:
    """How a part of a stacked bar is drawn: colour on light, on dark, and of the text on it."""

    colour: str
    dark: str
    text: str


FILLS = {
    "success": Fill("#2e7d5f", "#5fc79d", PAPER),
    "avoidable": Fill("#c4630f", "#ff9d52", PAPER),
    "irreducible": Fill("#6f5a9a", "#b7a2e0", PAPER),
    "open_loop_cost": Fill("#4f6577", "#9fb4c6", PAPER),
    "rest": Fill("#e9ecef", "#2a3037", INK),
}
CSS_VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    RULE: "--rule",
    PAPER: "--paper",
    **{look.colour: f"--c{place}" for place, look in enumerate(LOOKS)},
    **{fill.colour: f"--f{place}" for place, fill in enumerate(FILLS.values())},
}


def looks(names: Sequence[str]) -> dict[str, Look]:
    """Return the look of each series: fixed for known methods, others take what is left."""
    known = {name: _METHOD_LOOKS[name] for name in names if name in _METHOD_LOOKS}
    free = [place for place in (7, 3, 5, 4, 6, 1, 0, 2) if place not in known.values()]
    others = [name for name in names if name not in known]
    places = known | {name: free[i % len(free)] for i, name in enumerate(others)}
    return {name: LOOKS[places[name]] for name in names}


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure (inches) that belongs to no window and no global state."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.family": ["DejaVu Sans"], "font.size": 10.0}):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
    return figure


def tidy(axes: "Axes", *, title: str = "", x: str = "", y: str = "", grid: str = "y") -> None:
    """Give a panel the common look: no box, light grid, left-aligned title."""
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(RULE)
    axes.patch.set_visible(False)
    axes.tick_params(which="both", colors=MUTED, labelsize=9, length=0)
    if grid:
        axes.grid(True, axis=grid, color=RULE, linewidth=0.8)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    if title:
        axes.set_title(title, loc="left", fontsize=10.5, fontweight="bold", color=INK)
    axes.set_xlabel(x, color=MUTED, fontsize=9.5)
    axes.set_ylabel(y, color=MUTED, fontsize=9.5)


def spread(values: Sequence[float], gap: float) -> list[float]:
    """Return label positions near `values`, in the same order, at least `gap` apart."""
    order = sorted(range(len(values)), key=lambda i: values[i])
    placed: list[float] = []
    for i in order:
        placed.append(max(values[i], placed[-1] + gap) if placed else values[i])
    # Pushing up only would drift; shift the stack so that it is centred on what it labels.
    drift = sum(placed[k] - values[i] for k, i in enumerate(order)) / max(len(order), 1)
    result = [0.0] * len(values)
    for place, i in zip(placed, order, strict=True):
        result[i] = place - drift
    return result


def png(figure: "Figure") -> bytes:
    """Render a figure as PNG on white, 160 dots per inch."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=160, facecolor=PAPER, metadata={"Software": None})
    return stream.getvalue()


def data_url(image: bytes) -> str:
    """Return a PNG as a data URL."""
    return "data:image/png;base64," + base64.b64encode(image).decode("ascii")


def svg(figure: "Figure", name: str, label: str) -> str:
    """Render a figure as an SVG element for a page: themed colours, own ids, no outside address."""
    import matplotlib as mpl

    stream = io.StringIO()
    quiet = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(stream, format="svg", transparent=True, metadata=quiet)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace("url(#", f"url(#{name}-").replace('href="#', f'href="#{name}-')
    text = _theme(text, CSS_VARIABLES)
    text = text.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, system-ui, sans-serif")
    size = re.search(r'width="([\d.]+)pt"', text)
    # The drawing scales with the page but never below a readable size; the page scrolls instead.
    width = f'style="min-width:{float(size[1]) * 1.05:.0f}px"' if size else ""
    text = re.sub(r'(<svg [^>]*?)width="[\d.]+pt"', rf"\1{width}", text, count=1)
    text = re.sub(r'(<svg [^>]*?)height="[\d.]+pt" ', r"\1", text, count=1)
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def _theme(text: str, variables: Mapping[str, str]) -> str:
    for colour, variable in variables.items():
        text = re.sub(re.escape(colour), f"var({variable})", text, flags=re.IGNORECASE)
    return text
