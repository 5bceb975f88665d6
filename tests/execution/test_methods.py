"""The registry of methods and the cells of protocols."""

import pytest

from rtc_cli.errors import UsageError
from rtc_cli.execution.methods import METHODS, Method, get_method, get_methods, list_methods
from rtc_cli.execution.protocols import protocol_cells


def test_named_methods() -> None:
    triples = {name: (m.checkpoint, m.sampler, m.schedule) for name, m in METHODS.items()}
    assert triples == {
        "sync": ("base", "plain", "sync"),
        "naive": ("base", "plain", "async"),
        "pinv": ("base", "pinv", "async"),
        "pinv-detached": ("base", "pinv-detached", "async"),
        "prefix": ("prefix", "prefix", "async"),
        "oracle": ("base", "plain", "oracle"),
    }


def test_matrix() -> None:
    matrix = [name for name in list_methods() if "+" in name]
    assert len(matrix) == 6
    assert get_method("prefix+pinv") == Method("prefix+pinv", "prefix", "pinv")
    assert [name for name in list_methods() if get_method(name).untrained] == ["base+prefix"]
    chosen = get_methods(["naive", "pinv", "naive"], matrix=True)
    assert [m.name for m in chosen] == ["naive", "pinv", *matrix]


def test_unknown_method() -> None:
    with pytest.raises(UsageError, match=r'unknown method "pinf".*Did you mean "pinv"'):
        get_method("pinf")


def test_with_settings() -> None:
    tuned = get_method("pinv").with_settings(prior_std=0.5, max_guidance_weight=20.0)
    assert tuned.name == "pinv-tuned"
    assert tuned.settings == (("max_guidance_weight", 20.0), ("prior_std", 0.5))
    again = tuned.with_settings("pinv-hard", mask="zeros")
    assert again.name == "pinv-hard"
    assert dict(again.settings) == dict(tuned.settings) | {"mask": "zeros"}


def test_sync_needs_the_plain_sampler() -> None:
    with pytest.raises(UsageError, match='schedule "sync" cannot use sampler "pinv"'):
        Method("x", "base", "pinv", schedule="sync")
    with pytest.raises(UsageError, match=r'unknown checkpoint "bas".*Did you mean "base"'):
        Method("x", "bas", "pinv")


def pairs(protocol: str, horizon: int, delays: range) -> list[tuple[int, int]]:
    cells = protocol_cells(protocol, horizon, delays)
    assert all(cell.horizon == horizon for cell in cells)
    return [(int(cell.exec_horizon), int(cell.delay)) for cell in cells]


def test_protocols() -> None:
    assert pairs("paper", 8, range(5)) == [(1, 0), (1, 1), (2, 2), (3, 3), (4, 4)]
    assert pairs("fixed:4", 8, range(5)) == [(4, d) for d in range(5)]
    assert pairs("grid", 4, range(3)) == [
        (1, 0), (2, 0), (3, 0), (4, 0), (1, 1), (2, 1), (3, 1), (2, 2),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("protocol", "delays", "message"),
    [
        ("paper", [0, 5], 'protocol "paper", delay 5: .*horizon 8'),
        ("paper", [9], 'protocol "paper", delay 9'),
        ("fixed:4", [0, 5], 'protocol "fixed:4", delay 5'),
        ("fixed:9", [0], 'protocol "fixed:9", delay 0'),
        ("fixed:x", [0], "needs an execution horizon"),
        ("fixed", [0], "needs an execution horizon"),
        ("grid", [5], "delay 5 has no legal execution horizon at horizon 8"),
        ("papr", [0], 'unknown protocol "papr".*Did you mean "paper"'),
    ],
)
def test_illegal_cells_are_refused(protocol: str, delays: list[int], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        protocol_cells(protocol, 8, delays)
