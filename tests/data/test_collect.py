"""Recording: what is kept does not depend on how it was run; what is damaged is refused."""

import json

import numpy as np
import pytest
from pointmass import PointScene, PointWorlds

from rtc_cli.data.chunks import chunk_windows
from rtc_cli.data.collect import collect, first_data_episode
from rtc_cli.data.episodes import EpisodeStore
from rtc_cli.errors import DivergedError, StateError, UsageError
from rtc_cli.files import write_checksums

ARRAYS = ("observations", "actions", "lengths", "episodes", "status", "expert")


class Wanderer:
    """Goes home with an error that depends on (episode, tick); two kinds, by the episode."""

    expert_ids = ("calm", "wild")

    def expert_of(self, episode):
        return (np.asarray(episode) % 2).astype(np.int32)

    def __call__(self, obs, episode, tick):
        error = np.sin(np.stack([episode * 7.1 + tick, episode * 3.3 - tick], axis=-1))
        home = -obs[:, :2] - obs[:, 2:]
        return (home + (0.3 + self.expert_of(episode)[:, None]) * error).astype(np.float32)


def record(folder, transitions=300, scene=None, actor=None, make_worlds=PointWorlds, **options):
    options = {"first_episode": 1000, "seed": 5, "worlds": 16, **options}
    return collect(
        scene or PointScene(),
        actor or Wanderer(),
        transitions,
        folder=folder,
        make_worlds=make_worlds,
        **options,
    )


def content(store):
    return {name: np.array(getattr(store, name)) for name in ARRAYS}


def assert_same(one, other):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def slow_record(scene, actor, transitions, first_episode):
    """One world, one episode after the other."""
    obs_rows, action_rows, lengths, status = [], [], [], []
    episode = first_episode
    while len(action_rows) < transitions:
        worlds = PointWorlds(scene, 1)
        obs, tick, state = worlds.reset(np.array([episode])), 0, 0
        while state == 0:
            action = actor(obs, np.array([episode]), np.array([tick]))
            obs_rows.append(obs[0])
            action_rows.append(action[0])
            step = worlds.step(action[:, None])
            obs, state, tick = step.obs, int(step.status[0]), tick + 1
        lengths.append(tick)
        status.append(state)
        episode += 1
    return np.array(obs_rows), np.array(action_rows), lengths, status


def test_the_record_is_that_of_one_episode_after_the_other(tmp_path):
    store = record(tmp_path / "data")
    obs, actions, lengths, status = slow_record(PointScene(), Wanderer(), 300, 1000)
    np.testing.assert_array_equal(store.observations, obs)
    np.testing.assert_array_equal(store.actions, actions)
    assert store.lengths.tolist() == lengths
    assert store.status.tolist() == status
    assert store.starts.tolist() == [0, *np.cumsum(lengths)[:-1]]
    assert store.episodes.tolist() == list(range(1000, 1000 + len(lengths)))
    assert store.expert.tolist() == [episode % 2 for episode in store.episodes]
    assert store.transitions >= 300
    assert store.transitions - lengths[-1] < 300


@pytest.mark.parametrize("options", [{"worlds": 1}, {"worlds": 7}, {"worlds": 64, "workers": 2}])
def test_worlds_and_workers_do_not_matter(tmp_path, options):
    assert_same(record(tmp_path / "a"), record(tmp_path / "b", **options))


def test_less_data_is_the_beginning_of_more(tmp_path):
    less, more = record(tmp_path / "a", 100), record(tmp_path / "b", 400)
    np.testing.assert_array_equal(less.actions, more.actions[: less.transitions])


def test_broken_worlds_are_left_out_and_counted(tmp_path):
    scene = PointScene(broken_seeds=(1001, 1004, 1005))
    whole = record(tmp_path / "whole", 600)
    for worlds in (1, 16, 200):
        store = record(tmp_path / f"broken{worlds}", scene=scene, worlds=worlds)
        assert store.manifest["invalid_episodes"] == 3
        assert store.episodes[:4].tolist() == [1000, 1002, 1003, 1006]
        assert store.transitions >= 300
        kept = np.isin(np.repeat(whole.episodes, whole.lengths), store.episodes)
        np.testing.assert_array_equal(store.actions, whole.actions[kept])


def test_a_task_whose_worlds_all_break_is_refused(tmp_path):
    scene = PointScene(broken_seeds=tuple(range(1000, 3000)))
    with pytest.raises(DivergedError, match="pointmass became NaN"):
        record(tmp_path / "data", scene=scene)
    assert not list(tmp_path.iterdir())


