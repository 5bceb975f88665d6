"""Checkpoints: whole or absent, every byte checked, never unpickled; exact resume from disk."""

import dataclasses
import errno
import json
import pickle
import shutil

import jax
import numpy as np
import pytest

from rtc_cli import files
from rtc_cli.core.delays import DelayDistribution
from rtc_cli.errors import DivergedError, StateError
from rtc_cli.training import checkpoints
from rtc_cli.training.checkpoints import (
    Expected,
    export_policy,
    import_policy,
    latest_progress,
    load_checkpoint,
    load_policy,
    policy_digest,
    read_meta,
    save_checkpoint,
    save_progress,
)
from rtc_cli.training.loop import fit, initial_state


@pytest.fixture
def state(policy, config):
    return dataclasses.replace(initial_state(policy.params, config, seed=5), epoch=2)


@pytest.fixture
def folder(tmp_path, state, meta):
    save_checkpoint(tmp_path / "base", state, meta)
    return tmp_path / "base"


def test_what_is_saved_comes_back_bit_for_bit(folder, state, meta, policy, same_bits):
    loaded, description = load_checkpoint(folder, expect=meta)
    assert same_bits(loaded.params, state.params)
    assert same_bits(loaded.opt_state, state.opt_state)
    assert same_bits(loaded.key_data, state.key_data)
    assert loaded.epoch == description.epoch == 2
    assert same_bits(description.normaliser, meta.normaliser)
    for name in ("task", "kind", "train_seed", "epochs", "config", "recipe_hash", "scene_digest"):
        assert getattr(description, name) == getattr(meta, name)
    assert description.delays.support == (0, 1, 2)
    np.testing.assert_allclose(description.delays.weights, meta.delays.weights, rtol=1e-12)
    assert policy_digest(load_policy(folder)) == policy_digest(policy)


def test_fit_from_disk_gives_the_same_bits(tmp_path, policy, windows, config, meta, same_bits):
    delays = DelayDistribution.uniform((0, 1, 2))
    whole = fit(policy, windows, config, seed=1, delays=delays)
    half = fit(policy, windows, config, seed=1, delays=delays, stop_epoch=2)
    save_checkpoint(tmp_path / "half", half.state, meta)
    state, _ = load_checkpoint(tmp_path / "half")
    rest = fit(load_policy(tmp_path / "half"), windows, config, seed=1, delays=delays, state=state)
    assert same_bits(rest.state.params, whole.state.params)
    assert same_bits(rest.state.opt_state, whole.state.opt_state)


def test_ordinary_training_has_no_delays(tmp_path, state, meta):
    save_checkpoint(tmp_path / "c", state, dataclasses.replace(meta, delays=None))
    assert read_meta(tmp_path / "c").delays is None


def test_reading_never_unpickles(folder, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    load_checkpoint(folder)
    load_policy(folder)


def test_a_flipped_byte_in_any_file_is_found_and_named(folder, tmp_path):
    names = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file()]
    assert len(names) > 5
    for name in names:
        copy = tmp_path / "copy"
        shutil.copytree(folder, copy)
        content = bytearray((copy / name).read_bytes())
        if not content:
            shutil.rmtree(copy)
            continue
        content[len(content) // 2] ^= 1
        (copy / name).write_bytes(content)
        with pytest.raises(StateError, match=r"damaged|not match") as caught:
            load_checkpoint(copy)
        # A flip inside CHECKSUMS.json shows as another file's mismatch.
        assert name.name in caught.value.message or name.name == "CHECKSUMS.json"
        assert "remove" in caught.value.hint
        shutil.rmtree(copy)


def test_a_missing_file_is_named(folder):
    (folder / "meta.json").unlink()
    with pytest.raises(StateError, match=r"meta\.json is missing"):
        load_policy(folder)


@pytest.mark.parametrize("name", ["weights.pkl", "weights.bin"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_pickle_is_refused_and_not_run(tmp_path, name, inside):
    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").write_text, ("x",))

    holder = tmp_path / "given"
    holder.mkdir()
    (holder / name).write_bytes(pickle.dumps(Trap()))
    for load in (load_policy, load_checkpoint, import_policy):
        with pytest.raises(StateError, match="never unpickles") as caught:
            load(holder if inside else holder / name)
        assert name in caught.value.message
    assert not (tmp_path / "ran").exists()


def test_a_pickle_beside_a_good_checkpoint_is_refused(folder):
    (folder / "policy.pkl").write_bytes(pickle.dumps({"w": 1}))
    with pytest.raises(StateError, match="never unpickles"):
        load_checkpoint(folder)


def test_a_file_or_nothing_is_no_checkpoint(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(StateError, match="not a checkpoint folder"):
        load_policy(tmp_path / "notes.txt")
    with pytest.raises(StateError, match="does not exist"):
        load_policy(tmp_path / "absent")


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        (Expected(horizon=8), "horizon 4, but 8"),
        (Expected(recipe_hash="zzz"), "recipe hash abc123, but zzz"),
        (Expected(scene_digest="zzz"), "scene digest def456, but zzz"),
        (Expected(train_seed=6), "train seed 5, but 6"),
        (Expected(obs_dim=9), "obs dim 3, but 9"),
        (Expected(kind="base"), "kind prefix, but base"),
    ],
)
def test_another_checkpoint_than_expected_is_refused_with_both_values(folder, expected, words):
    with pytest.raises(StateError, match=words) as caught:
        load_checkpoint(folder, expect=expected)
    assert caught.value.hint


def test_another_schema_is_refused(folder):
    content = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(content | {"schema": 99}))
    files.write_checksums(folder)
    with pytest.raises(StateError, match="schema 99"):
        load_policy(folder)


def test_arrays_of_another_network_are_refused(folder):
    content = json.loads((folder / "meta.json").read_text())
    content["network"]["options"]["channel_hidden"] = 16
    (folder / "meta.json").write_text(json.dumps(content))
    files.write_checksums(folder)
    with pytest.raises(StateError, match=r"block_0/channel_in has shape \(8, 8\).* \(8, 16\)"):
        load_policy(folder)


@pytest.mark.parametrize("where", ["write_checksums", "_save_tree"])
def test_a_full_disk_leaves_nothing_behind(tmp_path, state, meta, monkeypatch, where):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, where, full)
    with pytest.raises(StateError, match="disk is full"):
        save_checkpoint(tmp_path / "c", state, meta)
    assert list(tmp_path.iterdir()) == []


