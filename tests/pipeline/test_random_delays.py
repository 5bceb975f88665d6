"""Which cells an evaluation with delays that vary has, and under which keys."""

from __future__ import annotations

from typing import Any

import pytest

from rtc_cli.errors import PartialResult, UsageError
from rtc_cli.pipeline import evaluation
from rtc_cli.pipeline.checks import check_evaluation
from rtc_cli.pipeline.evaluation import Cell, cells_of, methods_of, timings_of
from rtc_cli.recipe import EvalConfig, load_recipe

MODELS = 'eval.delay_models=["uniform:0-4", "constant:2", "poisson:2"]'


def config_of(*overrides: str) -> EvalConfig:
    return load_recipe("quickstart", ["eval.protocols=fixed:4", *overrides]).eval


def cells(*overrides: str) -> tuple[Cell, ...]:
    config = config_of(*overrides)
    return cells_of(config, 8, methods_of(config))


def test_every_model_meets_every_estimator_and_method() -> None:
    found = cells(MODELS, "eval.estimators=exact,max-of-last:10")
    methods = {cell.method for cell in found}
    assert len(found) == len(set(found)) == 3 * 2 * len(methods)
    assert {(int(c.geometry.exec_horizon), int(c.geometry.delay)) for c in found} == {(4, 2)}
    shown = {c.timing.model.text for c in found if c.timing is not None}
    assert shown == {"uniform:0-4", "constant:2", "poisson:2 cap 7"}


def test_a_constant_model_is_the_cell_of_that_delay() -> None:
    assert cells('eval.delay_models=["constant:2"]') == cells("eval.delays=2")
    assert all(cell.timing is None for cell in cells("eval.delays=2"))
    # Where nothing can be late, late chunks make no difference; other settings do.
    assert cells("eval.delays=2", "eval.on_late=discard") == cells("eval.delays=2")
    for other in ("eval.on_exceed=clamp", "eval.observation_lag=1", "eval.estimators=constant:1"):
        assert all(cell.timing is not None for cell in cells("eval.delays=2", other))


def test_the_cap_is_the_last_usable_index() -> None:
    (timing,) = timings_of(config_of('eval.delay_models=["uniform:0-20"]'), 8)
    assert timing.model.largest == 7
    capped = config_of('eval.delay_models=["uniform:0-20"]', "eval.delay_cap=12")
    assert timings_of(capped, 8)[0].model.largest == 12


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (['eval.delay_models=["unifrm:0-4"]'], 'unknown delay model "unifrm:0-4"'),
        ([MODELS, "eval.estimators=max-of-last"], 'estimator "max-of-last": "" is not'),
        (
            ['eval.delay_models=["uniform:3-7"]'],
            r'protocol "fixed:4", delay 5: .*counts as its mean in whole steps: uniform:3-7 as 5',
        ),
    ],
)
def test_bad_models_are_refused_before_anything_runs(overrides: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        check_evaluation(config_of(*overrides), 8)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("eval.on_late=drop", "'play' or 'discard'"),
        ("eval.on_exceed=stop", "'play', 'clamp' or 'fail'"),
        ("eval.observation_lag=-1", "observation_lag = -1"),
        ("eval.delay_cap=3", "delay_cap 3 has nothing to cap without delay_models"),
        ('eval.delay_models=["constant:1", "constant:1"]', "each value once"),
    ],
)
def test_bad_settings_are_refused(override: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        config_of(override)


def test_runs_from_before_keep_their_hash() -> None:
    """The keys at their defaults are as if they were not there."""
    recipe = load_recipe("quickstart")
    hashed = recipe.content_hash
    assert load_recipe("quickstart", ["eval.observation_lag=0"]).content_hash == hashed
    assert load_recipe("quickstart", ["eval.estimators=exact"]).content_hash == hashed
    changes = [MODELS, "eval.observation_lag=1", "eval.on_late=discard", "eval.on_exceed=fail"]
    others = {load_recipe("quickstart", [change]).content_hash for change in changes}
    assert len(others | {hashed}) == 5


class Cells:
    """Stands for the run, its store and its worlds: the second cell exceeds what was trained."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def __enter__(self) -> Cells:
        return self

    def __exit__(self, *error: Any) -> None:
        return None

    def evaluate(self, store: Any, checkpoints: Any, cell: Cell, *rest: Any) -> None:
        if cell.method.name == "pinv":
            raise PartialResult("the conditioned delay 3 exceeds 2", "use --on-exceed play")
        self.done.append(cell.method.name)


def test_a_failing_cell_stops_the_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in = Cells()
    stand_in.scene = None  # type: ignore[attr-defined]
    monkeypatch.setattr("rtc_cli.results.ResultStore", lambda folder: None)
    monkeypatch.setattr("rtc_cli.tasks.batch.WorldBatch", lambda *args: stand_in)
    monkeypatch.setattr(evaluation, "_Checkpoints", lambda target: stand_in)
    monkeypatch.setattr(evaluation, "_is_present", lambda *args: False)
    monkeypatch.setattr(evaluation, "_evaluate_cell", stand_in.evaluate)
    content = {"store": None, "episodes": 4, "task": "catcher", "train_seed": 3}
    target: Any = type("T", (), content)
    found = cells('eval.delay_models=["uniform:0-4"]', "eval.methods=naive,pinv,prefix")
    said = r"catcher, training seed 3, pinv, d = 2.*exceeds 2.*the evaluation stops there"
    with pytest.raises(PartialResult, match=said) as why:
        evaluation.evaluate(target, found, lambda *args: None)
    assert stand_in.done == ["naive"]
    assert why.value.hint == "use --on-exceed play"
    assert why.value.exit_code == 5
