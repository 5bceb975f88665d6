"""A grid's combinations: recipes, folders, locks, and one plan for all."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtc_cli.errors import StateError, UsageError
from rtc_cli.pipeline.checks import check_recipe
from rtc_cli.pipeline.grid import combinations, grid_plan, locked, open_runs
from rtc_cli.recipe import differing_keys, load_recipe, recipe_from_dict
from rtc_cli.runs import create_run, open_run

GRID = {"data.experts": [1, 2], "data.policy_std": [0.0, 1.0]}


def recipe(grid=GRID, **more):
    content = {"name": "toy", "tasks": ["catcher"], "ablation": {"grid": grid}} | more
    return recipe_from_dict(content)


def test_combinations_differ_in_their_settings_only():
    parent = recipe()
    found = combinations(parent)
    assert [c.name for c in found] == [
        f"experts-{n}_policy_std-{std}" for n in (1, 2) for std in (0.0, 1.0)
    ]
    assert [(c.recipe.data.experts, c.recipe.data.policy_std) for c in found] == [
        (1, 0.0), (1, 1.0), (2, 0.0), (2, 1.0),
    ]  # fmt: skip
    assert {c.recipe.ablation for c in found} == {None}
    plain = parent.model_copy(update={"ablation": None})
    assert differing_keys(plain, found[2].recipe) == ("data.experts", "data.policy_std")
    assert combinations(load_recipe("quickstart")) == ()


def test_keys_of_the_same_last_name_are_told_apart():
    found = combinations(
        recipe({"train.batch": [64, 128], "network.channels": [8], "horizon": [8]})
    )
    assert found[0].name == "batch-64_channels-8_horizon-8"
    found = combinations(
        recipe({"train.delays.kind": ["uniform", "exponential"], "network.kind": ["mixer"]})
    )
    assert found[1].name == "train.delays.kind-exponential_network.kind-mixer"


def test_dotted_keys_may_be_written_as_sections(tmp_path: Path):
    file = tmp_path / "x.toml"
    file.write_text(
        'tasks = ["catcher"]\n[ablation.grid]\ndata.experts = [1, 2]\nhorizon = [8, 10]\n'
    )
    assert load_recipe(file).ablation.grid == {"data.experts": (1, 2), "horizon": (8, 10)}


BAD = [
    ({"data.experts": []}, ["ablation.grid.data.experts = []", "at least one"]),
    ({"data.experts": 4}, ["ablation.grid.data.experts = 4", "array"]),
    ({"data.experts": [1, 1]}, ["data.experts", "once"]),
    ({"data.experts": [1]}, ["one combination"]),
    ({"experts.seeds": [1, 2]}, ['"experts.seeds"', "share experts"]),
    ({"experts.max_steps": [1, 2]}, ['"experts.max_steps"', "share experts"]),
    ({"tasks": ["a", "b"]}, ['"tasks"', "allowed"]),
    ({"train.seeds": [0, 1]}, ['"train.seeds"', "training seeds"]),
    ({"eval.episodes": [8, 9]}, ['"eval.episodes"', "evaluation"]),
    ({}, ["variants or a grid"]),
]


@pytest.mark.parametrize(("grid", "words"), BAD, ids=lambda value: str(value)[:40])
def test_bad_grids(grid, words):
    with pytest.raises(UsageError) as caught:
        recipe(grid)
    assert all(word in str(caught.value) for word in words), str(caught.value)


BAD_SETTINGS = [
    ({"data.expert": [1, 2]}, ['unknown key "data.expert"', 'mean "experts"']),
    ({"data.experts": [1, 3]}, ["data.experts 3", "2 of experts.seeds"]),
    ({"data.policy_std": [0.5, -1]}, ["data.policy_std = -1"]),
    ({"train.delays": [1, 2]}, ["train.delays", "section"]),
    ({"horizon.x": [1, 2]}, ['"horizon.x"', "value"]),
    ({"network.kind": ["mixer", "mixr"]}, ['"mixr"']),
]


@pytest.mark.parametrize(("grid", "words"), BAD_SETTINGS, ids=lambda value: str(value)[:40])
def test_settings_that_do_not_fit_are_found_before_anything_runs(grid, words):
    with pytest.raises(UsageError) as caught:
        check_recipe(recipe(grid))
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("more", [{"variants": {"a": {}, "b": {}}}, {"baseline": "a"}])
def test_a_grid_has_no_variants(more):
    with pytest.raises(UsageError, match="two kinds of ablation"):
        recipe(ablation={"grid": GRID, **more})


def test_runs_are_created_once_and_share_the_experts(tmp_path: Path):
    parent = create_run(recipe(), tmp_path / "run")
    first = open_runs(parent)
    parent.experts("catcher").mkdir(parents=True)
    (parent.experts("catcher") / "0.json").write_text("{}")
    assert [run.folder.parent for run in first] == [parent.folder / "variants"] * 4
    for run in first:
        assert (run.experts("catcher") / "0.json").read_text() == "{}"
    before = [(run.folder / "manifest.json").stat().st_mtime_ns for run in first]
    more = open_runs(parent.with_seeds([3]))
    assert [run.recipe.train.seeds for run in more] == [(0, 3)] * 4
    assert [(run.folder / "manifest.json").stat().st_mtime_ns for run in more] == before
    # A run that is moved keeps its experts.
    moved = parent.folder.rename(tmp_path / "elsewhere")
    own = open_run(moved / "variants" / first[0].folder.name)
    assert (own.experts("catcher") / "0.json").is_file()


def test_all_runs_are_locked_together(tmp_path: Path):
    parent = create_run(recipe(), tmp_path / "run")
    own = open_runs(parent)
    with locked([*own, parent]):
        for run in (*own, parent):
            with pytest.raises(StateError, match="locked"), run.lock():
                pass
    with own[2].lock(), pytest.raises(StateError, match="locked"), locked([*own, parent]):
        pass
    with locked([*own, parent]):
        pass


def test_one_plan_trains_experts_once_and_everything_else_per_combination(tmp_path: Path):
    parent = create_run(recipe(train={"seeds": [0, 1]}), tmp_path / "run")
    jobs = grid_plan(parent, open_runs(parent))
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    experts = [name for name in names if name.startswith("expert ·")]
    assert experts == [f"expert · catcher · seed {seed}" for seed in (0, 1)]
    assert sum("data · catcher" in name for name in names) == 4 * 2
    done: set[str] = set()
    for job in jobs:
        assert set(job.needs) <= done, job.name  # every need is an earlier job
        done.add(job.name)
    data = next(job for job in jobs if job.name.endswith("data · catcher · seed 1"))
    assert set(data.needs) == set(experts)
    assert data.work.args[0] == parent.folder / "variants" / "experts-1_policy_std-0.0"