def test_a_refusal_inside_orbax_is_explained(tmp_path, state, meta, monkeypatch):
    def full(*args, **kwargs):
        raise ValueError("RESOURCE_EXHAUSTED: writing d/abc: File too large")

    monkeypatch.setattr(checkpoints, "_save_tree", full)
    with pytest.raises(StateError, match="could not be written: RESOURCE_EXHAUSTED"):
        save_checkpoint(tmp_path / "c", state, meta)
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_never_overwritten(folder, state, meta):
    with pytest.raises(StateError, match="exists already"):
        save_checkpoint(folder, state, meta)
    load_checkpoint(folder)


def test_progress_keeps_the_newest_and_clears_remains(tmp_path, state, meta):
    root = tmp_path / "base"
    assert latest_progress(root) is None
    for epoch in (1, 2, 3):
        (root / ".epoch-0003.x1.tmp").mkdir(parents=True, exist_ok=True)
        save_progress(root, dataclasses.replace(state, epoch=epoch), meta)
    assert sorted(p.name for p in root.iterdir()) == ["epoch-0002", "epoch-0003"]
    newest = latest_progress(root)
    assert newest is not None
    assert load_checkpoint(newest)[0].epoch == 3


def test_a_failed_save_keeps_the_older_progress(tmp_path, state, meta, monkeypatch):
    root = tmp_path / "base"
    save_progress(root, dataclasses.replace(state, epoch=1), meta)

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, "_save_tree", full)
    with pytest.raises(StateError, match="disk is full"):
        save_progress(root, dataclasses.replace(state, epoch=2), meta)
    assert [p.name for p in root.iterdir()] == ["epoch-0001"]


def test_divergence_keeps_the_last_good_checkpoint(
    tmp_path, policy, windows, config, meta, with_nan
):
    delays = DelayDistribution.uniform((0, 1, 2))
    half = fit(policy, windows, config, seed=1, delays=delays, stop_epoch=2)
    save_progress(tmp_path, half.state, meta)
    spoiled = with_nan(windows)
    spoiled.observations[:] = np.nan
    with pytest.raises(DivergedError):
        fit(
            policy,
            spoiled,
            config,
            seed=1,
            delays=delays,
            state=half.state,
            on_epoch=lambda state, _: save_progress(tmp_path, state, meta),
        )
    kept = latest_progress(tmp_path)
    assert kept is not None
    assert load_checkpoint(kept)[0].epoch == 2


def test_export_and_import_give_the_same_policy(tmp_path, policy, meta, same_bits):
    export_policy(tmp_path / "export", policy, meta)
    names = {p.name for p in (tmp_path / "export").iterdir()}
    assert names == {"policy.safetensors", "config.json", "CHECKSUMS.json"}
    imported, description = import_policy(tmp_path / "export")
    assert imported.config == policy.config
    assert same_bits(imported, policy)
    assert description.recipe_hash == "abc123"


def test_a_flipped_byte_in_an_export_is_found(tmp_path, policy, meta):
    export_policy(tmp_path / "export", policy, meta)
    file = tmp_path / "export" / "policy.safetensors"
    content = bytearray(file.read_bytes())
    content[-3] ^= 1
    file.write_bytes(content)
    with pytest.raises(StateError, match=r"policy\.safetensors does not match"):
        import_policy(tmp_path / "export")


def test_digest_depends_on_every_part(policy):
    digest = policy_digest(policy)
    params = jax.tree.map(lambda leaf: leaf, policy.params)
    params["input"]["bias"] = params["input"]["bias"].at[0].add(1e-6)
    assert policy_digest(dataclasses.replace(policy, params=params)) != digest
    normaliser = dataclasses.replace(policy.normaliser, obs_std=policy.normaliser.obs_std * 2)
    assert policy_digest(dataclasses.replace(policy, normaliser=normaliser)) != digest
    assert policy_digest(dataclasses.replace(policy)) == digest
