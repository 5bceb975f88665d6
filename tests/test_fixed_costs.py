"""Costs around the network: numbers, and measured latencies whose distribution is added."""

import itertools

import numpy as np
import pytest
from scipy import stats

from rtc_cli.cli.options import read_fixed_ms
from rtc_cli.errors import RtcError, UsageError
from rtc_cli.fixed_costs import check_costs, percentile_with, say_costs

SAMPLES = [14.0, 15.0, 19.0, 14.5]


def test_numbers_move_every_percentile():
    costs = {"vision": 18.0, "prefill": 44.0}
    for percent in (0, 50, 95):
        assert percentile_with(SAMPLES, costs, percent) == np.percentile(SAMPLES, percent) + 62.0


def test_measured_costs_give_the_percentile_over_all_combinations():
    network, server = (30.0, 31.0, 90.0), (1.0, 1.5, 2.0, 40.0)
    costs = {"network": network, "vision": 18.0, "server": server}
    sums = [sum(each) + 18.0 for each in itertools.product(SAMPLES, network, server)]
    for percent in (5, 50, 95, 99):
        expected = np.percentile(sums, percent)
        assert percentile_with(SAMPLES, costs, percent) == pytest.approx(expected)


def test_long_traces_are_thinned_without_moving_the_tail():
    """Two exponentials of one mean add up to an Erlang law, whose quantiles are known."""
    generator = np.random.default_rng(0)
    one, two = generator.exponential(10.0, (2, 100_000))
    for percent in (50, 95, 99):
        law = stats.erlang(2, scale=10.0).ppf(percent / 100)
        assert percentile_with(one, {"two": tuple(two)}, percent) == pytest.approx(law, rel=0.02)


def test_what_people_are_told():
    assert say_costs({"vision": 18.0, "net": (1.0, 3.0, 50.0)}) == (
        "vision 18 ms + net 3 ms (median of 3)"
    )
    assert say_costs({}) == ""


def test_reading_the_option(tmp_path):
    assert read_fixed_ms("") == {}
    assert read_fixed_ms("62") == {"fixed": 62.0}
    assert read_fixed_ms("vision=18, prefill=44.5") == {"vision": 18.0, "prefill": 44.5}
    trace = tmp_path / "net.csv"
    trace.write_text("net_s\n0.030\n0.031\n0.090\n", "utf-8")
    assert read_fixed_ms(f"vision=18,net={trace}") == {
        "vision": 18.0,
        "net": pytest.approx((30.0, 31.0, 90.0)),
    }


@pytest.mark.parametrize("bad", ["vision=", "x", "-1", "a=nan", "a=1,a=2", "62,38"])
def test_bad_options(bad):
    with pytest.raises(UsageError, match="fixed cost"):
        read_fixed_ms(bad)


def test_bad_files(tmp_path):
    with pytest.raises(RtcError, match=r"missing\.csv"):
        read_fixed_ms(f"net={tmp_path / 'missing.csv'}")
    wide = tmp_path / "wide.csv"
    wide.write_text("a_ms,b_ms\n1,2\n3,4\n", "utf-8")
    with pytest.raises(UsageError, match="2 columns") as refused:
        read_fixed_ms(f"net={wide}")
    assert "one column" in refused.value.hint


@pytest.mark.parametrize("cost", [-1.0, float("nan"), True, "62", [], [1.0, -2.0], [None], None])
def test_costs_that_cannot_be(cost):
    with pytest.raises(UsageError, match="vision"):
        check_costs({"vision": cost})
