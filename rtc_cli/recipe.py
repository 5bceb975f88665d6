"""A recipe: everything that decides what a run computes, typed, validated and hashable.

Recipes are TOML files. Reading is strict: an unknown key, a wrong type or a value out of range is
a UsageError that names the key, the value and the rule. The records here are frozen.
"""

import hashlib
import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin

import tomli_w
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.files import os_error
from rtc_cli.levels import LEVELS, expand, short_name
from rtc_cli.units import Rounding, parse_delays

Mask = Literal["exp", "linear", "zeros", "ones"]

Positive = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Correlation = Annotated[float, Field(ge=0, lt=1)]
Measured = Annotated[tuple[NonNegativeFloat, ...], Field(min_length=1)]


def _read_delays(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(value)
    if not isinstance(value, str):
        return value
    try:
        return parse_delays(value)
    except UsageError as error:
        raise PydanticCustomError("delays", "{why}", {"why": f"{error}; {error.hint}"}) from None


def _ascending(values: tuple[int, ...]) -> tuple[int, ...]:
    if list(values) != sorted(set(values)):
        raise ValueError("has to be increasing, each value once")
    return values


def _unique(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) != len(values):
        raise ValueError("has to name each value once")
    return values


Delays = Annotated[
    tuple[Count, ...], Field(min_length=1), BeforeValidator(_read_delays), Field(max_length=1000)
]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Seeds = Annotated[tuple[Seed, ...], Field(min_length=1)]
# Each training seed's episodes are numbered from 1,000,000 (seed + 1); experts' begin at
# 900,000,000.
TrainSeed = Annotated[int, Field(ge=0, lt=899)]
TrainSeeds = Annotated[tuple[TrainSeed, ...], Field(min_length=1)]
Names = Annotated[tuple[str, ...], Field(min_length=1)]


class Section(BaseModel):
    """Base of every record: frozen, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class DelayConfig(Section):
    """A distribution of simulated delays on a written-out support that contains 0 (§3).

    `exponential`: P(d) proportional to exp(-rate d); `uniform`; `constant`: always `value`;
    `weights`: one non-negative weight per value of the support.
    """

    kind: Literal["exponential", "uniform", "constant", "weights"] = "exponential"
    support: Delays = (0, 1, 2, 3, 4)
    rate: PositiveFloat = 1.0
    value: Count | None = None
    weights: tuple[NonNegativeFloat, ...] | None = None

    @field_validator("support")
    @classmethod
    def _check_support(cls, support: tuple[int, ...]) -> tuple[int, ...]:
        if 0 not in support:
            raise ValueError("has to contain 0: an episode starts without a previous chunk")
        return _ascending(support)

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if self.kind == "constant" and self.value not in self.support:
            raise ValueError(f"kind constant needs value, one of its support {self.support}")
        if self.kind == "weights":
            if self.weights is None or len(self.weights) != len(self.support):
                raise ValueError(f"kind weights needs {len(self.support)} weights, as the support")
            if sum(self.weights) <= 0:
                raise ValueError("weights have to hold a positive number")
        return self


class ExpertChanges(Section):
    """What differs for the experts of one task; None is as in `[experts]`."""

    max_steps: Positive | None = None
    target_success: Share | None = None
    entropy: NonNegativeFloat | None = None
    progress_scale: NonNegativeFloat | None = None
    solved_reward: NonNegativeFloat | None = None
    failure_cost: NonNegativeFloat | None = None
    noise_correlation: Correlation | None = None


class ExpertsConfig(Section):
    """PPO experts whose mixture makes the data.

    `progress_scale`: reward per metre of progress, in place of the task's own; `solved_reward`,
    `failure_cost`: at the end of an episode. `noise_correlation`: of the exploration noise from one
    control step to the next, 0 is white; a task that needs one motion held for many steps is hardly
    ever solved by white noise. `by_task` changes some of these for tasks, by their short names.
    """

    seeds: Seeds = (0, 1)
    worlds: Positive = 256
    rollout_ticks: Positive = 64
    max_steps: Positive = 1_500_000
    target_success: Share = 0.8
    min_success: Share = 0.65
    learning_rate: PositiveFloat = 1e-3
    epochs: Positive = 4
    minibatches: Positive = 8
    gamma: Share = 0.995
    gae_lambda: Share = 0.95
    entropy: NonNegativeFloat = 0.0
    rpo_alpha: NonNegativeFloat = 0.3
    hidden: tuple[Positive, ...] = (128, 128)
    init_log_std: Annotated[float, Field(ge=-10, le=3)] = 0.0
    progress_scale: NonNegativeFloat | None = None
    solved_reward: NonNegativeFloat = 1.0
    failure_cost: NonNegativeFloat = 1.0
    noise_correlation: Correlation = 0.0
    by_task: dict[str, ExpertChanges] = {}

    @model_validator(mode="after")
    def _check(self) -> Self:
        _unique(self.seeds)
        if self.min_success > self.target_success:
            raise ValueError(
                f"min_success {self.min_success} is above target_success {self.target_success}, "
                "at which an expert stops training"
            )
        if self.minibatches > self.worlds * self.rollout_ticks:
            raise ValueError("minibatches exceeds worlds x rollout_ticks")
        for task in self.by_task:
            self.of(task)
        return self

    def of(self, task: str) -> "ExpertsConfig":
        """The settings for the experts of a task, by its short name."""
        changes = self.by_task.get(task)
        if changes is None:
            return self
        content = self.model_dump(exclude={"by_task"})
        return ExpertsConfig.model_validate(content | changes.model_dump(exclude_none=True))


class DataConfig(Section):
    """Expert data: how many valid control steps per task and training seed, and who acts.

    `experts`: how many of the good experts act, the first by seed; all without it.
    `policy_std`: scale of the experts' own standard deviation; 0 is the mean action.
    """

    transitions: Positive = 65_000
    experts: Positive | None = None
    policy_std: NonNegativeFloat = 1.0


class NetworkConfig(Section):
    """The velocity network's kind and sizes.

    `token_hidden` is the Mixer's own; the sizes that are None are the transformer's own, and stand
    for its defaults.
    """

    kind: str = "mixer"
    layers: Positive = 2
    channels: Positive = 64
    channel_hidden: Positive = 128
    token_hidden: Positive = 32
    heads: Positive | None = None
    kv_heads: Positive | None = None
    head_dim: Positive | None = None
    context: Positive | None = None

    def options(self) -> dict[str, int]:
        """The sizes that a network of this kind is built with."""
        sizes = self.model_dump(exclude_none=True, exclude={"kind"})
        if self.kind == "transformer":
            del sizes["token_hidden"]
        return sizes


class TrainConfig(Section):
    """Flow-matching training; the prefix policy takes the last `prefix_fraction` of the epochs."""

    seeds: TrainSeeds = (0,)
    batch: Positive = 256
    epochs: Positive = 21
    learning_rate: PositiveFloat = 1e-3
    weight_decay: NonNegativeFloat = 1e-2
    warmup_steps: Count = 200
    decay: Literal["linear_last_quarter", "constant"] = "linear_last_quarter"
    grad_clip: PositiveFloat = 10.0
    prefix_fraction: Annotated[float, Field(gt=0, le=1)] = 0.25
    delays: DelayConfig = DelayConfig()

    _check_seeds = field_validator("seeds")(_unique)


class PinvConfig(Section):
    """Settings of the guided samplers."""

    mask: Mask = "exp"
    max_guidance_weight: NonNegativeFloat = 5.0
    prior_std: PositiveFloat = 1.0


class TuneConfig(Section):
    """A grid of guidance settings, tried on validation episodes before the evaluation.

    `train_seed` is the development seed whose base policies they are tried on.
    """

    train_seed: TrainSeed = 90
    max_guidance_weight: Annotated[tuple[NonNegativeFloat, ...], Field(min_length=1)] = (
        1.0,
        5.0,
        20.0,
    )
    prior_std: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.5, 1.0)
    mask: Annotated[tuple[Mask, ...], Field(min_length=1)] = ("exp",)
    episodes: Annotated[int, Field(ge=1, le=100_000)] = 128
    delays: Delays = (2, 4)
    first_episode: Annotated[int, Field(ge=500_000, lt=900_000)] = 500_000


class ChargeConfig(Section):
    """Latencies at which every method, with each number of flow steps, is evaluated once more.

    `profile` is the name of published latencies or a file (see `analysis.charge`); `fixed_ms` is
    added, in milliseconds by name, a list where it was measured; `hz` is the control rate.
    """

    profile: str
    fixed_ms: dict[str, NonNegativeFloat | Measured] = {}
    hz: PositiveFloat = 30.0
    rounding: Rounding = "ceil"


class AlsoConfig(Section):
    """One more evaluation of a run, where it differs from `[eval]`; what is None is as there.

    Neither tuning nor an evaluation at equal hardware belongs to it.
    """

    delays: Delays | None = None
    protocols: Names | None = None
    methods: Names | None = None
    flow_steps: Positive | None = None


class EvalConfig(Section):
    """Which cells are evaluated; `episodes` is per training seed and cell.

    The first `reaction_episodes` of them run once more in each cell, with a push. `action_noise`:
    standard deviations of the worlds' noise during evaluation, each with cells of its own; empty
    is the task's own. Data are collected with the task's own noise in any case.

    `delay_models` take the place of `delays` where they are given: delays that vary from one
    inference to the next, none longer than `delay_cap` (horizon - 1 without it). Every delay or
    model is evaluated with each of `estimators`, which say what the sampler is told. `charge` adds
    an evaluation at equal hardware, `also` others that differ in a few settings.
    """

    delays: Delays = (0, 1, 2, 3, 4)
    protocols: Names = ("paper",)
    methods: Names = ("naive", "pinv", "prefix")
    episodes: Annotated[int, Field(ge=1, le=100_000)] = 512
    flow_steps: Positive = 5
    seed: Seed = 0
    first_episode: Annotated[int, Field(ge=0, lt=400_000)] = 0
    hold: Literal["last", "zero"] = "last"
    reaction_episodes: Count = 0
    action_noise: tuple[NonNegativeFloat, ...] = ()
    matrix: bool = False
    delay_models: tuple[str, ...] = ()
    delay_cap: Count | None = None
    estimators: Names = ("exact",)
    on_late: Literal["play", "discard"] = "play"
    on_exceed: Literal["play", "clamp", "fail"] = "play"
    observation_lag: Count = 0
    pinv: PinvConfig = PinvConfig()
    tune: TuneConfig | None = None
    charge: ChargeConfig | None = None
    also: tuple[AlsoConfig, ...] = ()

    _check_delays = field_validator("delays")(_ascending)
    _check_methods = field_validator("methods")(_unique)
    _check_noise = field_validator("action_noise")(_unique)
    _check_timing = field_validator("delay_models", "estimators")(_unique)

    @model_validator(mode="after")
    def _check_counts(self) -> Self:
        if self.reaction_episodes > self.episodes:
            raise ValueError(
                f"reaction_episodes {self.reaction_episodes} exceeds episodes {self.episodes}, "
                "of which they are the first"
            )
        if self.delay_cap is not None and not self.delay_models:
            raise ValueError(f"delay_cap {self.delay_cap} has nothing to cap without delay_models")
        if "oracle" in self.methods and "naive" not in self.methods:
            raise ValueError('methods: "oracle" is read against "naive"; name both')
        return self

    @model_validator(mode="after")
    def _check_also(self) -> Self:
        for entry in self.also:
            self._with(entry)
        return self

    @property
    def further(self) -> "tuple[EvalConfig, ...]":
        """The evaluations of `also`, whole."""
        return tuple(self._with(entry) for entry in self.also)

    def _with(self, entry: AlsoConfig) -> "EvalConfig":
        content = self.model_dump(exclude={"also", "tune", "charge"})
        return EvalConfig.model_validate(content | entry.model_dump(exclude_none=True))

    @field_validator("protocols")
    @classmethod
    def _check_protocols(cls, protocols: tuple[str, ...]) -> tuple[str, ...]:
        for protocol in protocols:
            if not re.fullmatch(r"paper|grid|fixed:[1-9]\d*", protocol):
                raise ValueError(f'"{protocol}" is none of: paper, grid, fixed:S (as in fixed:4)')
        return _unique(protocols)


class ProfileConfig(Section):
    """What `rtc run` profiles."""

    samplers: Names = ("pinv", "prefix")
    batch: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1,)
    rounds: Annotated[int, Field(ge=2)] = 50
    hz: PositiveFloat = 30.0
    rounding: Rounding = "ceil"


# What a grid may vary: experts are shared by its runs, and the evaluation has lists of its own.
GRID_SECTIONS = ("data", "horizon", "network", "train")

Setting = bool | int | float | str


def _flat_keys(value: Any) -> Any:
    """Let `data.experts = [1, 4]` under [ablation.grid] mean what `"data.experts" = ...` does."""
    if not isinstance(value, dict):
        return value
    flat = _flatten(value)
    return {key: tuple(v) if isinstance(v, list) else v for key, v in flat.items()}


class AblationConfig(Section):
    """What to compare: `variants` of the training delays, or a `grid` of settings.

    Variants are delay distributions, forked from one base checkpoint. A grid has lists of values
    by dotted key of the recipe; every combination is a run of its own on the same experts.
    """

    variants: dict[str, DelayConfig] = {}
    baseline: str | None = None
    grid: Annotated[
        dict[str, Annotated[tuple[Setting, ...], Field(min_length=1)]], BeforeValidator(_flat_keys)
    ] = {}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.grid:
            return self._check_variants()
        if self.variants or self.baseline is not None:
            given = "variants" if self.variants else "baseline"
            raise ValueError(f"{given} and grid are two kinds of ablation; give one of them")
        for key, values in self.grid.items():
            if key.split(".")[0] not in GRID_SECTIONS or key == "train.seeds":
                raise ValueError(
                    f'grid key "{key}" cannot be varied: the runs of a grid share experts, '
                    f"training seeds and evaluation; allowed are keys of {', '.join(GRID_SECTIONS)}"
                )
            if len(set(values)) != len(values):
                raise ValueError(f'grid key "{key}" has to name each value once')
        if math.prod(map(len, self.grid.values())) < 2:
            raise ValueError("the grid has one combination only; there is nothing to compare")
        return self

    def _check_variants(self) -> Self:
        if not self.variants:
            raise ValueError("needs variants or a grid")
        if len(self.variants) < 2:
            raise ValueError(f"needs at least 2 variants, not {len(self.variants)}")
        for name in self.variants:
            if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", name):
                raise ValueError(
                    f'variant name "{name}" may hold letters, digits, "_", "." and "-"'
                )
            if name in ("base", "fork"):
                raise ValueError(f'variant name "{name}" is that of another checkpoint')
        if self.baseline is None:
            raise ValueError("needs a baseline, one of its variants")
        if self.baseline not in self.variants:
            nearest = did_you_mean(self.baseline, self.variants)
            raise ValueError(f'baseline "{self.baseline}" is no variant.{nearest}')
        return self


class Recipe(Section):
    """Everything that decides what a run computes."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$", max_length=80)]
    description: str = ""
    tasks: Names
    horizon: Annotated[int, Field(ge=1, le=1000)] = 8
    experts: ExpertsConfig = ExpertsConfig()
    data: DataConfig = DataConfig()
    network: NetworkConfig = NetworkConfig()
    train: TrainConfig = TrainConfig()
    eval: EvalConfig = EvalConfig()
    profile: ProfileConfig = ProfileConfig()
    ablation: AblationConfig | None = None

    @field_validator("tasks")
    @classmethod
    def _check_tasks(cls, tasks: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return _unique(expand(tasks))
        except UsageError as error:
            raise PydanticCustomError("tasks", "{why}", {"why": f"{error}; {error.hint}"}) from None

    @model_validator(mode="after")
    def _check_tuning_seed(self) -> Self:
        tune = self.eval.tune
        if tune is not None and tune.train_seed in self.train.seeds:
            raise ValueError(
                f"eval.tune.train_seed {tune.train_seed} is one of train.seeds; tune on a seed "
                "that is not evaluated"
            )
        return self

    @model_validator(mode="after")
    def _check_experts_tasks(self) -> Self:
        names = [short_name(task) for task in self.tasks]
        for task in self.experts.by_task:
            if task not in names:
                raise ValueError(
                    f'experts.by_task: "{task}" is no task.{did_you_mean(task, names)}'
                )
        return self

    @model_validator(mode="after")
    def _check_mixture(self) -> Self:
        wanted, seeds = self.data.experts, self.experts.seeds
        if wanted is not None and wanted > len(seeds):
            raise ValueError(f"data.experts {wanted} exceeds the {len(seeds)} of experts.seeds")
        return self

    @model_validator(mode="after")
    def _check_batch(self) -> Self:
        if self.train.batch > self.data.transitions:
            raise ValueError(
                f"train.batch {self.train.batch} exceeds data.transitions "
                f"{self.data.transitions}: there would be no whole minibatch"
            )
        return self

    @model_validator(mode="after")
    def _check_trained_delays(self) -> Self:
        configs = {"train.delays": self.train.delays}
        if self.ablation is not None:
            configs |= {f"ablation.variants.{k}": v for k, v in self.ablation.variants.items()}
        for where, config in configs.items():
            if max(config.support) >= self.horizon:
                raise ValueError(
                    f"{where}.support reaches {max(config.support)}, but a chunk of horizon "
                    f"{self.horizon} leaves nothing to learn from delay {self.horizon} on"
                )
        return self

    @property
    def content_hash(self) -> str:
        """SHA-256 (hex) of what is computed: name, description and formatting do not enter.

        Nor do the training seeds: each is computed for itself, and a run may be given more.
        """
        return self.hash_of(*(set(type(self).model_fields) - {"name", "description"}))

    def hash_of(self, *fields: str) -> str:
        """SHA-256 (hex) of some top-level fields but for `train.seeds`."""
        content = self.model_dump(mode="json", include=set(fields))
        content.get("train", {}).pop("seeds", None)
        _leave_out_later_defaults(content)
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


# Keys that older runs were made without: at their defaults they leave the hash as it was.
_LATER_EVAL_KEYS = (
    "delay_models",
    "delay_cap",
    "estimators",
    "on_late",
    "on_exceed",
    "observation_lag",
    "charge",
    "also",
)
_LATER_EXPERTS_KEYS = (
    "progress_scale",
    "solved_reward",
    "failure_cost",
    "noise_correlation",
    "by_task",
)
_LATER_NETWORK_KEYS = ("heads", "kv_heads", "head_dim", "context")


def _leave_out_later_defaults(content: dict[str, Any]) -> None:
    sections = (
        ("eval", EvalConfig, _LATER_EVAL_KEYS),
        ("experts", ExpertsConfig, _LATER_EXPERTS_KEYS),
        ("network", NetworkConfig, _LATER_NETWORK_KEYS),
    )
    for name, section, keys in sections:
        defaults, given = section().model_dump(mode="json"), content.get(name, {})
        for key in keys:
            if key in given and given[key] == defaults[key]:
                del given[key]


def recipes_folder() -> Path:
    """Return the folder of the shipped recipes: inside a wheel, or beside the package's sources."""
    installed = Path(__file__).parent / "recipes"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "recipes"


def list_recipes() -> tuple[str, ...]:
    """Return the names of the shipped recipes, as "quickstart" or "ablations/..."."""
    folder = recipes_folder()
    files = folder.rglob("*.toml")
    return tuple(sorted(file.relative_to(folder).with_suffix("").as_posix() for file in files))


def find_recipe(name_or_path: str | Path) -> Path:
    """Return the file of a shipped name or a path; UsageError with the nearest name."""
    text = str(name_or_path)
    if text in list_recipes():
        return recipes_folder() / f"{text}.toml"
    path = Path(text)
    if path.is_file():
        return path
    if text and path.is_dir():
        raise UsageError(f"recipe {path} is a folder, not a file", "give the path of a .toml file")
    if path.suffix == ".toml":
        raise UsageError(f"recipe file {path} does not exist", "check the path")
    raise UsageError(
        f'unknown recipe "{text}".{did_you_mean(text, list_recipes())}',
        "give one of these names or the path of a .toml file",
    )


def load_recipe(name_or_path: str | Path, overrides: Iterable[str] = ()) -> Recipe:
    """Read a recipe by shipped name or path; `overrides` are texts such as "train.epochs=8".

    Raises UsageError for an unknown name, broken TOML (with its line), an unknown key or a bad
    value; StateError where the file cannot be read.
    """
    path = find_recipe(name_or_path)
    content = _read_toml(path)
    content.setdefault("name", re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem))
    for override in overrides:
        _apply_override(content, override)
    _place_levels(content, path)
    return recipe_from_dict(content, str(path))


