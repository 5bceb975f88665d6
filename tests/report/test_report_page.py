"""The pages: nothing from outside, every number found again, and honest about what is missing."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType

import pytest

from rtc_cli.errors import StateError
from rtc_cli.report.figures import success_figure
from rtc_cli.report.page import ReportPaths, build_ablation_report, build_report
from rtc_cli.report.tables import pick
from rtc_cli.report.terminal import render_report
from rtc_cli.report.text import answer

VOID = {"meta", "br", "hr", "img", "link", "input"}


class Page(HTMLParser):
    """Collects ids, references and text, and checks that tags are balanced."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.targets: list[str] = []
        self.tags: set[str] = set()
        self.open: list[str] = []
        self.balanced = True
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self._attributes(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self._attributes(attrs)

    def handle_endtag(self, tag: str) -> None:
        self.balanced &= bool(self.open) and self.open.pop() == tag

    def _attributes(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in ("href", "xlink:href", "src", "srcset", "data", "action"):
                self.targets.append(str(value))


@pytest.fixture(scope="module")
def report(run_folder: Path) -> ReportPaths:
    return build_report(run_folder)


def test_the_page_needs_nothing_from_outside(report: ReportPaths) -> None:
    text = report.html.read_text()
    page = Page(text)
    assert page.balanced
    assert not page.open
    assert not page.tags & {"script", "link", "iframe", "img", "object"}
    assert "http:" not in text
    assert "https:" not in text
    assert all(re.match(r"#|data:", target) for target in page.targets)
    assert {target[1:] for target in page.targets if target[0] == "#"} <= set(page.ids)
    assert not re.search(r"@import|url\((?!#)", text)
    assert len(page.ids) == len(set(page.ids))


def test_the_answer_is_computed_from_the_rows(report: ReportPaths) -> None:
    fall = pick(report.data["naive_fall"], task="all", protocol="paper")[0]
    text = report.markdown.read_text()
    assert f"Naive execution solves {100 * fall['success_at_zero']:.1f}%" in text
    assert f"and {100 * fall['success_at_delay']:.1f}% at a delay of 4" in text
    assert "2 training seeds" in text


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.02, 0.18, "so prefix is better"),
        (-0.18, -0.02, "so prefix is worse"),
        (-0.05, 0.2, "does not tell them apart"),
    ],
)
def test_the_answer_does_not_say_more_than_the_interval(
    report: ReportPaths, low: float, high: float, words: str
) -> None:
    gap = {
        "task": "all", "delay": 4, "exec_horizon": 4, "method": "prefix", "baseline": "pinv",
        "difference": (low + high) / 2, "low": low, "high": high, "seeds": 5,
        "interval": "seeds", "flow_steps": 5,
    }  # fmt: skip
    sentences = answer(report.data["rows"], [gap], report.data["naive_fall"])
    assert words in sentences[-1]
    alone = answer(
        report.data["rows"],
        [gap | {"seeds": 1, "interval": "checkpoints"}],
        report.data["naive_fall"],
    )
    assert "for these checkpoints (one training seed)" in alone[-1]


def test_every_number_of_the_main_table_is_traceable(report: ReportPaths, run_folder: Path) -> None:
    text = report.markdown.read_text()
    table = text[text.index("| method | d=0 s=1") :].split("\n\n")[0].splitlines()
    cells = json.loads(report.rows.read_text())["cells"]
    for line in table[2:]:
        method, *numbers = [part.strip() for part in line.strip("|").split("|")]
        for (delay, s), number in zip([(0, 1), (2, 2), (4, 4)], numbers, strict=True):
            mine = pick(cells, method=method, delay=delay, exec_horizon=s)
            rates = []
            for task in ("catcher", "lunar_lander"):
                of_task = pick(mine, task=task)
                solved = sum(cell["solved"] for cell in of_task)
                rates.append(solved / sum(cell["episodes"] for cell in of_task))
            assert number.startswith(f"{100 * sum(rates) / 2:.1f} ")
            keys = [key for cell in mine for key in cell["cells"]]
            files = run_folder / "results" / "episodes"
            assert keys
            assert all(list(files.glob(f"{key}.*.parquet")) for key in keys)


