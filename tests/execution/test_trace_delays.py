"""Delays from a trace: the trace's own distribution, its bursts, and the same ones every time."""

import re

import numpy as np
import pytest

from rtc_cli.errors import RtcError
from rtc_cli.execution.delay_models import read_delay_model
from rtc_cli.execution.timing import Timing
from rtc_cli.report.selection import condition_label, timing_label


def written(tmp_path, values, name="latencies.csv"):
    path = tmp_path / name
    path.write_text("latency_ms\n" + "\n".join(f"{v:.3f}" for v in values), "utf-8")
    return path


def generator(seed):
    return np.random.Generator(np.random.Philox(seed))


def test_delays_are_those_of_the_rows_at_the_control_rate(tmp_path):
    path = written(tmp_path, [10.0, 20.0, 20.1, 59.9, 60.0, 400.0])
    model = read_delay_model(f"trace:{path}@50")
    assert model.mean == pytest.approx((1 + 1 + 2 + 3 + 3 + 20) / 6)
    assert model.largest == 20
    assert set(model.sequence(generator(0), 500).tolist()) == {1, 2, 3, 20}
    capped = model.capped(7)
    assert capped.largest == 7
    assert set(capped.sequence(generator(0), 500).tolist()) == {1, 2, 3, 7}
    assert capped.text.endswith("cap 7")
    assert capped != model
    assert model.capped(20) is model


def test_a_warm_up_can_be_left_out(tmp_path):
    path = written(tmp_path, [900.0] * 15 + [50.0, 70.0] * 100)
    assert read_delay_model(f"trace:{path}@50").largest == 45
    assert read_delay_model(f"trace:{path}@50,skip=15").largest == 4


def test_bursts_stay(tmp_path):
    """Slow rows come in runs of 20; drawn one by one, runs of 5 or more would be rare."""
    series = np.tile(np.r_[np.full(80, 30.0), np.full(20, 95.0)], 20)
    model = read_delay_model(f"trace:{written(tmp_path, series)}@50")
    drawn = model.sequence(generator(1), 5000)
    assert np.mean(drawn == 5) == pytest.approx(0.2, abs=0.05)
    follows = np.mean(drawn[1:][drawn[:-1] == 5] == 5)
    assert follows > 0.85  # independent draws: 0.2


def test_equal_files_and_generators_give_equal_delays(tmp_path):
    values = generator(2).lognormal(4.0, 0.3, 300)
    one, two = (
        read_delay_model(f"trace:{written(tmp_path, values, name)}@50")
        for name in ("a.csv", "b.csv")
    )
    assert one.content == two.content  # results are keyed by what is in the file
    assert np.array_equal(one.sequence(generator(3), 99), two.sequence(generator(3), 99))
    again = read_delay_model(f"trace:{tmp_path / 'a.csv'}@50")
    assert Timing(one) == Timing(again)
    assert hash(Timing(one)) == hash(Timing(again))
    changed = read_delay_model(f"trace:{written(tmp_path, values + 1, 'a.csv')}@50")
    assert changed.content != one.content
    assert changed.text != one.text


@pytest.mark.parametrize("name", ["robot (1).csv", "a,b@50,skip=3.csv", "x@y.csv", "[b]*|`.csv"])
def test_any_file_name_is_read_and_shown(tmp_path, name):
    path = written(tmp_path, [10.0, 30.0, 50.0], name)
    model = read_delay_model(f"trace:{path}@50,skip=1,rounding=nearest")
    assert model.mean == pytest.approx((2 + 3) / 2)
    assert re.fullmatch(r"trace:[\w.-]+\.csv@50,nearest #[0-9a-f]{6}", model.text)
    label = timing_label(model.text, "max-of-last:10", "play", "clamp", 0)
    assert condition_label("pinv (mask=exp)" + label) == label


def test_other_roundings(tmp_path):
    path = written(tmp_path, [10.0, 29.0, 31.0, 40.0])
    means = {
        how: read_delay_model(f"trace:{path}@50{how}").mean
        for how in ("", ",rounding=ceil", ",rounding=floor", ",rounding=nearest")
    }
    assert list(means.values()) == [7 / 4, 7 / 4, 4 / 4, 6 / 4]
    contents = {read_delay_model(f"trace:{path}@50{how}").content for how in means}
    assert len(contents) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("trace:{path}", "control rate"),
        ("trace:{path}@0", "control rate"),
        ("trace:{path}@50,skip=9", "9 are to be left out"),
        ("trace:{path}.none@50", "none"),
        ("trace:@50", "control rate"),
        ("trace:{path}@50,rounding=up", "options that exist"),
    ],
)
def test_traces_that_cannot_be_used(tmp_path, text, said):
    path = written(tmp_path, [10.0] * 10)
    with pytest.raises(RtcError, match=said):
        read_delay_model(text.format(path=path))
