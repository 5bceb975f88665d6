"""`rtc latency` on traces of a known law; cycles against a simulation tick by tick."""

import tomllib

import latency_law
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtc_cli.analysis.advice import LATE_SHARE, recipe_overrides, recipe_snippet
from rtc_cli.analysis.cycles import run_cycles, running_max
from rtc_cli.analysis.findings import advice, findings
from rtc_cli.analysis.latency import analyse
from rtc_cli.analysis.quantiles import needed_for, quantile_interval
from rtc_cli.analysis.stationary import find_drift, find_warm_up
from rtc_cli.autocorrelation import autocorrelation, block_length, integrated_time, ranks
from rtc_cli.errors import UsageError
from rtc_cli.recipe import find_recipe, load_recipe, recipe_from_dict
from rtc_cli.traces import LatencyTrace, to_delays

LEVELS = (0.5, 0.95, 0.99)
HZ = 50.0


def trace_of(values) -> LatencyTrace:
    values = np.asarray(values, dtype=np.float64)
    return LatencyTrace(values, {"latency": values}, "synthetic", "ms")


def words(analysis) -> str:
    return " ".join([*findings(analysis), *advice(analysis)])


# -- the known law ---------------------------------------------------------------------------

LAWS = {
    "clean": {},
    "warm-up": {"warm_up": 20},
    "drift": {"drift": 0.2},
    "warm-up and drift": {"warm_up": 20, "drift": 0.2},
    "falling": {"warm_up": 20, "drift": -0.2},
}


def measure(traces: int, **law) -> dict[str, object]:
    """Coverage, detection and cycles over many traces; the truth is at the slower end."""
    slower = 1 + abs(law.get("drift", 0.0)) / 2
    truth = {level: slower * latency_law.quantile(level) for level in LEVELS}
    covered = dict.fromkeys(LEVELS, 0)
    warm, drifts, own, other = 0, 0, [], []
    for seed in range(traces):
        analysis = analyse(trace_of(latency_law.draw(seed, **law)), hz=HZ)
        warm += analysis.warm_up.rows > 0
        drifts += analysis.drift.found
        for quantile in analysis.quantiles:
            if quantile.level in truth:
                covered[quantile.level] += quantile.low <= truth[quantile.level] <= quantile.high
        plan = analysis.recommendation
        own.append(analysis.with_warm_up.violated)
        held_out = latency_law.draw(10_000 + seed, **law)[law.get("warm_up", 0) :]
        delays = to_delays(held_out, HZ)
        other.append(run_cycles(delays, plan.horizon, plan.exec_horizon).violated)
    return {
        "coverage": {level: count / traces for level, count in covered.items()},
        "warm_up": warm / traces,
        "drift": drifts / traces,
        "violated": (float(np.mean(own)), float(np.max(own))),
        "held_out": (float(np.mean(other)), float(np.max(other))),
    }


def check(found: dict[str, object], name: str, tolerance: float) -> None:
    law = LAWS[name]
    for level, share in found["coverage"].items():
        assert 0.93 - tolerance <= share <= 0.97 + tolerance, (name, level, share)
    if "warm_up" in law:
        assert found["warm_up"] >= 0.99
    else:
        assert found["warm_up"] <= 0.01 + tolerance
    if "drift" in law:
        assert found["drift"] >= 0.99
    else:
        assert found["drift"] <= 0.02 + tolerance
    assert found["violated"][0] <= 0.01
    assert found["held_out"][0] <= 0.01


@pytest.mark.parametrize("name", ["clean", "warm-up and drift"])
def test_the_known_law(name):
    """40 traces: two standard errors of a coverage are 7 points; the full test is slow."""
    check(measure(40, **LAWS[name]), name, tolerance=0.07)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LAWS))
def test_the_known_law_on_a_thousand_traces(name):
    found = measure(1000, **LAWS[name])
    print(f"\n{name}: {found}")
    check(found, name, tolerance=0.0)


def test_the_interval_of_a_quantile_covers_independent_values():
    """Uniform values: the truth of the 0.9 quantile is 0.9, in 1000 series of 100."""
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(1000):
        quantile = quantile_interval(generator.random(100), 0.9)
        inside += quantile.low <= 0.9 <= quantile.high
    assert inside / 1000 == pytest.approx(0.95, abs=0.02)


