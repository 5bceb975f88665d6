"""A run: one folder that holds everything computed from one recipe.

    recipe.toml    the resolved recipe
    manifest.json  versions, device, git commit, recipe hash
    experts/<task>/<seed>/  data/<task>/seed-<k>/  checkpoints/<task>/seed-<k>/<base|fork|prefix>/
    results/       episodes/*.parquet, training/*.json, profile.json, charge.json
    report/
    traces/        latencies that policies were evaluated under
    levels/        the level files that the run was made with
    variants/<combination>/  runs of an ablation's grid, on these experts
    programs/      compiled programs; worth nothing on another machine

One writer at a time holds the run's lock. The operating system frees the lock when its owner
dies, however it dies, so the next command takes it over.
"""

import fcntl
import json
import os
import platform
import re
import socket
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from rtc_cli import __version__
from rtc_cli.errors import StateError
from rtc_cli.files import (
    new_folder,
    os_error,
    remove_remains,
    sha256_file,
    write_bytes,
    write_json,
    write_text,
)
from rtc_cli.levels import is_level, level_path, moved_level, short_name
from rtc_cli.recipe import (
    Recipe,
    differing_keys,
    load_recipe,
    recipe_from_dict,
    recipe_to_toml,
)

RUNS_FOLDER = Path("runs")
MANIFEST_NAME = "manifest.json"
RECIPE_NAME = "recipe.toml"
LOCK_NAME = ".lock"
LEVELS_NAME = "levels"
MANIFEST_SCHEMA = 1

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "pymunk", "pandas")


