"""Checkpoints and exported policies: folders that are whole or absent, with a checksum per file.

A checkpoint folder holds

    meta.json        what it is: task, kind, seed, epoch, dimensions, network, normaliser, recipe
    params/          the network's parameters (orbax)
    training/        optimizer state and random state (orbax)
    CHECKSUMS.json   SHA-256 of every file above

An exported policy holds `policy.safetensors`, `config.json` (the same description) and
CHECKSUMS.json. Nothing here unpickles: orbax stores arrays through tensorstore and their names as
JSON, safetensors stores raw arrays.
"""

import dataclasses
import hashlib
import json
import logging
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.errors import StateError
from rtc_cli.files import (
    CHECKSUMS_NAME,
    new_folder,
    verify_checksums,
    write_bytes,
    write_checksums,
    write_json,
)
from rtc_cli.training.loop import TrainState, abstract_opt_state

SCHEMA = 1
Kind = Literal["base", "fork", "prefix"]

_META_NAME = "meta.json"
_EXPORT_META_NAME = "config.json"
_EXPORT_ARRAYS_NAME = "policy.safetensors"
_PROGRESS_NAME = re.compile(r"epoch-(\d+)")
_PICKLE_SUFFIXES = {".pkl", ".pickle", ".pt", ".pth", ".joblib", ".dill", ".cloudpickle"}
_NORMALISER_FIELDS = ("obs_mean", "obs_std", "action_mean", "action_std")


@dataclass(frozen=True, eq=False)
class CheckpointMeta:
    """What a checkpoint is, beside its arrays.

    task: name of the task; scene_digest: digest of its scene's declaration.
    kind: "base", "fork" (the base at the epoch where the prefix policy forks) or "prefix".
    train_seed: seed of data, initialisation and training; epoch: epochs done, of `epochs`.
    config, normaliser: those of the policy.
    delays: the simulated delays of its training; None is ordinary flow matching.
    recipe_hash: hash of the settings it was trained with.
    """

    task: str
    kind: Kind
    train_seed: int
    epoch: int
    epochs: int
    config: PolicyConfig
    normaliser: Normaliser
    delays: DelayDistribution | None
    recipe_hash: str
    scene_digest: str


@dataclass(frozen=True)
class Expected:
    """What the reader needs a checkpoint to be; None is not checked."""

    task: str | None = None
    kind: str | None = None
    train_seed: int | None = None
    horizon: int | None = None
    obs_dim: int | None = None
    action_dim: int | None = None
    recipe_hash: str | None = None
    scene_digest: str | None = None

    @classmethod
    def of(cls, meta: CheckpointMeta) -> "Expected":
        """Everything that another checkpoint of the same policy has in common with `meta`."""
        return cls(
            **{field.name: _described(meta, field.name) for field in dataclasses.fields(cls)}
        )


def save_checkpoint(folder: Path | str, state: TrainState, meta: CheckpointMeta) -> None:
    """Write a new checkpoint folder, whole or not at all.

    StateError if the folder exists already or the disk does not take it (full, no permission).
    """
    training = {
        "optimizer": _flat(state.opt_state),
        "key": np.asarray(state.key_data),
        "epoch": np.int64(state.epoch),
    }
    meta = dataclasses.replace(meta, epoch=state.epoch)
    with new_folder(folder) as building, _refusals_explained(folder):
        write_json(building / _META_NAME, _meta_to_json(meta))
        _save_tree(building / "params", _flat(state.params))
        _save_tree(building / "training", training)
        write_checksums(building)