def _place_levels(content: dict[str, Any], path: Path) -> None:
    """Put the folder that the key `levels` names in the place of "{levels}" in tasks."""
    folder, tasks = content.pop("levels", None), content.get("tasks")
    if not isinstance(tasks, list) or not any(LEVELS in str(task) for task in tasks):
        if folder is not None:
            raise UsageError(
                f'{path}: levels = "{folder}", but no task of the recipe holds "{LEVELS}"',
                "leave the folder away, or name levels as tasks: kinetix:PATH",
            )
        return
    if not isinstance(folder, str) or not folder:
        raise UsageError(
            f"{path}: its tasks are Kinetix level files, which are not part of rtc",
            "say where they are: --levels FOLDER (docs/kinetix.md says which repository has them)",
        )
    content["tasks"] = [str(task).replace(LEVELS, folder) for task in tasks]


def recipe_from_dict(
    content: Mapping[str, Any], source: str = "recipe", fix: str = "mend the recipe or the --set"
) -> Recipe:
    """Validate a plain dictionary strictly; `source` names it in messages, `fix` is their hint."""
    try:
        # JSON's strict mode is the wanted one: lists become tuples, but "8" is no integer.
        return Recipe.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _usage_error(error, source, fix) from None


def with_settings(recipe: Recipe, settings: Mapping[str, Setting], name: str) -> Recipe:
    """Return a recipe under another name, without its ablation, with some dotted keys replaced.

    Raises UsageError for a key that does not exist or a value that does not fit there.
    """
    content = recipe.model_dump(mode="json", exclude_none=True)
    content.pop("ablation", None)
    content |= {"name": name}
    for key, value in settings.items():
        _put(content, key, value)
    source = f"{recipe.name}, ablation.grid at {', '.join(f'{k}={v}' for k, v in settings.items())}"
    return recipe_from_dict(content, source, "mend [ablation.grid]")


