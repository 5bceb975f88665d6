"""Charging methods with a profile's latencies."""

import json

import pytest

from rtc_cli.analysis.charge import Charge, find_latencies, list_latencies, read_charges
from rtc_cli.errors import RtcError
from rtc_cli.pipeline.charging import charged_by, charged_evaluations
from rtc_cli.pipeline.checks import check_recipe
from rtc_cli.recipe import load_recipe, recipe_to_toml

# RTC's table (arXiv 2506.07339, RTX 4090): 14 ms for five plain steps, 35 guided, 62 around them.
ROWS = [
    {"sampler": "plain", "flow_steps": 5, "p95_ms": 14.0, "batch": 1},
    {"sampler": "pinv", "flow_steps": 5, "p95_ms": 35.0},
    {"sampler": "pinv", "flow_steps": 10, "p95_ms": 70.0},
    {"sampler": "pinv", "flow_steps": 10, "p95_ms": 700.0, "batch": 64},
]
SAMPLERS = {"naive": "plain", "sync": "plain", "pinv": "pinv"}


def written(tmp_path, rows):
    path = tmp_path / "profile.json"
    path.write_text(json.dumps({"rows": rows}), "utf-8")
    return path


def test_published_latencies_at_50_hz(tmp_path):
    found = read_charges(written(tmp_path, ROWS), SAMPLERS, fixed_ms={"vlm": 62.0}, hz=50.0)
    assert found == [
        Charge("naive", 5, 76.0, 4),  # 3.8 control steps
        Charge("pinv", 5, 97.0, 5),  # 4.85
        Charge("pinv", 10, 132.0, 7),  # 6.6
        Charge("sync", 5, 76.0, 4),
    ]
    nearest = read_charges(
        written(tmp_path, ROWS), SAMPLERS, fixed_ms={}, hz=50.0, rounding="nearest"
    )
    assert [charge.delay for charge in nearest] == [1, 2, 4, 1]


def test_fixed_costs_of_the_file_are_added_and_not_twice(tmp_path):
    path = written(tmp_path, [ROWS[0] | {"fixed_ms": {"vision": 18.0}}])
    (charge,) = read_charges(path, {"naive": "plain"}, fixed_ms={"prefill": 44.0}, hz=50.0)
    assert charge.latency_ms == 76.0
    with pytest.raises(RtcError, match="vision"):
        read_charges(path, {"naive": "plain"}, fixed_ms={"vision": 18.0}, hz=50.0)


def test_a_measured_fixed_cost_charges_the_percentile_of_the_sum(tmp_path):
    network = (10.0,) * 90 + (50.0,) * 10
    path = written(tmp_path, [ROWS[0] | {"samples_ms": [14.0] * 10}, ROWS[1]])
    found = read_charges(path, {"naive": "plain"}, fixed_ms={"network": network}, hz=50.0)
    assert [charge.latency_ms for charge in found] == [64.0]
    # Without samples the network counts with its p95, here 35 ms.
    (guided,) = read_charges(path, {"pinv": "pinv"}, fixed_ms={"network": network}, hz=50.0)
    assert (guided.latency_ms, guided.delay) == (85.0, 5)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "no rows"),
        ([{"sampler": "plain", "flow_steps": 5}], "p95_ms is None"),
        ([ROWS[0] | {"p95_ms": -1.0}], "p95_ms -1.0"),
        ([ROWS[0] | {"p95_ms": float("nan")}], "nan"),
        ([ROWS[0] | {"flow_steps": 0}], "flow_steps 0"),
        ([ROWS[0] | {"fixed_ms": {"vlm": [1.0, -2.0]}}], "vlm is -2.0 ms"),
        ([3], "no object"),
        ([ROWS[1]], 'no latency of sampler "plain"'),
        ([ROWS[0], ROWS[0]], "several latencies of naive with 5"),
    ],
)
def test_profiles_that_cannot_be_used(tmp_path, rows, said):
    with pytest.raises(RtcError, match=said):
        read_charges(written(tmp_path, rows), {"naive": "plain"}, fixed_ms={}, hz=50.0)


def test_each_charge_is_an_evaluation_of_its_own_and_what_is_too_slow_is_none():
    config = load_recipe("quickstart", ["eval.protocols=fixed:4"]).eval
    charges = [Charge("naive", 5, 76.0, 4), Charge("pinv", 10, 132.0, 7)]
    possible, late = charged_evaluations(config, 8, charges)
    assert possible.config is not None
    assert possible.config.methods == ("naive",)
    assert (possible.config.flow_steps, possible.config.delays) == (5, (4,))
    assert late.config is None
    assert "7" in late.reason


def test_published_latencies_have_names():
    assert "rtx-4090" in list_latencies()
    with pytest.raises(RtcError, match='Did you mean "rtx-4090"'):
        find_latencies("rtx-4080")


def test_a_recipe_names_the_latencies_and_its_methods_are_charged():
    """RTC's table: 62 ms around the network; 14 and 35 ms for five steps, in proportion."""
    recipe = load_recipe("equal_hardware")
    check_recipe(recipe)
    found = {(c.charge.method, c.charge.flow_steps): c for c in charged_by(recipe.eval, 8)}
    expected = {("naive", 5): 76.0, ("pinv", 5): 97.0, ("prefix", 2): 67.6, ("pinv", 10): 132.0}
    for key, latency in expected.items():
        assert found[key].charge.latency_ms == pytest.approx(latency)
        assert found[key].charge.delay == int(-(-latency // (1000 / 30)))  # ceil
    assert load_recipe("standard").eval.charge is None
    assert charged_by(load_recipe("standard").eval, 8) == []


def test_what_is_charged_enters_the_hash_and_survives_writing(tmp_path):
    path = tmp_path / "recipe.toml"
    changes = ["eval.charge.fixed_ms.net=[1.0,2.5]", "eval.charge.fixed_ms.vision=18"]
    recipe = load_recipe("equal_hardware", changes)
    path.write_text(recipe_to_toml(recipe), "utf-8")
    assert load_recipe(path) == recipe
    assert recipe.content_hash != load_recipe("equal_hardware").content_hash


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("eval.charge.profile=rtx-5000", 'no latencies "rtx-5000"'),
        ("eval.charge.hz=0", "greater than 0"),
        ("eval.charge.fixed_ms.net=-1", "net"),
        ("eval.charge.fixed_ms.net=[]", "net"),
        ("eval.methods=naive,pinv-detached", "no latency of sampler"),
    ],
)
def test_a_charge_that_cannot_be_is_refused_before_anything_is_computed(change, said):
    with pytest.raises(RtcError, match=said):
        check_recipe(load_recipe("equal_hardware", [change]))