def load_checkpoint(
    folder: Path | str, *, expect: CheckpointMeta | Expected | None = None
) -> tuple[TrainState, CheckpointMeta]:
    """Read a checkpoint after checking every byte of it against its checksums.

    StateError where it is missing, damaged, a pickle, or differs from `expect`; the message gives
    the value found and the value expected.
    """
    folder = Path(folder)
    meta = read_meta(folder, expect=expect)
    policy = _abstract_policy(meta)
    params = _restored(folder / "params", policy.params)
    tree = _load_tree(folder / "training")
    opt_state = _unflat(tree.get("optimizer", {}), abstract_opt_state(policy.params), folder)
    key_data = jax.numpy.asarray(tree["key"], np.uint32)
    return TrainState(params, opt_state, key_data, int(tree["epoch"])), meta


def load_policy(folder: Path | str, *, expect: CheckpointMeta | Expected | None = None) -> Policy:
    """Read only the policy of a checkpoint (parameters, normaliser, config); same checks."""
    folder = Path(folder)
    meta = read_meta(folder, expect=expect)
    policy = _abstract_policy(meta)
    return dataclasses.replace(policy, params=_restored(folder / "params", policy.params))


def read_meta(
    folder: Path | str, *, expect: CheckpointMeta | Expected | None = None
) -> CheckpointMeta:
    """Check a checkpoint's files and describe it, without reading its arrays."""
    folder = Path(folder)
    _check_is_checkpoint(folder)
    meta = _meta_from_json(folder / _META_NAME)
    if expect is not None:
        _check_expected(folder, meta, expect)
    return meta


def save_progress(root: Path | str, state: TrainState, meta: CheckpointMeta, keep: int = 2) -> Path:
    """Save root/epoch-NNNN and drop all but the newest `keep`; returns the new folder.

    The new checkpoint is whole before an older one goes, so whenever the process dies there is one
    to resume from. Remains of a process that died while writing are removed.
    """
    root = Path(root)
    folder = root / f"epoch-{state.epoch:04d}"
    if root.is_dir():
        for remains in root.glob(".epoch-*.tmp"):
            shutil.rmtree(remains, ignore_errors=True)
        shutil.rmtree(folder, ignore_errors=True)
    save_checkpoint(folder, state, meta)
    for old in _progress_folders(root)[:-keep]:
        shutil.rmtree(old, ignore_errors=True)
    return folder


def latest_progress(root: Path | str) -> Path | None:
    """The folder of the newest checkpoint that `save_progress` wrote under root, or None."""
    folders = _progress_folders(Path(root))
    return folders[-1] if folders else None


def export_policy(folder: Path | str, policy: Policy, meta: CheckpointMeta) -> None:
    """Write a policy as safetensors and JSON, readable by other programs; whole or not at all."""
    from safetensors.numpy import save

    arrays = {f"params/{name}": leaf for name, leaf in _flat(policy.params).items()}
    meta = dataclasses.replace(meta, config=policy.config, normaliser=policy.normaliser)
    with new_folder(folder) as building, _refusals_explained(folder):
        write_bytes(building / _EXPORT_ARRAYS_NAME, save(arrays))
        write_json(building / _EXPORT_META_NAME, _meta_to_json(meta))
        write_checksums(building)


