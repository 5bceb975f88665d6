"""Recipes: the shipped ones, overrides, the hash, and every kind of bad input."""

from pathlib import Path

import pytest
from level_files import hover, write_level

from rtc_cli.errors import UsageError
from rtc_cli.recipe import (
    EvalConfig,
    Recipe,
    differing_keys,
    find_recipe,
    list_recipes,
    load_recipe,
    recipe_to_toml,
)

LEVELS = (
    *("car_launch", "cartpole_thrust", "catapult", "catcher_v3", "chain_lander", "grasp_easy"),
    *("h17_unicycle", "hard_lunar_lander", "mjc_half_cheetah", "mjc_swimmer", "mjc_walker"),
    "trampoline",
)


def load_shipped(name: str, levels: Path) -> Recipe:
    """A shipped recipe; `levels` is for the one whose levels are not shipped."""
    return load_recipe(name, [f"levels={levels}"] if name == "kinetix" else [])


@pytest.mark.parametrize("name", list_recipes())
def test_shipped_recipe_loads_has_a_header_and_survives_writing(name, tmp_path):
    recipe = load_shipped(name, tmp_path)
    header = find_recipe(name).read_text().split("\n\n")[0]
    assert all(word in header for word in ("What it is", "Command", "Cost", "Expect"))
    file = tmp_path / "resolved.toml"
    file.write_text(recipe_to_toml(recipe))
    assert load_recipe(file) == recipe


@pytest.mark.parametrize("name", list_recipes())
def test_shipped_recipe_names_things_that_exist(name, tmp_path):
    from rtc_cli.pipeline.checks import check_recipe

    for level in LEVELS:
        write_level(tmp_path, hover(), level)
    check_recipe(load_shipped(name, tmp_path))  # tasks, samplers, methods


def test_the_expected_recipes_are_shipped():
    names = {"quickstart", "standard", "kinetix", "paper", "ablations/delay_distribution"}
    assert names <= set(list_recipes())


def test_paper_is_the_papers():
    recipe = load_recipe("paper")
    assert recipe.network.model_dump(exclude_none=True) == {
        "kind": "mixer",
        "layers": 4,
        "channels": 256,
        "channel_hidden": 512,
        "token_hidden": 64,
    }
    train = recipe.train
    assert (recipe.horizon, train.batch, train.epochs, train.prefix_fraction) == (8, 512, 32, 0.25)
    assert (train.learning_rate, train.weight_decay, train.grad_clip) == (3e-4, 1e-2, 10.0)
    assert (train.warmup_steps, train.decay) == (1000, "constant")
    assert train.delays.model_dump(include={"kind", "support", "rate"}) == {
        "kind": "exponential",
        "support": (0, 1, 2, 3, 4),
        "rate": 1.0,
    }
    assert (recipe.data.transitions, recipe.experts.min_success) == (1_000_000, 0.65)
    assert (recipe.eval.episodes, recipe.eval.flow_steps) == (2048, 5)
    assert recipe.eval.pinv.model_dump() == {
        "mask": "exp",
        "max_guidance_weight": 5.0,
        "prior_std": 1.0,
    }


def test_kinetix_is_the_papers_twelve_levels_wherever_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recipe = load_recipe("kinetix", ["levels=some/where"])
    assert recipe.tasks == tuple(f"kinetix:{tmp_path}/some/where/{name}.json" for name in LEVELS)
    assert recipe == load_recipe("kinetix", [f"levels={tmp_path}/some/where"])


@pytest.mark.parametrize("overrides", [[], ["levels="], ["levels=none"], ["levels=3"]])
def test_recipes_of_levels_say_that_they_need_a_folder(overrides: list[str]) -> None:
    with pytest.raises(UsageError, match="level files, which are not part of rtc") as caught:
        load_recipe("kinetix", overrides)
    assert "--levels FOLDER" in caught.value.hint


def test_a_folder_of_levels_is_refused_where_nothing_asks_for_it() -> None:
    for overrides in (["levels=x"], ["levels=x", "tasks=kinetix:x/one.json"]):
        with pytest.raises(UsageError, match=r'levels = "x", but no task .* holds "{levels}"'):
            load_recipe("quickstart", overrides)


