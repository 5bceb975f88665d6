"""Rollouts: equal to a tick-by-tick loop over the timeline, whatever runs beside an episode."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hover import HORIZON, STEPS, evaluate

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy
from rtc_cli.errors import DivergedError, UsageError
from rtc_cli.execution.inference import ChunkMaker, chunk_noise, infer, noise_key
from rtc_cli.execution.methods import Method, get_method
from rtc_cli.execution.rollout import evaluate_cell, is_beyond_trained, method_sampler
from rtc_cli.execution.timeline import HOLD, timeline
from rtc_cli.results import EPISODE_COLUMNS
from rtc_cli.samplers import get_sampler
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import (
    Observe,
    Scene,
    Status,
)

LABELS = {"train_seed", "protocol", "policy", "cell"}


def tick_by_tick(
    scene: Scene, policy: Policy, method: Method, s: int, d: int, episode: int, hold: str
) -> tuple[np.ndarray, int, int]:
    """(normalised actions, length, status) of one episode, one control tick at a time."""
    plan = timeline(
        horizon=HORIZON, exec_horizon=s, delay=d, ticks=scene.max_ticks, schedule=method.schedule
    )
    maker = ChunkMaker(
        policy, ChunkGeometry(HORIZON, s, 0 if method.schedule == "oracle" else d),
        flow_steps=STEPS, task=scene.name, eval_seed=3, tile=16,
    )  # fmt: skip
    numbers = np.array([episode])
    # Under `oracle`, token 0 of a chunk is due d ticks after the start of its inference.
    late = d if method.schedule == "oracle" else 0
    starts = {window.start: window for window in plan.inferences}
    actions: list[np.ndarray] = []
    with WorldBatch(scene, 1) as world:
        observed = world.reset(numbers)
        chunks = [maker.first(get_sampler("plain"), observed, numbers)[0, 0]]
        since = [0]  # tick at which token 0 is due
        for tick in range(scene.max_ticks):
            if tick in starts:
                overlap = np.full((1, HORIZON, scene.action_dim), np.nan, np.float32)
                rest = chunks[-1][tick - since[-1] :]
                overlap[0, : len(rest)] = rest
                overlap[0, HORIZON - s :] = 7.0  # must not matter
                overlap = np.nan_to_num(overlap)
                if late:
                    committed = np.asarray(policy.normaliser.physical(rest[:d]).array)
                    observed = world.predict(committed[None])
                new = maker.next(
                    method_sampler(method), observed, numbers, np.array([tick]), overlap
                )
                chunks.append(new[0, 0])
                since.append(tick + late)
            if plan.chunk[tick] != HOLD:
                actions.append(chunks[plan.chunk[tick]][plan.index[tick]])
            else:
                actions.append(actions[-1] if hold == "last" else maker.zero_action[0])
            physical = np.asarray(policy.normaliser.physical(actions[-1]).array)
            record = world.step(physical[None, None])
            observed = record.obs
            if record.status[0] != Status.RUNNING:
                break
    return np.array(actions), len(actions), int(record.status[0])


@pytest.mark.parametrize(
    ("name", "s", "d", "hold"),
    [
        ("naive", 1, 0, "last"),
        ("naive", 2, 2, "last"),
        ("pinv", 4, 3, "last"),
        ("prefix", 3, 2, "last"),
        ("sync", 3, 2, "last"),
        ("sync", 4, 1, "zero"),
        ("oracle", 3, 2, "last"),
        ("oracle", 4, 4, "last"),
    ],
)
def test_a_rollout_follows_the_timeline(
    scene: Scene, policy: Policy, worlds: WorldBatch, name: str, s: int, d: int, hold: str
) -> None:
    method = get_method(name)
    rows = evaluate(scene, policy, method, s, d, range(5), hold=hold, worlds=worlds)
    for episode in (0, 4):
        actions, length, status = tick_by_tick(scene, policy, method, s, d, episode, hold)
        row = rows.iloc[episode]
        assert (row.episode, row.length, row.status) == (episode, length, status)
        change = np.abs(np.diff(actions.astype(np.float64), axis=0)).mean()
        assert row.action_delta == pytest.approx(change, rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("s", [1, 4])
def test_without_delay_the_oracle_is_naive(
    scene: Scene, policy: Policy, worlds: WorldBatch, s: int
) -> None:
    rows = [
        evaluate(scene, policy, get_method(name), s, 0, range(20), worlds=worlds)
        for name in ("naive", "oracle")
    ]
    labels = ["method", "schedule"]
    pd.testing.assert_frame_equal(rows[0].drop(columns=labels), rows[1].drop(columns=labels))


class Spy:
    """One world, stepped tick by tick, that remembers what it showed and what was predicted."""

    n = 1

    def __init__(self, worlds: WorldBatch) -> None:
        self.worlds = worlds
        self.shown: list[np.ndarray] = []
        self.predicted: list[tuple[int, np.ndarray]] = []  # (tick it is for, observation)

    def reset(self, seeds: Any, worlds: Any = None) -> Any:
        self.shown = [self.worlds.reset(seeds, worlds)]
        return self.shown[0]

    def step(self, actions: np.ndarray, worlds: Any = None) -> Any:
        before = len(self.shown)
        for tick in range(actions.shape[1]):
            record = self.worlds.step(actions[:, tick : tick + 1], worlds)
            if not record.ticks[0]:
                break
            self.shown.append(record.obs)
        return replace(record, ticks=np.array([len(self.shown) - before], np.int32))

    def predict(self, actions: np.ndarray, worlds: Any = None) -> Any:
        seen = self.worlds.predict(actions, worlds)
        self.predicted.append((len(self.shown) - 1 + actions.shape[1], seen))
        return seen

    def push(self, change: np.ndarray, worlds: Any = None) -> None:
        self.worlds.push(change, worlds)


def test_without_noise_the_oracle_sees_what_its_first_token_will_meet(
    scene: Scene, policy: Policy
) -> None:
    calm = replace(scene, name="calm", action_noise=0.0)
    with WorldBatch(calm, 1) as worlds:
        spy = Spy(worlds)
        evaluate(calm, policy, get_method("oracle"), 3, 2, [4], worlds=spy)
    met = [(tick, seen) for tick, seen in spy.predicted if tick < len(spy.shown) - 1]
    assert len(met) > 5
    assert [tick for tick, _ in met] == list(range(2, 2 + 3 * len(met), 3))
    for tick, seen in met:
        np.testing.assert_allclose(seen, spy.shown[tick], atol=1e-5)


def test_twins_measure_the_reaction_and_change_nothing_else(scene: Scene, policy: Policy) -> None:
    """A sideways push shows in a sideways velocity; the scene's own observations lack one."""
    sideways = Observe(kind="vx", body="disc", scale=0.1)
    seen = replace(scene, name="seen", observations=(*scene.observations[:2], sideways))
    naive = get_method("naive")
    plain = evaluate(seen, policy, naive, 3, 2, range(20))
    rows = evaluate(seen, policy, naive, 3, 2, range(20), reaction_episodes=12)
    measured = rows.measured_reaction_ticks
    assert measured[12:].isna().all()
    assert measured[:12].notna().sum() >= 3
    assert (measured.dropna() >= 2).all()  # never before d ticks have passed
    column = ["measured_reaction_ticks"]
    pd.testing.assert_frame_equal(rows.drop(columns=column), plain.drop(columns=column))
    unseen = evaluate(scene, policy, naive, 3, 2, range(6), reaction_episodes=6)
    assert unseen.measured_reaction_ticks.isna().all()