def recipe_to_toml(recipe: Recipe) -> str:
    """Return the resolved recipe, defaults written out; reading it back gives an equal recipe."""
    return tomli_w.dumps(recipe.model_dump(mode="json", exclude_none=True))


def differing_keys(first: Recipe, second: Recipe) -> tuple[str, ...]:
    """Return the dotted keys in which two recipes differ, as far as the content hash sees."""
    one, two = (_flatten(recipe.model_dump(mode="json")) for recipe in (first, second))
    keys = sorted(one.keys() | two.keys())
    differing = (key for key in keys if one.get(key) != two.get(key))
    return tuple(key for key in differing if key not in ("name", "description", "train.seeds"))


def _flatten(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise UsageError(
            f"{path}: broken TOML: byte {error.start} is not UTF-8", "save the file as UTF-8"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: broken TOML: {error}", "mend the file at that place") from None
    except OSError as error:
        raise os_error(error, path) from error


def _usage_error(error: ValidationError, source: str, fix: str) -> UsageError:
    details = error.errors(include_url=False)
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    return UsageError(f"{source}: {_describe(details[0])}{more}", fix)


_PLAIN = {
    "too_short": "Needs at least one value",
    "model_type": "Is a section, not a value",
}


def _describe(detail: ErrorDetails) -> str:
    keys = [str(part) for part in detail["loc"]]
    where = ".".join(keys)
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "extra_forbidden":
        return f'unknown key "{where}".{did_you_mean(keys[-1], _keys_of(keys[:-1]))}'
    if detail["type"] == "missing":
        return f'"{where}" is missing; it has to be given'
    message = _PLAIN.get(detail["type"], message)
    value = json.dumps(detail["input"], default=str)
    if isinstance(detail["input"], dict) or len(value) > 120:
        return f"{where}: {message}" if where else message
    return f"{where} = {value}: {message[0].lower()}{message[1:]}"


def _keys_of(section: list[str]) -> tuple[str, ...]:
    model = next(filter(_is_section, _alternatives(_annotation_at(section))), None)
    return tuple(model.model_fields) if model is not None else ()


def _apply_override(content: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise UsageError(
            f'cannot read the override "{override}"', 'write KEY=VALUE, as in "train.epochs=8"'
        )
    _put(content, key.strip(), _parse_value(text.strip(), _is_tuple(parts)))


def _put(content: dict[str, Any], key: str, value: Any) -> None:
    """Set the value at a dotted key; sections that are missing appear."""
    section, parts = content, key.split(".")
    for depth, part in enumerate(parts[:-1], start=1):
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            prefix = ".".join(parts[:depth])
            raise UsageError(
                f'cannot set "{key}": "{prefix}" is a value, not a section',
                f'write "{prefix}=VALUE"',
            )
    section[parts[-1]] = value


def _parse_value(text: str, is_tuple: bool) -> Any:
    """Read a value as TOML would; a bare word is a string; commas make a list where one is due."""
    value = _parse_scalar(text)
    if not is_tuple or isinstance(value, list) or value is None:
        return value
    if isinstance(value, str) and re.fullmatch(r"[\d\s,-]*\d-\d[\d\s,-]*", value):
        return value  # ranges, as in "0,2-4", are read by the field itself
    return [_parse_scalar(part.strip()) for part in text.split(",")]


def _parse_scalar(text: str) -> Any:
    if text.lower() in ("none", "null"):
        return None
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _is_tuple(parts: list[str]) -> bool:
    return any(get_origin(a) is tuple for a in _alternatives(_annotation_at(parts)))


def _annotation_at(parts: list[str]) -> Any:
    """Return the declared type at a dotted key, None where there is none."""
    annotation: Any = Recipe
    for part in parts:
        alternatives = _alternatives(annotation)
        if part.isdigit():  # a place in a list of sections
            lists = [a for a in alternatives if get_origin(a) is tuple]
            annotation = get_args(lists[0])[0] if lists else None
            continue
        model = next(filter(_is_section, alternatives), None)
        mapping = next((a for a in alternatives if get_origin(a) is dict), None)
        if model is not None and part in model.model_fields:
            annotation = model.model_fields[part].annotation
        elif mapping is not None:
            annotation = get_args(mapping)[1]
        else:
            return None
    return annotation


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    is_plain = isinstance(annotation, type) or get_origin(annotation) in (tuple, dict)
    return (annotation,) if is_plain else (annotation, *get_args(annotation))


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Section)
