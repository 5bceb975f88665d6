"""The page of an explanation: what guidance does in every denoising step."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtc_cli.report.document import Bullets, Document, Picture, Section, Table
from rtc_cli.report.style import INK, looks, new_figure, tidy
from rtc_cli.report.tables import Row, pick
from rtc_cli.report.writing import ReportPaths, write_document

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEP_COLUMNS = {
    "step": "step",
    "tau": "flow time",
    "weight_unclipped": "weight, not clipped",
    "weight": "weight used",
    "prefix_error_before": "prefix error before",
    "prefix_error_after": "after",
}
SEAM_COLUMNS = {"jump": "jump at the seam", "usual_jump": "usual jump", "gap": "gap to the overlap"}
_STAND_IN = {"plain": "naive"}


def cell(row: Row, key: str) -> str:
    """One figure as text: "inf" where the weight has no bound, "-" where there is none."""
    value = row[key]
    if value is None:
        return "inf" if key == "weight_unclipped" and row["weight"] is not None else "-"
    mark = " (clipped)" if key == "weight" and row["clipped"] else ""
    return (f"{value:.3g}" if isinstance(value, float) else str(value)) + mark


def explain_figure(content: Mapping[str, Any]) -> "Figure":
    """Draw the guidance weight and the prefix error by step, and the jump at the seam."""
    steps, seams = content["steps"], content["seams"]
    names = list(dict.fromkeys(row["sampler"] for row in steps))
    style = dict(zip(names, looks([_STAND_IN.get(n, n) for n in names]).values(), strict=True))
    figure = new_figure(9.4, 3.4)
    weight, error, jump = figure.subplots(1, 3, width_ratios=(1, 1.25, 0.8))
    for name in names:
        rows, look = pick(steps, sampler=name), style[name]
        taus = [row["tau"] for row in rows]
        if rows[0]["weight"] is not None:
            free = [row["weight_unclipped"] for row in rows]
            used = [row["weight"] for row in rows]
            weight.plot(taus, used, marker=look.marker, color=look.colour, label=f"{name}, used")
            open_ = [(tau, g) for tau, g in zip(taus, free, strict=True) if g is not None]
            weight.plot(
                *zip(*open_, strict=True), ":", color=INK, linewidth=1.6, label="not clipped"
            )
        errors = [row["prefix_error_before"] for row in rows] + [rows[-1]["prefix_error_after"]]
        error.plot([*taus, 1.0], errors, marker=look.marker, color=look.colour, label=name)
    bars = [row["jump"] for row in seams]
    jump.bar(range(len(names)), bars, color=[style[name].colour for name in names], width=0.6)
    jump.set_xticks(range(len(names)), names, rotation=20)
    usual = seams[0]["usual_jump"]
    if usual is not None:
        jump.axhline(usual, color=INK, linestyle="--", linewidth=1.1)
    tidy(weight, title="guidance weight", x="flow time")
    tidy(error, title="distance from the committed actions", x="flow time of the step")
    tidy(jump, title="jump at the seam", x="dashed: usual, within a chunk")
    for axes in (weight, error):
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, fontsize=8.5, labelcolor=INK)
    return figure


def save_explain_page(folder: Path, content: Mapping[str, Any]) -> ReportPaths:
    """Write the page of an explanation into a folder."""
    steps: list[Row] = content["steps"]
    drawing = Picture(
        "explain",
        "Guidance weight, prefix error and seam by sampler",
        explain_figure(content),
        "Normalised actions. Middle: how far the denoised estimate's first d tokens are from the "
        "committed actions before each step; the last point is the finished chunk.",
    )
    tables = []
    for name in dict.fromkeys(row["sampler"] for row in steps):
        lines = [[cell(row, key) for key in STEP_COLUMNS] for row in pick(steps, sampler=name)]
        tables.append(Table([*STEP_COLUMNS.values()], lines, name))
    seams = [
        [row["sampler"], *(cell(row, key) for key in SEAM_COLUMNS)] for row in content["seams"]
    ]
    document = Document(
        title="What guidance does, step by step",
        subtitle=f"{content['policy']}; H = {content['horizon']}, s = {content['exec_horizon']}, "
        f"d = {content['delay']}; {content['examples']} hand-overs.",
        question="Does guidance bring the new chunk onto the committed actions, and where not?",
        answer=content["findings"],
        sections=[
            Section("picture", "By step", [drawing]),
            Section("steps", "Steps", tables),
            Section("seams", "Seams", [Table(["sampler", *SEAM_COLUMNS.values()], seams)]),
            Section("how", "How to read it", [Bullets(_READING)]),
        ],
    )
    return write_document(folder, document, dict(content), {})


_READING = [
    "A weight that is clipped in every step, and a prefix error that stays: raise "
    "max_guidance_weight.",
    "Weights not clipped and the error stays: the flow has too few steps to move, or the network "
    "does not follow (the Jacobian is small); try more flow steps, or prior_std.",
    "Prefix error near 0 and a jump above the usual one: the first free tokens do not continue; a "
    "wider mask (exp, linear) or a policy trained with simulated delay helps.",
]