def test_an_actor_with_nan_is_refused(tmp_path):
    def actor(obs, episode, tick):
        return np.where(tick[:, None] == 4, np.nan, obs[:, :2])

    with pytest.raises(DivergedError, match="episode 1000, tick 4"):
        record(tmp_path / "data", actor=actor)
    assert not list(tmp_path.iterdir())


def test_an_interrupted_recording_leaves_nothing(tmp_path):
    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "data", progress=stop)
    assert not list(tmp_path.iterdir())


def test_a_plain_function_may_act(tmp_path):
    store = record(tmp_path / "data", actor=lambda obs, episode, tick: -obs[:, :2])
    assert set(store.expert.tolist()) == {-1}
    assert store.manifest["expert_ids"] == []


def test_progress_tells_how_far_it_is(tmp_path):
    seen = []
    store = record(tmp_path / "data", progress=seen.append)
    last = {"transitions": store.transitions, "target": 300, "episodes": len(store.lengths)}
    assert seen[-1] == last


def test_present_data_are_used_and_other_data_refused(tmp_path):
    class Idle(Wanderer):
        def __call__(self, obs, episode, tick):
            raise AssertionError("it was recorded already")

    first = record(tmp_path / "data")
    assert_same(first, record(tmp_path / "data", actor=Idle()))
    with pytest.raises(StateError, match="seed is 5, not 6"):
        record(tmp_path / "data", seed=6)
    with pytest.raises(StateError, match="expert_ids"):
        record(tmp_path / "data", actor=lambda obs, episode, tick: obs)


@pytest.mark.parametrize("name", ["observations.npy", "expert.npy", "manifest.json"])
def test_a_flipped_byte_is_refused(tmp_path, name):
    record(tmp_path / "data")
    file = tmp_path / "data" / name
    whole = bytearray(file.read_bytes())
    whole[-3] ^= 4
    file.write_bytes(whole)
    with pytest.raises(StateError, match=name):
        EpisodeStore.open(tmp_path / "data")


def test_missing_and_foreign_folders_are_refused(tmp_path):
    with pytest.raises(StateError, match="nowhere"):
        EpisodeStore.open(tmp_path / "nowhere")
    record(tmp_path / "data")
    (tmp_path / "data" / "actions.npy").unlink()
    with pytest.raises(StateError, match=r"actions\.npy"):
        EpisodeStore.open(tmp_path / "data")


def rewrite_manifest(folder, **changes):
    file = folder / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    write_checksums(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 9}, "schema 9"),
        ({"transitions": 7}, "lengths.npy"),
        ({"obs_dim": 3}, "observations.npy"),
        ({"episodes": 2}, "lengths.npy"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(tmp_path, changes, message):
    record(tmp_path / "data")
    rewrite_manifest(tmp_path / "data", **changes)
    with pytest.raises(StateError, match=message):
        EpisodeStore.open(tmp_path / "data")


def test_nan_in_the_data_is_named_with_file_and_row(tmp_path):
    store = record(tmp_path / "data")
    row = int(store.starts[2]) + 1
    actions = np.array(store.actions)
    actions[row, 1] = np.nan
    np.save(tmp_path / "data" / "actions.npy", actions)
    write_checksums(tmp_path / "data")
    store = EpisodeStore.open(tmp_path / "data")
    for check in (store.verify, lambda: chunk_windows(store, 4)):
        with pytest.raises(StateError, match=rf"actions\.npy.*row {row} \(episode 1002\)") as error:
            check()
        assert "run again" in error.value.hint


def test_chunks_of_a_store(tmp_path):
    store = record(tmp_path / "data")
    chunks = chunk_windows(store, 8)
    assert chunks.horizon == 8
    assert len(chunks) == store.transitions
    np.testing.assert_array_equal(chunks.observations, store.observations)
    np.testing.assert_array_equal(chunks.actions[:, 0], store.actions)
    last = store.starts + store.lengths - 1
    assert (chunks.valid[last].sum(axis=1) == 1).all()


def test_arrays_are_memory_mapped_and_read_only(tmp_path):
    store = record(tmp_path / "data")
    assert isinstance(store.actions, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        store.actions[0] = 0.0


def test_seeds_of_training_runs_do_not_meet():
    assert first_data_episode(0) == 1_000_000
    assert first_data_episode(3) == 4_000_000


def test_nothing_cannot_be_recorded(tmp_path):
    with pytest.raises(UsageError, match="0 transitions"):
        record(tmp_path / "data", 0)