def test_overrides_take_numbers_words_lists_and_ranges():
    recipe = load_recipe(
        "quickstart",
        [
            "train.epochs=8",
            "train.delays.kind=uniform",
            "eval.methods=naive,pinv",
            "eval.delays=0,2-4",
            "train.seeds=3",
            "eval.matrix=true",
            "eval.tune.episodes=16",
            "train.learning_rate=1",
            'description="a = b"',
        ],
    )
    assert recipe.train.epochs == 8
    assert recipe.train.delays.kind == "uniform"
    assert recipe.eval.methods == ("naive", "pinv")
    assert recipe.eval.delays == (0, 2, 3, 4)
    assert recipe.train.seeds == (3,)
    assert recipe.eval.matrix is True
    assert recipe.eval.tune is not None
    assert recipe.eval.tune.episodes == 16
    assert isinstance(recipe.train.learning_rate, float)
    assert recipe.description == "a = b"


def test_none_removes_an_optional_section():
    assert load_recipe("standard", ["eval.tune=none"]).eval.tune is None


def test_hash_ignores_formatting_name_and_description(tmp_path):
    (tmp_path / "a.toml").write_text('tasks = ["x"]\n[train]\nlearning_rate = 1e-3\nepochs = 3\n')
    (tmp_path / "b.toml").write_text(
        '# a comment\nname="other"\ndescription="d"\ntrain.epochs = 3\n'.replace(
            "train.epochs = 3\n", 'tasks = [\n "x",\n]\ntrain = {epochs = 3, learning_rate=0.001}\n'
        )
    )
    first, second = load_recipe(tmp_path / "a.toml"), load_recipe(tmp_path / "b.toml")
    assert first.content_hash == second.content_hash
    assert (first.name, second.name) == ("a", "other")
    assert differing_keys(first, second) == ()


def test_hash_sees_every_value():
    base = load_recipe("quickstart")
    for override in ("train.epochs=22", "eval.episodes=513", "horizon=9", "experts.seeds=0"):
        other = load_recipe("quickstart", [override])
        assert other.content_hash != base.content_hash
        assert differing_keys(base, other) == (override.partition("=")[0],)
    assert base.hash_of("train") == load_recipe("quickstart", ["horizon=9"]).hash_of("train")


def test_keys_that_came_later_leave_the_hash_at_their_defaults_as_it_was() -> None:
    recipe = Recipe(name="x", tasks=("catcher",))
    # Computed before there were eval.also and the experts' rewards: commit abb348f.
    assert recipe.hash_of("experts").startswith("b9992be5469b4e47")
    assert recipe.hash_of("eval").startswith("850109bc2794cd59")
    own = load_recipe("quickstart").content_hash
    for same in ("experts.progress_scale=none", "experts.solved_reward=1.0", "eval.also=[]"):
        assert load_recipe("quickstart", [same]).content_hash == own
    changes = ["experts.progress_scale=0.3", "experts.by_task.cartpole_thrust.entropy=0.01"]
    changes += ["eval.also=[{flow_steps=1}]", "eval.also=[{flow_steps=2}]"]
    others = {load_recipe("quickstart", [change]).content_hash for change in changes}
    assert len(others - {own}) == len(changes)


def test_further_evaluations_differ_where_they_say_so_and_nowhere_else() -> None:
    entries = "{flow_steps = 1, delays = [0, 4]}, {protocols = ['grid'], methods = ['prefix']}"
    overrides = ["eval.seed=7", f"eval.also=[{entries}]", "eval.tune.episodes=16"]
    config = load_recipe("quickstart", overrides).eval
    one, other = config.further
    plain = config.model_copy(update={"tune": None, "also": ()})
    assert one == plain.model_copy(update={"flow_steps": 1, "delays": (0, 4)})
    assert other == plain.model_copy(update={"protocols": ("grid",), "methods": ("prefix",)})
    assert EvalConfig().further == ()


def test_experts_of_a_task_differ_where_it_says_so() -> None:
    overrides = ["tasks=catcher,grasp", "experts.gamma=0.9", "experts.by_task.grasp.entropy=0.01"]
    experts = load_recipe("quickstart", overrides).experts
    plain = experts.model_copy(update={"by_task": {}})
    assert experts.of("catcher").model_copy(update={"by_task": {}}) == plain
    assert experts.of("grasp") == plain.model_copy(update={"entropy": 0.01})


