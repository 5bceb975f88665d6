"""Latency to delay against the paper's figures and closed forms; the text form of delays."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtc_cli.errors import UsageError
from rtc_cli.units import latency_to_delay, parse_delays


@pytest.mark.parametrize(
    ("latency_ms", "hz", "rounding", "delay"),
    [
        (108, 50, "nearest", 5),  # arXiv 2512.05964: 108 ms is reported as d = 5 at 20 ms
        (135, 50, "nearest", 7),  # and 135 ms as d = 7
        (108, 50, "ceil", 6),
        (108, 50, "floor", 5),
        (100, 50, "ceil", 5),
        (100, 50, "floor", 5),
        (0, 30, "ceil", 0),
        (1e-3, 30, "ceil", 1),
        (100, 30, "ceil", 3),  # exactly three periods, whatever the last bits of 100 * 30 / 1000
    ],
)
def test_latency_to_delay(latency_ms, hz, rounding, delay):
    assert latency_to_delay(latency_ms, hz, rounding) == delay


@given(st.integers(0, 1000), st.sampled_from([1.0, 30.0, 50.0, 60.0, 333.3]))
def test_whole_periods_are_exact(steps, hz):
    latency_ms = steps * 1000 / hz
    for rounding in ("ceil", "floor", "nearest"):
        assert latency_to_delay(latency_ms, hz, rounding) == steps


@given(st.floats(0, 1e4), st.floats(0.1, 1000))
def test_roundings_are_ordered(latency_ms, hz):
    floor = latency_to_delay(latency_ms, hz, "floor")
    ceil = latency_to_delay(latency_ms, hz, "ceil")
    assert floor <= latency_to_delay(latency_ms, hz, "nearest") <= max(ceil, floor) <= floor + 1


@pytest.mark.parametrize(
    ("latency_ms", "hz", "rounding"),
    [(-1, 30, "ceil"), (math.nan, 30, "ceil"), (1, 0, "ceil"), (1, math.inf, "ceil"), (1, 30, "x")],
)
def test_bad_latencies(latency_ms, hz, rounding):
    with pytest.raises(UsageError):
        latency_to_delay(latency_ms, hz, rounding)


@pytest.mark.parametrize(
    ("text", "delays"),
    [("0", (0,)), ("0-4", (0, 1, 2, 3, 4)), ("0,2-4", (0, 2, 3, 4)), (" 3 , 1-2,1 ", (1, 2, 3))],
)
def test_parse_delays(text, delays):
    assert parse_delays(text) == delays


@pytest.mark.parametrize("text", ["", "x", "4-0", "1,", "-1", "1.5", "1--2", "0-99999", "²"])
def test_bad_delays_name_the_text_and_the_fix(text):
    with pytest.raises(UsageError) as caught:
        parse_delays(text)
    assert text in str(caught.value)
    assert caught.value.hint
