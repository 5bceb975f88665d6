"""The page of a profile: what it says is what the rows hold."""

import io
import json

import pytest
from rich.console import Console

from rtc_cli.cli.profile import _render
from rtc_cli.report.profile.page import save_profile_page


def row(sampler: str, p50: float, ratio: float) -> dict:
    total = {"total_p50_ms": p50 + 62, "total_p95_ms": p50 + 63}
    return {
        "network": "expert-300m",
        "dtype": "bfloat16",
        "batch": 1,
        "horizon": 50,
        "flow_steps": 5,
        "rounds": 20,
        "sampler": sampler,
        "p50_ms": p50,
        "p95_ms": p50 + 1,
        "p99_ms": p50 + 2,
        "per_step_ms": p50 / 5,
        "ratio_to_plain": ratio,
        "ratio_low": ratio - 0.01,
        "ratio_high": ratio + 0.01,
        "ratio_method": "ratio of medians",
        "compile_s": 3.0,
        "flops": 155e9,
        "bytes": None,
        "memory_bytes": 700_000_000,
        "floor_ms": p50 / 1.25,
        "over_floor": 1.25,
        "floor_bytes": 3_110_000_000,
        "ceiling_bytes_per_s": 1.8e12,
        "ceiling_flops_per_s": 7e14,
        "hz": 50.0,
        "rounding": "ceil",
        "fixed_ms": {"vision": 18.0, "prefill": 44.0},
        **total,
        "delay_at_hz": 4,
        "delay_ceil": 4,
        "delay_floor": 3,
        "delay_nearest": 4,
        "chunk_share": 4 / 50,
        "highest_hz": {str(d): 1000 * d / total["total_p95_ms"] for d in range(1, 26)},
    }


@pytest.fixture(scope="module")
def content() -> dict:
    rows = [row("plain", 14.0, 1.0), row("pinv", 35.0, 2.5), row("prefix", 14.1, 1.01)]
    machine = {"cpu": "a processor", "cores": 2, "jax": "0"}
    return {"schema": 1, "run": None, "machine": machine, "rows": rows}


def test_the_page_holds_the_figures(content, tmp_path):
    paths = save_profile_page(tmp_path, content)
    page = paths.markdown.read_text("utf-8")
    assert "pinv 2.50 (2.49 to 2.51)" in page
    assert "| prefix | 14.1 | 15.1 |" in page
    assert "vision 18 ms + prefill 44 ms" in page
    assert "| RTX 4090, pinv |" in page
    assert "| 97 |" in page  # published: 18 + 44 + 35
    assert json.loads(paths.rows.read_text("utf-8"))["rows"] == content["rows"]
    assert [path.name for path in paths.figures] == ["profile.png"]
    assert paths.html.read_text("utf-8").count("<svg") == 1


def test_small_networks_are_not_set_beside_published_latencies(content, tmp_path):
    rows = [r | {"network": "paper"} for r in content["rows"]]
    page = save_profile_page(tmp_path, content | {"rows": rows}).markdown.read_text("utf-8")
    assert "RTX 4090" not in page


def test_a_measured_fixed_cost_is_drawn_at_its_median(content, tmp_path):
    costs = {"vision": 18.0, "network": [10.0, 44.0, 300.0]}
    rows = [{**row, "fixed_ms": costs} for row in content["rows"]]
    paths = save_profile_page(tmp_path, content | {"rows": rows})
    assert "vision 18 ms + network 44 ms (median of 3)" in paths.markdown.read_text("utf-8")


@pytest.mark.parametrize("slower", [1.0, 300.0, 2000.0])
def test_tables_of_the_terminal_show_every_digit(content, slower):
    long = ("p50_ms", "p95_ms", "p99_ms", "per_step_ms", "floor_ms", "total_p95_ms")
    rows = [{**row, **{key: slower * row[key] for key in long}} for row in content["rows"]]
    rows += [{**rows[0], "sampler": "prefix-per-token"}]
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(*_render(rows, content["machine"]))
    shown = console.export_text()
    assert "prefix-per-token" in shown
    assert "…" not in shown
