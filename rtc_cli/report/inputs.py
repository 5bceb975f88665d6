"""What a report reads from a run folder. Missing parts are empty; damaged parts are errors."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from rtc_cli.errors import StateError
from rtc_cli.files import os_error
from rtc_cli.results import ResultStore

EPISODES = Path("results") / "episodes"
PROFILE = Path("results") / "profile.json"
CHARGE = Path("results") / "charge.json"
TRAINING = Path("results") / "training"
DIVERSITY = Path("results") / "diversity"


@dataclass(frozen=True)
class RunInputs:
    """The parts of a run that a report shows.

    `recipe_text` is the resolved recipe as TOML; `variants` holds the episodes of an ablation.
    """

    folder: Path
    recipe: Mapping[str, Any]
    recipe_text: str
    manifest: Mapping[str, Any]
    episodes: pd.DataFrame
    variants: pd.DataFrame
    profile: Mapping[str, Any]
    charge: Mapping[str, Any]
    training: list[dict[str, Any]]
    experts: list[dict[str, Any]]
    diversity: list[dict[str, Any]]

    @property
    def name(self) -> str:
        """Name of the recipe, or of the folder."""
        return str(self.recipe.get("name") or self.folder.name)

    @property
    def horizon(self) -> int:
        """Actions in a chunk."""
        return int(self.recipe.get("horizon", 8))


def load_run(run_folder: Path | str) -> RunInputs:
    """Read a run folder; StateError where it is missing or one of its files is damaged."""
    folder = Path(run_folder)
    if not folder.is_dir():
        raise StateError(f"run folder {folder} does not exist", "give a run with --run DIR")
    recipe, text = _read_recipe(folder / "recipe.toml")
    return RunInputs(
        folder=folder,
        recipe=recipe,
        recipe_text=text,
        manifest=_read_json(folder / "manifest.json") or {},
        episodes=load_episodes(folder),
        variants=load_variants(folder),
        profile=_read_json(folder / PROFILE) or {},
        charge=_read_json(folder / CHARGE) or {},
        training=_read_all(folder / TRAINING, "*.json", {"task", "epochs", "loss"}),
        experts=_read_all(folder / "experts", "**/*.json", {"task", "seed", "success"}),
        diversity=load_diversity(folder),
    )


def load_episodes(folder: Path) -> pd.DataFrame:
    """Return the episode rows of a run's evaluations; empty where there are none."""
    return ResultStore(folder / EPISODES).load()


def load_variants(folder: Path) -> pd.DataFrame:
    """Return the episode rows of a run's ablation, with the column `variant`.

    Each variant has a folder of its own below `results/episodes`.
    """
    stores = sorted(path for path in (folder / EPISODES).glob("*") if path.is_dir())
    frames = [ResultStore(store).load().assign(variant=store.name) for store in stores]
    frames = [frame for frame in frames if not frame.empty]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def _read_recipe(path: Path) -> tuple[dict[str, Any], str]:
    if not path.is_file():
        return {}, ""
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text), text
    except OSError as error:
        raise os_error(error, path) from error
    except ValueError as error:
        raise StateError(f"{path} is not valid TOML: {error}", "restore the file") from error


def _read_json(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise os_error(error, path) from error
    except ValueError as error:
        raise StateError(f"{path} is not valid JSON: {error}", "remove or restore it") from error
    return found if isinstance(found, dict) else None


def _read_all(folder: Path, pattern: str, needed: set[str]) -> list[dict[str, Any]]:
    records = (_read_json(path) for path in sorted(folder.glob(pattern)))
    return [record for record in records if record is not None and needed <= set(record)]


def load_diversity(folder: Path) -> list[dict[str, Any]]:
    """Read how differently the experts of each task act in a run's data; empty if unmeasured."""
    return _read_all(folder / DIVERSITY, "*.json", {"task", "experts", "mean_distance"})
