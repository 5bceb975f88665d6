"""docs/tasks.md is what its script writes, and every built-in task has its picture."""

import importlib.util
from pathlib import Path

import pytest
from PIL import Image

from rtc_cli.tasks import get_task
from rtc_cli.tasks.scene import Status

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("make_gallery", DOCS / "make_gallery.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(gallery):
    written = gallery.PAGE.read_text(encoding="utf-8")
    assert written == gallery.text(), "run: python docs/make_gallery.py"


def test_every_task_has_a_small_picture(gallery):
    pictures = {path.stem: path for path in (DOCS / "tasks").glob("*.png")}
    assert set(pictures) == set(gallery.names()), "run: python docs/make_gallery.py"
    for path in pictures.values():
        assert path.stat().st_size < 60_000, path
        with Image.open(path) as picture:
            assert picture.width > 800


def test_what_is_shown_was_solved(gallery):
    assert gallery.solved_episode(get_task("catcher")).status == Status.SOLVED