def test_the_interval_allows_for_autocorrelation():
    """AR(1) with ρ = 0.8: as if independent, the median would be covered in about 50%."""
    inside = 0
    for seed in range(100):
        values = latency_law.draw(seed, correlation=0.8)
        quantile = quantile_interval(values, 0.5)
        assert quantile.effective < 1000
        inside += quantile.low <= latency_law.quantile(0.5) <= quantile.high
    assert inside / 100 >= 0.9


def test_too_few_rows_have_no_upper_end():
    needed = needed_for(0.99)
    assert 0.99**needed <= 0.025 < 0.99 ** (needed - 1)  # all values below the quantile
    values = np.arange(1.0, needed + 2)
    assert np.isfinite(quantile_interval(np.random.default_rng(0).permutation(values), 0.5).high)
    few = np.random.default_rng(0).random(100) * 10 + 50
    assert np.isnan(quantile_interval(few, 0.99).high)
    analysis = analyse(trace_of(few), hz=HZ)
    assert analysis.recommendation.delay == to_delays([few.max()], HZ)[0]
    assert str(needed) in words(analysis)


# -- warm-up and drift -----------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "height"), [(1, 30.0), (3, 10.0), (20, 4.0), (100, 2.0)])
def test_a_warm_up_is_cut_off(rows, height):
    cut = [
        find_warm_up(latency_law.draw(seed, warm_up=rows, height=height)).rows for seed in range(20)
    ]
    assert 0.5 * rows <= np.median(cut) <= 1.3 * rows
    assert min(cut) >= 1


def test_a_warm_up_is_found_on_a_level_that_drifts():
    for drift in (-0.3, 0.3):
        rows = [find_warm_up(latency_law.draw(s, warm_up=20, drift=drift)).rows for s in range(20)]
        assert 10 <= np.median(rows) <= 30


@pytest.mark.parametrize("law", [{}, {"drift": 0.3}, {"drift": -0.3}, {"correlation": 0.9}])
def test_a_series_without_warm_up_seldom_has_one(law):
    found = [find_warm_up(latency_law.draw(seed, **law)).rows > 0 for seed in range(100)]
    assert np.mean(found) <= 0.04


def test_a_compilation_in_the_first_row_is_a_warm_up():
    values = latency_law.draw(0)
    values[0] = 30_000.0
    assert find_warm_up(values).rows == 1


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_drift_is_seldom_found_where_there_is_none(correlation):
    found = [find_drift(latency_law.draw(s, correlation=correlation)).found for s in range(80)]
    assert np.mean(found) <= 0.05


def test_the_interval_of_a_drift_covers_it():
    drifts = [find_drift(latency_law.draw(seed, drift=0.1)) for seed in range(80)]
    assert np.mean([drift.low <= 0.1 <= drift.high for drift in drifts]) >= 0.9
    assert np.mean([drift.found for drift in drifts]) >= 0.99


def test_equal_values_have_neither_warm_up_nor_drift():
    analysis = analyse(trace_of([40.0] * 200), hz=HZ)
    assert analysis.warm_up.rows == 0
    assert not analysis.drift.found
    assert not analysis.bursts.found
    assert analysis.outliers.count == 0
    assert all(quantile.value == 40.0 for quantile in analysis.quantiles)
    assert (analysis.recommendation.exec_horizon, analysis.recommendation.horizon) == (2, 4)
    assert analyse(trace_of([0.0] * 200), hz=HZ).recommendation.delay == 0


# -- autocorrelation -------------------------------------------------------------------------


def test_autocorrelation_of_an_ar1_process():
    """ρ(k) = ρ^k and τ = (1 + ρ) / (1 - ρ)."""
    logs = np.log(latency_law.draw(0, 100_000, correlation=0.6) / latency_law.MEDIAN_MS)
    body = logs[np.abs(logs) < 0.6]
    assert autocorrelation(body, 3) == pytest.approx([1, 0.6, 0.36, 0.216], abs=0.03)
    assert integrated_time(body) == pytest.approx(4.0, rel=0.1)


def test_autocorrelation_is_the_sum_of_products():
    values = np.random.default_rng(0).random(40)
    centred = values - values.mean()
    direct = [(centred[: 40 - k] * centred[k:]).sum() / (centred**2).sum() for k in range(6)]
    assert autocorrelation(values, 5) == pytest.approx(direct)
    assert autocorrelation([2.0, 2.0, 2.0], 4).tolist() == [1, 0, 0, 0, 0]
    assert ranks([3.0, 1.0, 3.0]).tolist() == [1.5, 0.0, 1.5]