def test_recipes_are_frozen():
    recipe = Recipe(name="x", tasks=("a",))
    with pytest.raises(ValueError, match="frozen"):
        recipe.horizon = 9


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("train.epohcs=8", ["train.epohcs", 'Did you mean "epochs"?', "weight_decay"]),
        ("trian.epochs=8", ["trian", 'Did you mean "train"?']),
        ("train.epochs=0", ["train.epochs = 0", "greater than or equal to 1"]),
        ("train.epochs=many", ['train.epochs = "many"', "integer"]),
        ("train.epochs=1.5", ["train.epochs = 1.5", "integer"]),
        ("train=3", ["train = 3"]),
        ("train.epochs.x=3", ['"train.epochs" is a value']),
        ("foo", ['"foo"']),
        ("=3", ['"=3"']),
        ("eval.delays=4-0", ["4-0", "backwards"]),
        ("eval.delays=3,1", ["eval.delays", "increasing"]),
        ("eval.matrix=1", ["eval.matrix = 1", "boolean"]),
        ("eval.protocols=fixed", ['"fixed"', "fixed:S"]),
        ("train.delays.kind=expo", ["expo", "'exponential'"]),
        ("train.delays.support=1-3", ["contain 0"]),
        ("train.delays.kind=constant", ["needs value"]),
        ("train.delays.kind=weights", ["needs 5 weights"]),
        ("train.learning_rate=nan", ["finite"]),
        ("horizon=4", ["train.delays.support reaches 4", "horizon 4"]),
        ("tasks=[]", ["tasks"]),
        ("tasks=a,a", ["once"]),
        ("experts.min_success=0.9", ["min_success 0.9", "target_success 0.8"]),
        ("name=a/b", ["name"]),
        ("data.experts=3", ["data.experts 3", "2 of experts.seeds"]),
        ("data.policy_std=-1", ["data.policy_std = -1", "0"]),
        ("eval.action_noise=0.1,-0.1", ["eval.action_noise", "-0.1"]),
        ("eval.action_noise=0.1,0.1", ["eval.action_noise", "once"]),
        ("eval.also=[{methods=['oracle']}]", ["eval", '"oracle" is read against "naive"']),
        ("eval.also=[{delays=[3, 1]}]", ["eval", "increasing"]),
        ("eval.also=[{protocols=['fixed']}]", ["eval", '"fixed"', "fixed:S"]),
        ("eval.also=[{flow_steps=0}]", ["eval.also.0.flow_steps = 0", "1"]),
        ("eval.also=[{flow_step=2}]", ['unknown key "eval.also.0.flow_step"', "flow_steps"]),
        ("eval.also=[{episodes=2}]", ['unknown key "eval.also.0.episodes"']),
        ("experts.progress_scale=-1", ["experts.progress_scale = -1", "0"]),
        ("experts.by_task.graps.entropy=0.1", ['experts.by_task: "graps" is no task']),
        ("experts.by_task.cartpole_thrust.target_success=0.1", ["min_success 0.65", "0.1"]),
    ],
)
def test_bad_values_are_named(override, words):
    with pytest.raises(UsageError) as caught:
        load_recipe("quickstart", [override])
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.exit_code == 2
    for word in words:
        assert word in message


def test_broken_toml_names_file_and_line(tmp_path):
    file = tmp_path / "broken.toml"
    file.write_text('tasks = ["a"]\n[train\n')
    with pytest.raises(UsageError, match=r"broken\.toml.*line 2"):
        load_recipe(file)
    file.write_bytes(b'name = "\xff"')
    with pytest.raises(UsageError, match="broken TOML"):
        load_recipe(file)


def test_unknown_recipes():
    with pytest.raises(UsageError, match='Did you mean "quickstart"'):
        load_recipe("quikstart")
    with pytest.raises(UsageError, match="does not exist"):
        load_recipe("nowhere/x.toml")


def test_missing_tasks(tmp_path):
    (tmp_path / "x.toml").write_text("horizon = 8\n")
    with pytest.raises(UsageError, match='"tasks" is missing'):
        load_recipe(tmp_path / "x.toml")


def test_an_ablation_names_its_baseline():
    with pytest.raises(UsageError, match='Did you mean "uniform"'):
        load_recipe("ablations/delay_distribution", ["ablation.baseline=unifrom"])