def import_policy(folder: Path | str) -> tuple[Policy, CheckpointMeta]:
    """Read what `export_policy` wrote; StateError where it is missing, damaged or a pickle."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    folder = Path(folder)
    _refuse_pickle(folder)
    verify_checksums(folder, "exported policy")
    meta = _meta_from_json(folder / _EXPORT_META_NAME)
    try:
        arrays = load((folder / _EXPORT_ARRAYS_NAME).read_bytes())
    except (SafetensorError, OSError) as error:
        raise _damaged(folder / _EXPORT_ARRAYS_NAME, error) from error
    policy = _abstract_policy(meta)
    flat = {name.removeprefix("params/"): leaf for name, leaf in arrays.items()}
    return dataclasses.replace(policy, params=_unflat(flat, policy.params, folder)), meta


def policy_digest(policy: Policy) -> str:
    """SHA-256 over a policy's parameters, normaliser and config, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(_config_to_json(policy.config), sort_keys=True).encode())
    arrays = {"params": policy.params, "normaliser": _normaliser_arrays(policy.normaliser)}
    for name, leaf in sorted(_flat(arrays).items()):
        digest.update(f"{name}{leaf.dtype}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


# Checks


def _check_is_checkpoint(folder: Path) -> None:
    _refuse_pickle(folder)
    if folder.is_file():
        raise StateError(
            f"{folder} is a file, not a checkpoint folder", "give the folder that holds meta.json"
        )
    verify_checksums(folder, "checkpoint")


def _refuse_pickle(path: Path) -> None:
    """StateError if the path is a pickle or a folder with one in it; reads at most two bytes."""
    for file in [path] if path.is_file() else sorted(path.glob("*")):
        if file.is_file() and _looks_pickled(file):
            raise StateError(
                f"{file} is a pickle; rtc never unpickles, since a pickle can run any code",
                "give a checkpoint folder that rtc wrote, or convert the weights to safetensors",
            )


def _looks_pickled(file: Path) -> bool:
    with open(file, "rb") as stream:
        start = stream.read(2)
    protocol_mark = len(start) == 2 and start[0] == 0x80 and 2 <= start[1] <= 5
    return protocol_mark or file.suffix.lower() in _PICKLE_SUFFIXES


def _check_expected(folder: Path, meta: CheckpointMeta, expect: CheckpointMeta | Expected) -> None:
    wanted = Expected.of(expect) if isinstance(expect, CheckpointMeta) else expect
    for field in dataclasses.fields(wanted):
        value, found = getattr(wanted, field.name), _described(meta, field.name)
        if value is not None and value != found:
            name = field.name.replace("_", " ")
            raise StateError(
                f"checkpoint {folder} has {name} {found}, but {value} is needed",
                "use the run and the recipe that it was trained with, or train again",
            )


def _described(meta: CheckpointMeta, name: str) -> Any:
    return getattr(meta if hasattr(meta, name) else meta.config, name)


def _damaged(path: Path, error: Exception) -> StateError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return StateError(
        f"checkpoint is damaged: {path} cannot be read ({reason})",
        "restore or remove the folder, then run again",
    )


# Description


def _meta_to_json(meta: CheckpointMeta) -> dict[str, Any]:
    delays = meta.delays
    return {
        "schema": SCHEMA,
        "task": meta.task,
        "kind": meta.kind,
        "train_seed": meta.train_seed,
        "epoch": meta.epoch,
        "epochs": meta.epochs,
        **_config_to_json(meta.config),
        "delays": delays
        and {"support": list(delays.support), "weights": [float(w) for w in delays.weights]},
        "recipe_hash": meta.recipe_hash,
        "scene_digest": meta.scene_digest,
        # A float32 survives the way through decimal text, which JSON writes in full, bit for bit.
        "normaliser": {
            name: array.tolist() for name, array in _normaliser_arrays(meta.normaliser).items()
        },
    }


def _config_to_json(config: PolicyConfig) -> dict[str, Any]:
    return {
        "horizon": config.horizon,
        "obs_dim": config.obs_dim,
        "action_dim": config.action_dim,
        "network": {"name": config.network, "options": dict(config.options)},
    }


def _normaliser_arrays(normaliser: Normaliser) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(normaliser, name), np.float32) for name in _NORMALISER_FIELDS}