def test_the_block_length_of_an_ar1_process():
    """(2ρ / (1 - ρ²))^(2/3) N^(1/3), Politis and White (2004) for AR(1); 1 without correlation."""
    generator, lengths, independent = np.random.default_rng(0), [], []
    for _ in range(40):
        noise = generator.standard_normal(4000)
        independent.append(block_length(noise))
        series = np.zeros(4000)
        for row in range(1, 4000):
            series[row] = 0.5 * series[row - 1] + noise[row]
        lengths.append(block_length(series))
    expected = (2 * 0.5 / (1 - 0.25)) ** (2 / 3) * 4000 ** (1 / 3)
    assert np.median(lengths) == pytest.approx(expected, rel=0.2)
    assert np.median(independent) < 3


def test_bursts_are_found():
    bursty = [analyse(trace_of(latency_law.draw(s, stay=0.6)), hz=HZ).bursts for s in range(20)]
    assert np.mean([bursts.found for bursts in bursty]) >= 0.9
    assert np.mean([bursts.longest_run >= 3 for bursts in bursty]) >= 0.9
    calm = [analyse(trace_of(latency_law.draw(s)), hz=HZ).bursts.found for s in range(30)]
    assert np.mean(calm) <= 0.05


# -- cycles ----------------------------------------------------------------------------------


def tick_by_tick(delays, horizon, exec_horizon):
    """An independent account of §4: one clock, one chunk that acts, one inference in flight."""
    starved = violated = dropped = tick = 0
    begin = 0  # tick of the acting chunk's index 0
    for delay in delays:
        start, steps = tick, max(delay, exec_horizon)
        violated += not (delay <= exec_horizon and steps <= horizon - delay)
        dropped += delay >= horizon
        while tick < start + steps:
            if tick - start == delay and delay < horizon:
                begin = start
            starved += tick - begin >= horizon
            tick += 1
        if steps == delay and delay < horizon:
            begin = start
    return violated, starved, dropped, tick


@settings(max_examples=200, deadline=None)
@given(
    delays=st.lists(st.integers(0, 12), min_size=1, max_size=40),
    horizon=st.integers(1, 12),
    share=st.floats(0, 1),
)
def test_cycles_against_a_clock(delays, horizon, share):
    steps = 1 + int(share * (horizon - 1))
    violated, starved, dropped, ticks = tick_by_tick(delays, horizon, steps)
    cycles = run_cycles(delays, horizon, steps)
    count = len(delays)
    assert cycles.ticks == ticks
    assert cycles.violated * count == pytest.approx(violated)
    assert cycles.dropped * count == pytest.approx(dropped)
    assert cycles.starved * ticks == pytest.approx(starved)


def test_the_running_maximum():
    delays = np.array([1, 5, 2, 2, 2, 2])
    assert running_max(delays, limit=9, last=3).tolist() == [1, 1, 5, 5, 5, 2]
    assert running_max(delays, limit=4, last=3).tolist() == [1, 1, 4, 4, 4, 2]


# -- recommendation --------------------------------------------------------------------------


def test_the_recommendation_is_legal_and_the_smallest():
    plan = analyse(trace_of(latency_law.draw(1)), hz=HZ).recommendation
    assert plan.fits
    assert plan.horizon == plan.exec_horizon + plan.delay
    assert plan.exec_horizon == plan.delay == plan.limit
    assert plan.cycles.violated <= 0.01
    smaller = run_cycles(to_delays(latency_law.draw(1), HZ), plan.horizon - 6, plan.delay - 3)
    assert smaller.violated > 0.005


def test_a_given_horizon_is_kept():
    analysis = analyse(trace_of(latency_law.draw(1)), hz=HZ, horizon=50)
    plan = analysis.recommendation
    assert (plan.horizon, plan.horizon_given, plan.fits) == (50, True, True)
    assert plan.largest_exec_horizon == 50 - plan.delay
    assert f"up to {50 - plan.delay} is legal" in words(analysis)