@dataclass(frozen=True)
class Run:
    """An existing run folder with its recipe and manifest; the methods are its layout."""

    folder: Path
    recipe: Recipe
    manifest: dict[str, Any]

    def experts(self, task: str) -> Path:
        """Folder of a task's experts, one folder per expert seed in it."""
        return self.folder / "experts" / short_name(task)

    def data(self, task: str, train_seed: int) -> Path:
        """Folder of the episodes that a training seed learns from."""
        return self.folder / "data" / short_name(task) / f"seed-{train_seed}"

    def checkpoint(self, task: str, train_seed: int, kind: str) -> Path:
        """Folder of one checkpoint; `kind` is base, fork, prefix or an ablation's variant."""
        return self.folder / "checkpoints" / short_name(task) / f"seed-{train_seed}" / kind

    def source(self, task: str) -> str:
        """The name to load a task by: a level's is that of the run's own copy of its file.

        StateError where the copy is not what it was.
        """
        if not is_level(task):
            return task
        original = level_path(task)
        digest = self.manifest.get("levels", {}).get(original.name)
        if digest is None:
            return task  # a run of an earlier version
        copy = self.folder / LEVELS_NAME / original.name
        if sha256_file(copy) != digest:
            raise StateError(
                f"{copy} is damaged: it is not the level that the run was made with",
                f"restore it (the run was made from {original}), or start a new run",
            )
        return moved_level(task, copy)

    @property
    def results(self) -> Path:
        """Folder of everything measured."""
        return self.folder / "results"

    @property
    def traces(self) -> Path:
        """Folder of the latencies that policies were evaluated under."""
        return self.folder / "traces"

    @property
    def programs(self) -> Path:
        """Folder of compiled programs, which may be removed at any time."""
        return self.folder / "programs"

    @property
    def report(self) -> Path:
        """Folder of the report."""
        return self.folder / "report"

    def with_seeds(self, seeds: Iterable[int]) -> "Run":
        """Return the run with these training seeds added to its own; its recipe keeps them.

        Raises StateError where another process writes to the run, UsageError for a seed that is
        not allowed.
        """
        own = self.recipe.train.seeds
        more = [seed for seed in dict.fromkeys(seeds) if seed not in own]
        if not more:
            return self
        content = self.recipe.model_dump(mode="json", exclude_none=True)
        content["train"]["seeds"] = [*own, *more]
        recipe = recipe_from_dict(content, "training seeds", "choose other seeds")
        with self.lock():
            write_text(self.folder / RECIPE_NAME, recipe_to_toml(recipe))
        return replace(self, recipe=recipe)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Be the run's only writer within the block; StateError where another process is.

        What a writer that was ended left half-written is removed.
        """
        with _lock(self.folder):
            remove_remains(self.folder)
            yield


def create_run(recipe: Recipe, folder: Path | None = None, *, device: str | None = None) -> Run:
    """Create `folder`, or `./runs/<recipe>-<UTC time>/`, with recipe and manifest.

    `device` describes what computes, as JAX names it; this module never imports JAX.
    Raises StateError where the folder holds something or cannot be written.
    """
    now = datetime.now(UTC)
    folder = _free_folder(recipe.name, now) if folder is None else Path(folder)
    levels = {
        level_path(task): sha256_file(level_path(task)) for task in recipe.tasks if is_level(task)
    }
    manifest = _manifest(recipe, now, device)
    if levels:
        manifest["levels"] = {path.name: digest for path, digest in levels.items()}
    with new_folder(folder) as building:
        for path in levels:
            write_bytes(building / LEVELS_NAME / path.name, _read(path))
        write_text(building / RECIPE_NAME, recipe_to_toml(recipe))
        write_json(building / MANIFEST_NAME, manifest)
    return Run(folder, recipe, manifest)


def open_run(folder: Path | str, recipe: Recipe | None = None) -> Run:
    """Open an existing run; with `recipe`, refuse (StateError) a run that another recipe made."""
    folder = Path(folder)
    manifest = _read_manifest(folder)
    own = load_recipe(folder / RECIPE_NAME)
    if own.content_hash != manifest["recipe_hash"]:
        raise StateError(
            f"{folder / RECIPE_NAME} was changed after the run was made: its hash is "
            f"{own.content_hash[:12]}, the manifest's is {manifest['recipe_hash'][:12]}",
            "restore it, or start a new run from the changed recipe",
        )
    if recipe is not None and recipe.content_hash != own.content_hash:
        keys = differing_keys(own, recipe)
        more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
        raise StateError(
            f'run {folder} was made from another recipe ("{own.name}", hash '
            f'{own.content_hash[:12]}) than "{recipe.name}", hash {recipe.content_hash[:12]}: '
            f"they differ in {', '.join(keys[:3])}{more}",
            "choose another --run folder, or leave --run away to start a new run",
        )
    return Run(folder, own, manifest)


def open_or_create_run(recipe: Recipe, folder: Path | None, *, device: str | None = None) -> Run:
    """Open the run in `folder` if there is one from this recipe, else create it.

    The recipe's training seeds are added to those of the run.
    """
    if folder is not None and (Path(folder) / MANIFEST_NAME).is_file():
        return open_run(folder, recipe).with_seeds(recipe.train.seeds)
    return create_run(recipe, folder, device=device)


def newest_run(recipe: Recipe | None = None, root: Path = RUNS_FOLDER) -> Run:
    """Open the newest run under `root`; with `recipe`, the newest that this recipe made."""
    found = sorted(_runs_under(root), key=lambda pair: pair[0], reverse=True)
    if recipe is not None:
        found = [pair for pair in found if pair[2] == recipe.content_hash]
    if not found:
        which = "" if recipe is None else f' of recipe "{recipe.name}"'
        raise StateError(
            f"no run{which} in {root}/",
            'start one with "rtc run", or name its folder with --run',
        )
    return open_run(found[0][1])


def has_run(recipe: Recipe, root: Path = RUNS_FOLDER) -> bool:
    """Whether a run under `root` was made by this recipe."""
    return any(found == recipe.content_hash for _, _, found in _runs_under(root))


def _runs_under(root: Path) -> Iterator[tuple[str, Path, str]]:
    try:
        folders = [entry for entry in root.iterdir() if (entry / MANIFEST_NAME).is_file()]
    except FileNotFoundError:
        return
    except OSError as error:
        raise os_error(error, root) from error
    for folder in folders:
        try:
            manifest = _read_manifest(folder)
        except StateError:
            continue  # a damaged run is reported when it is named, not when it is passed by
        yield str(manifest["created"]), folder, str(manifest["recipe_hash"])


def _read_manifest(folder: Path) -> dict[str, Any]:
    file = folder / MANIFEST_NAME
    hint = 'check the path of --run, or start a run with "rtc run"'
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
        schema = manifest["schema"]
        manifest["created"], manifest["recipe_hash"]
    except (FileNotFoundError, NotADirectoryError):
        what = "holds no run: manifest.json is missing" if folder.exists() else "does not exist"
        raise StateError(f"run folder {folder} {what}", hint) from None
    except OSError as error:
        raise os_error(error, file) from error
    except (ValueError, KeyError, TypeError):
        raise StateError(f"{file} is damaged: it cannot be read as a manifest", hint) from None
    if schema != MANIFEST_SCHEMA:
        raise StateError(
            f"{file} has schema {schema}; this version reads schema {MANIFEST_SCHEMA}",
            f"use the version of rtc that made it ({manifest.get('versions', {}).get('rtc')})",
        )
    return dict(manifest)


def _manifest(recipe: Recipe, now: datetime, device: str | None) -> dict[str, Any]:
    versions = {"rtc": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "schema": MANIFEST_SCHEMA,
        "created": now.isoformat(timespec="microseconds"),
        "recipe": recipe.name,
        "recipe_hash": recipe.content_hash,
        "versions": versions,
        "device": device or f"{platform.machine()}, {os.cpu_count()} cores",
        "system": platform.platform(),
        "git_commit": _git_commit(),
    }


def _git_commit() -> str | None:
    """Return the commit of the package's own sources ("-dirty" if changed), None outside git."""
    source = Path(__file__).parent
    options = {"cwd": source, "capture_output": True, "text": True, "timeout": 10}
    command = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        if subprocess.run(["git", "ls-files", "--error-unmatch", __file__], **options).returncode:  # type: ignore[call-overload]
            return None  # installed into some other project's checkout
        done = subprocess.run(command, **options)  # type: ignore[call-overload]
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise os_error(error, path) from error


def _free_folder(name: str, now: datetime) -> Path:
    stem = f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}-{now:%Y%m%dT%H%M%SZ}"
    folder, count = RUNS_FOLDER / stem, 1
    while folder.exists():
        count += 1
        folder = RUNS_FOLDER / f"{stem}-{count}"
    return folder


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    file = folder / LOCK_NAME
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise os_error(error, file) from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StateError(
                f"run {folder} is locked by {_owner(handle)}",
                "wait until it ends, or choose another --run folder",
            ) from None
        except OSError as error:
            raise os_error(error, file) from error
        owner = {"pid": os.getpid(), "host": socket.gethostname()}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(owner).encode(), 0)
        yield
    finally:
        os.close(handle)  # frees the lock


def _owner(handle: int) -> str:
    try:
        owner = json.loads(os.pread(handle, 1000, 0))
        return f"process {owner['pid']} on {owner['host']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
