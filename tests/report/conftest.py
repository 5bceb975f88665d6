"""Made-up runs, shared by the tests of the report."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def synthetic() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "report_synthetic", Path(__file__).with_name("synthetic.py")
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def run_folder(synthetic: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A full made-up run: two tasks, two training seeds, two protocols, the matrix."""
    frames = synthetic.episodes(
        tasks=("catcher", "lunar_lander"),
        seeds=(0, 1),
        methods=synthetic.MORE_METHODS,
        delays=(0, 2, 4),
        n=16,
    )
    return synthetic.write_run(tmp_path_factory.mktemp("run"), frames)


@pytest.fixture
def two_degrees_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give intervals over seeds where a report would not yet: small cases to check by hand."""
    monkeypatch.setattr("rtc_cli.report.tables.FEWEST_DEGREES", 2)