def test_the_printed_line_of_pandas_gives_the_printed_number(
    report: ReportPaths, run_folder: Path
) -> None:
    text = report.markdown.read_text()
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    value = re.search(r"prints \*\*([\d.]+)\*\*", text)
    assert code is not None
    assert value is not None
    done = subprocess.run(
        [sys.executable, "-c", code[1]], cwd=run_folder, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == value[1]


def test_markdown_tables_have_one_shape_and_figures_exist(report: ReportPaths) -> None:
    blocks = re.findall(r"(?:^\|.*\|\n)+", report.markdown.read_text(), re.MULTILINE)
    assert len(blocks) > 10
    for block in blocks:
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(widths) == 1
    names = re.findall(r"\]\((figures/[^)]+)\)", report.markdown.read_text())
    assert {report.markdown.parent / name for name in names} == set(report.figures)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in report.figures)


def test_missing_parts_are_stated(synthetic: ModuleType, tmp_path: Path) -> None:
    frames = synthetic.episodes(
        tasks=("catcher",), seeds=(0,), n=8, protocols=("paper",), delays=(0, 4)
    )
    report = build_report(synthetic.write_run(tmp_path, frames, extras=False))
    text = report.markdown.read_text()
    for words in (
        "No profile yet", "No training curves", "No expert records", "One training seed only",
        "D90 needs one s", "The matrix was not evaluated",
    ):  # fmt: skip
        assert words in text


def test_a_single_method_is_still_reported(synthetic: ModuleType, tmp_path: Path) -> None:
    frames = [synthetic.cell("prefix", "catcher", 0, "grid", 2, s, [True] * 4) for s in (2, 3)]
    text = build_report(synthetic.write_run(tmp_path, frames, extras=False)).markdown.read_text()
    assert "prefix and pinv were not both evaluated" in text


def test_an_empty_run_and_a_missing_run_are_state_errors(tmp_path: Path) -> None:
    with pytest.raises(StateError, match="no evaluated episodes"):
        build_report(tmp_path)
    with pytest.raises(StateError, match="does not exist"):
        build_report(tmp_path / "nowhere")


def test_a_damaged_profile_is_named(synthetic: ModuleType, tmp_path: Path) -> None:
    frame = synthetic.cell("naive", "catcher", 0, "paper", 0, 1, [True])
    folder = synthetic.write_run(tmp_path, [frame])
    (folder / "results" / "profile.json").write_text("{")
    with pytest.raises(StateError, match=r"profile\.json"):
        build_report(folder)


def test_the_ablation_report(synthetic: ModuleType, tmp_path: Path) -> None:
    for number, variant in enumerate(("exponential", "uniform")):
        frames = synthetic.episodes(
            tasks=("catcher",), seeds=(0, 1), n=8, protocols=("paper",), delays=(0, 4),
            methods={"prefix": ("prefix", "prefix", "async")}, variant=number,
        )  # fmt: skip
        synthetic.write_run(tmp_path, frames, extras=False, store=variant)
    report = build_ablation_report(tmp_path, baseline="uniform")
    assert "`exponential` against `uniform` at delay 4" in report.markdown.read_text()
    assert [path.name for path in report.figures] == ["ablation-paper.png"]
    assert render_report(report.data)


def test_the_report_imports_neither_jax_nor_pymunk(run_folder: Path) -> None:
    code = (
        "import sys, rtc_cli.report.page as page\n"
        "import rtc_cli.report.sections\n"
        "print(sorted({'jax', 'pymunk', 'matplotlib.pyplot'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env=dict(os.environ),
    )  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_levels_go_by_their_short_names(report: ReportPaths) -> None:
    rows = [
        row | {"task": row["task"].replace("catcher", "kinetix-x")} for row in report.data["rows"]
    ]
    figure = success_figure(rows, rows[0]["protocol"])
    assert "kinetix-x" in [axes.get_title(loc="left") for axes in figure.axes]
