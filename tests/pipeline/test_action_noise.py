"""Worlds may be noisier or calmer in an evaluation than where the data came from."""

from __future__ import annotations

from rtc_cli.pipeline.evaluation import cells_of, methods_of
from rtc_cli.recipe import load_recipe
from rtc_cli.tasks import get_task

OVERRIDES = ["eval.action_noise=0.0,0.1,0.2", "eval.delays=0,4"]


def test_every_noise_has_cells_of_its_own():
    config = load_recipe("quickstart", OVERRIDES).eval
    plain = load_recipe("quickstart", OVERRIDES[1:]).eval
    cells = cells_of(config, 8, methods_of(config))
    own = cells_of(plain, 8, methods_of(plain))
    assert {cell.action_noise for cell in own} == {None}
    assert len(cells) == 3 * len(own) == len(set(cells))
    noises = [cell.action_noise for cell in cells]
    assert noises == sorted(noises)  # one batch of worlds serves each


def test_only_the_noise_of_the_scene_changes():
    own = get_task("catcher")
    config = load_recipe("quickstart", OVERRIDES).eval
    cells = cells_of(config, 8, methods_of(config))
    scenes = {cell.action_noise: cell.scene(own) for cell in cells}
    assert scenes[own.action_noise].digest == own.digest
    assert len({scene.digest for scene in scenes.values()}) == 3
    assert {scene.name for scene in scenes.values()} == {"catcher"}