@pytest.mark.parametrize(("name", "s", "d"), [("pinv", 2, 2), ("oracle", 4, 3), ("sync", 4, 2)])
def test_rows_do_not_depend_on_what_runs_beside_them(
    scene: Scene, policy: Policy, worlds: WorldBatch, name: str, s: int, d: int
) -> None:
    """1, 7, 64 and 200 episodes, any order, few or many worlds: identical bit for bit."""
    method = get_method(name)
    everything = evaluate(scene, policy, method, s, d, range(200))
    few_worlds = evaluate(scene, policy, method, s, d, range(200), worlds=worlds)
    pd.testing.assert_frame_equal(everything, few_worlds, check_exact=True)
    for count in (1, 7, 64):
        part = evaluate(scene, policy, method, s, d, range(count), worlds=worlds)
        pd.testing.assert_frame_equal(everything[:count], part, check_exact=True)
    order = [31, 5, 140, 0]
    shuffled = evaluate(scene, policy, method, s, d, order, worlds=worlds)
    expected = everything.iloc[order].reset_index(drop=True)
    pd.testing.assert_frame_equal(shuffled, expected, check_exact=True)


@pytest.mark.slow
def test_rows_do_not_depend_on_the_number_of_workers(scene: Scene, policy: Policy) -> None:
    one = evaluate(scene, policy, get_method("naive"), 2, 1, range(40))
    two = evaluate(scene, policy, get_method("naive"), 2, 1, range(40), workers=2)
    pd.testing.assert_frame_equal(one, two, check_exact=True)


def test_columns_are_those_of_the_store_but_the_callers_labels(
    scene: Scene, policy: Policy, worlds: WorldBatch
) -> None:
    rows = evaluate(scene, policy, get_method("pinv"), 2, 2, range(3), worlds=worlds)
    assert set(rows) == set(EPISODE_COLUMNS) - LABELS
    assert rows.settings[0] == ('{"mask": "exp", "max_guidance_weight": 5.0, "prior_std": 1.0}')
    assert rows.scene[0] == scene.digest