def test_a_horizon_that_cannot_hold_the_delay_is_said_so():
    analysis = analyse(trace_of(latency_law.draw(1)), hz=HZ, horizon=8)
    plan = analysis.recommendation
    assert not plan.fits
    assert (plan.horizon, plan.exec_horizon, plan.limit) == (8, 4, 4)
    assert plan.cycles.violated > 0.5
    said = words(analysis)
    assert "H = 8 cannot hold" in said
    assert "below 80 ms" in said  # 4 ticks of 20 ms
    assert "take H = 8 ticks or more" in said
    rate = float(said.split("a control rate below ")[1].split(" Hz")[0])
    slower = analyse(trace_of(latency_law.draw(1)), hz=0.99 * rate, horizon=8)
    assert slower.recommendation.fits


@pytest.mark.parametrize(("rounding", "delay"), [("ceil", 6), ("nearest", 5), ("floor", 5)])
def test_the_rounding_is_used_and_stated(rounding, delay):
    analysis = analyse(trace_of([108.0] * 500), hz=HZ, rounding=rounding)
    assert analysis.recommendation.delay == delay
    assert set(analysis.delays.tolist()) == {delay}
    assert f"({rounding})" in words(analysis)


def test_a_running_maximum_is_recommended_where_latency_has_regimes():
    """Long spells at twice the latency: a fixed value has to be that of the slow spell."""
    slow = (np.arange(4000) // 200) % 5 == 4
    noise = np.random.default_rng(0).uniform(-5, 5, 4000)
    analysis = analyse(trace_of(np.where(slow, 170.0, 90.0) + noise), hz=HZ)
    assert analysis.recommendation.estimator == "max-of-last:10"
    assert analysis.recommendation.delay_cond is None
    told = {told.estimator: told for told in analysis.estimators}
    assert told["max-of-last:10"].late <= LATE_SHARE
    assert told["max-of-last:10"].mean < told["percentile:0.95"].mean - 1
    assert analysis.bursts.found


@pytest.mark.parametrize("horizon", [None, 50, 8, 1])
@pytest.mark.parametrize("hz", [2.0, 50.0])
def test_the_recipe_parses_both_ways(hz, horizon):
    analysis = analyse(trace_of(latency_law.draw(1)), hz=hz, horizon=horizon)
    snippet = recipe_snippet(analysis.recommendation, analysis.measured)
    content = tomllib.loads(find_recipe("quickstart").read_text())
    for key, value in tomllib.loads(snippet).items():
        content[key] = {**content.get(key, {}), **value} if isinstance(value, dict) else value
    recipe = recipe_from_dict(content)
    delays = recipe.train.delays
    assert (delays.kind, delays.support[0]) == ("weights", 0)
    assert sum(delays.weights) == pytest.approx(1.0, abs=0.01)
    assert max(recipe.eval.delays) <= analysis.recommendation.limit
    overrides = recipe_overrides(analysis.recommendation, analysis.measured)
    other = load_recipe("quickstart", overrides)
    assert other.train.delays == delays
    assert (other.horizon, other.eval) == (recipe.horizon, recipe.eval)


def test_training_shows_what_the_sampler_is_told():
    plan = analyse(trace_of(latency_law.draw(1)), hz=HZ).recommendation
    weights = dict(zip(plan.support, plan.weights, strict=True))
    assert max(weights, key=weights.get) == plan.delay_cond == 6
    assert weights[6] > 0.8
    assert min(weights.values()) == pytest.approx(0.2 / (plan.limit + 1), abs=1e-4)


@pytest.mark.parametrize("latency_ms", [9e3, 9e13])
def test_a_horizon_beyond_recipes_has_no_snippet(latency_ms):
    analysis = analyse(trace_of([latency_ms, latency_ms + 1] * 20), hz=100)
    assert recipe_snippet(analysis.recommendation, analysis.measured) is None
    assert recipe_overrides(analysis.recommendation, analysis.measured) == ()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"hz": 0.0}, "0.0 Hz"),
        ({"hz": float("nan")}, "nan Hz"),
        ({"hz": 50.0, "horizon": 0}, "horizon 0"),
        ({"hz": 50.0, "percentile": 1.0}, "percentile 1"),
    ],
)
def test_bad_requests(asked, said):
    with pytest.raises(UsageError, match=said):
        analyse(trace_of([90.0, 91.0]), **asked)


def test_two_rows_are_analysed():
    analysis = analyse(trace_of([90.0, 110.0]), hz=HZ)
    assert analysis.recommendation.delay == 6
    said = words(analysis)
    assert "warm-up was not looked for" in said
    assert "Too few rows to tell whether the level drifts" in said
