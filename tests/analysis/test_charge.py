"""Charging methods with a profile's latencies."""

import json

import pytest

from rtc_cli.analysis.charge import Charge, read_charges
from rtc_cli.errors import RtcError
from rtc_cli.pipeline.charging import charged_evaluations
from rtc_cli.recipe import load_recipe

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


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "no rows"),
        ([{"sampler": "plain", "flow_steps": 5}], "p95_ms is None"),
        ([ROWS[0] | {"p95_ms": -1.0}], "p95_ms -1.0"),
        ([ROWS[0] | {"p95_ms": float("nan")}], "nan"),
        ([ROWS[0] | {"flow_steps": 0}], "flow_steps 0"),
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
