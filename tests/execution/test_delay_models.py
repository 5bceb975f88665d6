"""Delay models against their laws, and what cannot be read."""

import math

import numpy as np
import pytest

from rtc_cli.errors import UsageError
from rtc_cli.execution.delay_models import constant, nominal_delay, read_delay_model

MIXTURE = "mixture:0.9*constant:1+0.1*uniform:3-6"
LAWS = {
    "constant:3": {3: 1.0},
    "uniform:0-4": dict.fromkeys(range(5), 0.2),
    "uniform:0,2-3": {0: 1 / 3, 2: 1 / 3, 3: 1 / 3},
    "poisson:1.5": {d: math.exp(-1.5) * 1.5**d / math.factorial(d) for d in range(12)},
    MIXTURE: {1: 0.9, 3: 0.025, 4: 0.025, 5: 0.025, 6: 0.025},
}


@pytest.mark.parametrize("text", LAWS)
def test_draws_follow_the_law(text: str) -> None:
    model, count = read_delay_model(text), 40_000
    draws = model.sequence(np.random.default_rng(1), count)
    assert draws.dtype == np.int64
    assert model.text == text
    for delay in range(int(draws.max()) + 2):
        share = LAWS[text].get(delay, 0.0)
        spread = math.sqrt(share * (1 - share) / count)
        assert abs(np.mean(draws == delay) - share) <= 5 * spread + 1e-6, delay
    assert model.mean == pytest.approx(sum(d * p for d, p in LAWS[text].items()), abs=1e-6)
    assert draws.max() <= model.largest


def test_a_cap_replaces_longer_delays() -> None:
    model = read_delay_model("poisson:3")
    capped = model.capped(4)
    draws = model.sequence(np.random.default_rng(2), 5000)
    assert draws.max() > 4
    np.testing.assert_array_equal(
        capped.sequence(np.random.default_rng(2), 5000), np.minimum(draws, 4)
    )
    assert (capped.text, capped.largest) == ("poisson:3 cap 4", 4)
    assert capped.mean == pytest.approx(np.minimum(draws, 4).mean(), abs=0.1)
    # A cap beyond the longest delay changes nothing, the text included.
    uniform = read_delay_model("uniform:0-4")
    assert uniform.capped(4) == uniform
    assert constant(3).capped(0).sequence(np.random.default_rng(0), 2).tolist() == [0, 0]


def test_models_share_their_random_numbers() -> None:
    """Longer delays where the law is longer, inference by inference: comparisons are paired."""
    short, long = (
        read_delay_model(text).sequence(np.random.default_rng(3), 300)
        for text in ("poisson:1", "poisson:3")
    )
    assert (short <= long).all()


def test_a_sequence_is_a_function_of_the_generator() -> None:
    for text in LAWS:
        twice = [read_delay_model(text).sequence(np.random.default_rng(4), 50) for _ in range(2)]
        np.testing.assert_array_equal(*twice)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (" constant:02 ", "constant:2"),
        ("poisson:1.50", "poisson:1.5"),
        ("uniform:3,0-2", "uniform:0-3"),
        ("mixture: .5 * constant:1 + 0.50*poisson:2.0", "mixture:0.5*constant:1+0.5*poisson:2"),
    ],
)
def test_one_model_has_one_text(text: str, shown: str) -> None:
    model = read_delay_model(text)
    assert model.text == shown
    assert read_delay_model(shown) == model


@pytest.mark.parametrize(
    ("text", "nominal"),
    [("constant:2", 2), ("uniform:0-4", 2), ("uniform:0-3", 2), ("poisson:1.4", 1), (MIXTURE, 1)],
)
def test_nominal_delay_is_the_rounded_mean(text: str, nominal: int) -> None:
    assert nominal_delay(read_delay_model(text)) == nominal


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unifrom:0-4", r'unknown delay model "unifrom:0-4"\. Did you mean "uniform"'),
        ("", 'unknown delay model ""'),
        ("constant:-1", '"-1" is no whole number'),
        ("constant:1.5", '"1.5" is no whole number'),
        ("constant:20000", "20000 is above 10000"),
        ("uniform:4-0", '"4-0" is no list of control steps'),
        ("uniform:", '"" is no list'),
        ("poisson:0", '"0" is no mean above 0 and up to 1000'),
        ("poisson:nan", '"nan" is no mean'),
        ("poisson:1e6", '"1e6" is no mean'),
        ("mixture:0.5*constant:1", "weights sum to 0.5, not to 1"),
        ("mixture:constant:1", '"constant:1" is no weight above 0 times a model'),
        ("mixture:0*constant:1+1*constant:2", r'"0\*constant:1" is no weight above 0'),
        ("mixture:1*mixture:1*constant:1", "a part may be constant, uniform, poisson"),
        ("mixture:0.5*constant:1+0.5*uniform:x", '"x" is no list'),
    ],
)
def test_bad_models_are_named_with_what_is_allowed(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        read_delay_model(text)
    assert text in str(caught.value)
    assert "write" in caught.value.hint