def test_metrics_of_samplers(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    naive, prefix = (
        evaluate(scene, policy, get_method(name), 2, 2, range(16), worlds=worlds)
        for name in ("naive", "prefix")
    )
    assert (naive.prefix_error > 0).all()
    assert prefix.prefix_error.isna().all()
    assert (naive.seam_gap > 0).all()
    sync = evaluate(scene, policy, get_method("sync"), 2, 2, range(16), worlds=worlds)
    assert sync.seam_gap.isna().all()
    assert sync.prefix_error.isna().all()
    assert (sync.waiting_ticks > 0).all()
    assert (naive.waiting_ticks == 0).all()
    no_delay = evaluate(scene, policy, get_method("naive"), 2, 0, range(16), worlds=worlds)
    assert no_delay.prefix_error.isna().all()


def test_methods_share_world_and_noise(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    """At d = 0 the same checkpoint's plain and prefix samplers give the same episodes."""
    naive, prefix = (
        evaluate(scene, policy, Method(name, "base", name), 2, 0, range(8), worlds=worlds)
        for name in ("plain", "prefix")
    )
    assert naive.length.tolist() == prefix.length.tolist()


def test_noise_is_a_function_of_episode_and_tick() -> None:
    key = noise_key(0, "catcher")
    episodes, ticks = jnp.array([3, 4, 3, 3]), jnp.array([0, 0, 5, -1])
    draw = jax.jit(chunk_noise, static_argnames="shape")
    noise = draw(key, episodes, ticks, shape=(8, 2))
    alone = draw(key, episodes.at[:2].set(9), ticks, shape=(8, 2))
    assert (noise[2:] == alone[2:]).all()
    flat = np.asarray(noise).reshape(4, -1)
    assert len(np.unique(flat)) == flat.size
    for other in (noise_key(1, "catcher"), noise_key(0, "lunar_lander")):
        assert (draw(other, episodes, ticks, shape=(8, 2)) != noise).all()


def test_rows_tell_the_noise_of_their_worlds(scene: Scene, policy: Policy) -> None:
    naive = get_method("naive")
    calm, own = (
        evaluate(replace(scene, action_noise=noise), policy, naive, 2, 2, range(12))
        for noise in (0.0, scene.action_noise)
    )
    assert set(calm["action_noise"]) == {0.0}
    assert set(own["action_noise"]) == {scene.action_noise}
    assert not set(calm["scene"]) & set(own["scene"])
    assert (calm["action_delta"] != own["action_delta"]).any()


def test_one_program_serves_all_cells(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    evaluate(scene, policy, get_method("prefix"), 2, 1, range(3), worlds=worlds)
    compiled = infer._cache_size()
    other = jax.tree.map(lambda leaf: 1.1 * leaf, policy)
    evaluate(scene, other, get_method("prefix"), 4, 3, range(9), worlds=worlds, eval_seed=8)
    assert infer._cache_size() == compiled


def test_progress_counts_episodes(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    seen: list[tuple[int, int]] = []
    evaluate(
        scene, policy, get_method("naive"), 4, 0, range(9), worlds=worlds,
        progress=lambda done, total: seen.append((done, total)),
    )  # fmt: skip
    assert seen[-1] == (9, 9)
    assert seen == sorted(seen)


def test_beyond_trained() -> None:
    prefix, pinv, untrained = (get_method(n) for n in ("prefix", "pinv", "base+prefix"))
    assert not is_beyond_trained(prefix, 4, (0, 1, 2, 3, 4))
    assert is_beyond_trained(prefix, 3, (0, 1, 2))
    assert is_beyond_trained(untrained, 1, None)
    assert not is_beyond_trained(untrained, 0, None)
    assert not is_beyond_trained(pinv, 4, None)


def test_a_policy_with_nan_is_refused(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    broken = jax.tree.map(lambda leaf: leaf * jnp.nan, policy)
    with pytest.raises(DivergedError, match="NaN or infinity on task hover, episode 4"):
        evaluate(scene, broken, get_method("naive"), 2, 1, [4, 5], worlds=worlds)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": [1, 1]}, "2 episodes, 1 of them different"),
        ({"episodes": []}, "0 episodes"),
        ({"hold": "lst"}, r'unknown hold "lst".*Did you mean "last"'),
        ({"tile": 0}, "tile 0"),
    ],
)
def test_bad_arguments(scene: Scene, policy: Policy, change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"episodes": [0]} | change
    with pytest.raises(UsageError, match=message):
        evaluate(scene, policy, get_method("naive"), 2, 1, **arguments)


def test_horizon_must_be_the_policys(scene: Scene, policy: Policy) -> None:
    with pytest.raises(UsageError, match="horizon 16 does not fit a policy of horizon 8"):
        evaluate_cell(
            scene, policy, get_method("naive"), ChunkGeometry(16, 2, 1),
            flow_steps=2, episodes=[0], eval_seed=0,
        )  # fmt: skip