def _meta_from_json(path: Path) -> CheckpointMeta:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema = content["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(path, error) from error
    if schema != SCHEMA:
        raise StateError(
            f"{path} has schema {schema}, but this version of rtc reads schema {SCHEMA}",
            "use the version of rtc that wrote it, or train again",
        )
    try:
        return _parsed_meta(content)
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error


def _parsed_meta(content: Mapping[str, Any]) -> CheckpointMeta:
    network, delays = content["network"], content["delays"]
    config = PolicyConfig(
        network=network["name"],
        options=tuple(network["options"].items()),
        horizon=content["horizon"],
        obs_dim=content["obs_dim"],
        action_dim=content["action_dim"],
    )
    arrays = {k: np.asarray(content["normaliser"][k], np.float32) for k in _NORMALISER_FIELDS}
    names = ("task", "kind", "train_seed", "epoch", "epochs", "recipe_hash", "scene_digest")
    return CheckpointMeta(
        config=config,
        normaliser=Normaliser(**{name: jax.numpy.asarray(a) for name, a in arrays.items()}),
        delays=delays and DelayDistribution(tuple(delays["support"]), tuple(delays["weights"])),
        **{name: content[name] for name in names},
    )


def _abstract_policy(meta: CheckpointMeta) -> Policy:
    """The policy that the description declares, with shapes in place of parameters."""

    def init(key: jax.Array) -> Any:
        return Policy.init(meta.config, meta.normaliser, key).params

    params = jax.eval_shape(init, jax.random.key(0))
    return Policy(config=meta.config, params=params, normaliser=meta.normaliser)


# Arrays


def _flat(tree: Any) -> dict[str, np.ndarray]:
    """Leaves by the path of their keys, as in "layers/0/kernel"."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf)
        for path, leaf in leaves
    }


def _unflat(flat: Mapping[str, Any], like: Any, folder: Path) -> Any:
    """The arrays of `flat` in the structure of `like`; StateError where names or shapes differ."""
    paths, structure = jax.tree_util.tree_flatten_with_path(like)
    wanted = {jax.tree_util.keystr(p, simple=True, separator="/"): leaf for p, leaf in paths}
    for name in sorted(wanted.keys() | flat.keys()):
        found = tuple(flat[name].shape) if name in flat else "nothing"
        needed = tuple(wanted[name].shape) if name in wanted else "nothing"
        if found != needed:
            raise StateError(
                f"checkpoint {folder}: array {name} has shape {found}, its network needs {needed}",
                "use the version of rtc that wrote it, or train again",
            )
    leaves = [jax.numpy.asarray(flat[name], leaf.dtype) for name, leaf in wanted.items()]
    return jax.tree.unflatten(structure, leaves)


def _restored(folder: Path, like: Any) -> Any:
    return _unflat(_load_tree(folder), like, folder.parent)


def _checkpointer() -> Any:
    import orbax.checkpoint as ocp  # imported here: it takes half a second

    return ocp.Checkpointer(ocp.PyTreeCheckpointHandler())


def _save_tree(folder: Path, tree: Mapping[str, Any]) -> None:
    """Save synchronously. Arrays go in as NumPy arrays, so that no device layout is stored."""
    with _checkpointer() as checkpointer:
        checkpointer.save(folder.absolute(), dict(tree))


def _load_tree(folder: Path) -> dict[str, Any]:
    try:
        with _checkpointer() as checkpointer:
            return dict(checkpointer.restore(folder.absolute()))
    except (ValueError, OSError, KeyError, RuntimeError) as error:
        raise _damaged(folder, error) from error


@contextmanager
def _refusals_explained(folder: Path | str) -> Iterator[None]:
    """Turn what orbax says where the disk refuses into a StateError; it keeps no error number.

    Orbax also logs each refusal with its traceback, which would bury the one line that is printed.
    """
    log = logging.getLogger("absl")
    before, log.disabled = log.disabled, True
    try:
        yield
    except (OSError, StateError):
        raise
    except Exception as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise StateError(
            f"checkpoint {folder} could not be written: {reason}",
            "free some space or choose another folder, then resume",
        ) from error
    finally:
        log.disabled = before


def _progress_folders(root: Path) -> list[Path]:
    """Whole progress checkpoints, oldest first."""
    named = ((_PROGRESS_NAME.fullmatch(path.name), path) for path in root.glob("epoch-*"))
    found = [(int(match[1]), path) for match, path in named if match]
    return [path for _, path in sorted(found) if (path / CHECKSUMS_NAME).is_file()]
