"""Rollouts under delays that vary: a tick-by-tick loop, pairing, and the constant special case."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from hover import HORIZON, STEPS, evaluate
from slow_clock import HOLD, slow_async

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy
from rtc_cli.errors import PartialResult
from rtc_cli.execution.delay_models import DelayModel, read_delay_model
from rtc_cli.execution.estimators import read_estimator
from rtc_cli.execution.inference import ChunkMaker
from rtc_cli.execution.methods import get_method
from rtc_cli.execution.rollout import method_sampler
from rtc_cli.execution.timing import Timing, plain
from rtc_cli.execution.varying import draw_delays
from rtc_cli.samplers import get_sampler
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

LONG_TAIL = "mixture:0.6*uniform:0-2+0.4*uniform:4-9"


def timing(model: str = LONG_TAIL, estimator: str = "exact", **options: Any) -> Timing:
    return Timing(read_delay_model(model), read_estimator(estimator), **options)


def tick_by_tick(
    scene: Scene, policy: Policy, name: str, s: int, asked: Timing, episode: int, hold: str
) -> tuple[np.ndarray, int, int]:
    """(normalised actions, starved ticks, status) of one episode, one control tick at a time.

    Every request goes to a sampler of its own with one legal (s, d), as a constant delay's would.
    """
    numbers, method = np.array([episode]), get_method(name)
    slow = slow_async(
        draw_delays(asked.model, scene, 3, numbers)[0].tolist(),
        horizon=HORIZON, s=s, ticks=scene.max_ticks, estimator=asked.estimator.text,
        before=asked.delay, discard=asked.on_late == "discard",
    )  # fmt: skip

    def maker(s: int, d: int) -> ChunkMaker:
        geometry = ChunkGeometry(HORIZON, s, d)
        return ChunkMaker(policy, geometry, flow_steps=STEPS, task=scene.name, eval_seed=3, tile=16)

    requests = {tick: (realised, told) for tick, realised, told, _ in slow.requests}
    actions: list[np.ndarray] = []
    with WorldBatch(scene, 1) as world:
        seen = [world.reset(numbers)]
        chunks = [maker(s, 0).first(get_sampler("plain"), seen[0], numbers)[0, 0]]
        for tick, (chunk, index) in enumerate(slow.acting):
            if tick in requests:
                realised, told = requests[tick]
                # What acts now and hereafter, as far as the chunk that acted last reaches.
                running, at = running_chunk(slow.answers, requests, tick)
                rest = chunks[running][at:]
                overlap = np.zeros((1, HORIZON, scene.action_dim), np.float32)
                overlap[0, : len(rest)] = rest
                observed = seen[max(tick - asked.observation_lag, 0)]
                new = maker(realised, told).next(
                    method_sampler(method), observed, numbers, np.array([tick]), overlap
                )
                chunks.append(new[0, 0])
            if chunk != HOLD:
                actions.append(chunks[chunk][index])
            else:
                actions.append(actions[-1] if hold == "last" else maker(s, 0).zero_action[0])
            physical = np.asarray(policy.normaliser.physical(actions[-1]).array)
            record = world.step(physical[None, None])
            seen.append(record.obs)
            if record.status[0] != Status.RUNNING:
                break
    starved = sum(chunk == HOLD for chunk, _ in slow.acting[: len(actions)])
    return np.array(actions), starved, int(record.status[0])


def running_chunk(
    answers: list[tuple[int, int]], requests: dict[int, Any], tick: int
) -> tuple[int, int]:
    """(number, index) of the newest chunk that is usable when the inference of `tick` starts."""
    number = {start: k for k, start in enumerate(requests, start=1)}
    usable = [start for start, arrival in answers if arrival <= tick and start < tick]
    return (number[usable[-1]], tick - usable[-1]) if usable else (0, tick)


@pytest.mark.parametrize(
    ("name", "s", "asked", "hold"),
    [
        ("naive", 1, timing(), "last"),
        ("pinv", 3, timing(), "last"),
        ("pinv", 2, timing(estimator="max-of-last:3"), "zero"),
        ("prefix", 2, timing(estimator="percentile:0.7", on_late="discard"), "zero"),
        ("prefix", 4, timing(estimator="constant:1"), "last"),
        ("naive", 2, timing(observation_lag=1), "last"),
        ("prefix", 3, timing(observation_lag=5), "last"),
    ],
)
def test_a_rollout_follows_the_slow_simulation(
    scene: Scene, policy: Policy, worlds: WorldBatch, name: str, s: int, asked: Timing, hold: str
) -> None:
    rows = evaluate(
        scene, policy, get_method(name), s, 0, range(12), hold=hold, worlds=worlds, timing=asked
    )
    for episode in (0, 4, 11):
        actions, starved, status = tick_by_tick(scene, policy, name, s, asked, episode, hold)
        row = rows.iloc[episode]
        assert (row.length, row.status, row.starved_ticks) == (len(actions), status, starved)
        for order, column in ((1, "action_delta"), (2, "action_delta2")):
            change = np.abs(np.diff(actions.astype(np.float64), n=order, axis=0)).mean()
            assert row[column] == pytest.approx(change, rel=1e-5, nan_ok=True)
    assert rows.starved_ticks.sum() > 0


@pytest.mark.parametrize(
    ("name", "s", "d"),
    [
        ("naive", 1, 0),
        ("pinv", 2, 2),
        ("pinv-detached", 3, 1),
        ("prefix", 4, 3),
        ("sync", 3, 2),
        ("oracle", 4, 3),
    ],
)
def test_one_constant_delay_gives_the_same_rows_bit_for_bit(
    scene: Scene, policy: Policy, worlds: WorldBatch, name: str, s: int, d: int
) -> None:
    options: dict[str, Any] = {"worlds": worlds, "reaction_episodes": 8, "trained_support": (0, 1)}
    cell = evaluate(scene, policy, get_method(name), s, d, range(40), **options)
    model = evaluate(scene, policy, get_method(name), s, d, range(40), timing=plain(d), **options)
    assert cell.delay_model.unique().tolist() == [f"constant:{d}"]
    pd.testing.assert_frame_equal(cell, model, check_exact=True, check_dtype=False)


@pytest.mark.parametrize("name", ["prefix", "pinv", "sync", "oracle"])
def test_nothing_but_the_episode_matters(
    scene: Scene, policy: Policy, worlds: WorldBatch, name: str
) -> None:
    asked = timing(estimator="max-of-last:3", observation_lag=1)

    def rows(episodes: Any, **options: Any) -> pd.DataFrame:
        frame = evaluate(scene, policy, get_method(name), 3, 0, episodes, timing=asked, **options)
        return frame.set_index("episode").sort_index()

    everything = rows(range(70), worlds=worlds, reaction_episodes=70)
    few = rows([41, 3, 17], reaction_episodes=3)
    shared = rows(range(0, 70, 7), workers=2, reaction_episodes=10)
    for part in (few, shared):
        pd.testing.assert_frame_equal(part, everything.loc[part.index], check_exact=True)


def test_delays_are_those_of_the_episode(scene: Scene) -> None:
    model = read_delay_model("uniform:0-4")
    draws = draw_delays(model, scene, 3, np.arange(6))
    np.testing.assert_array_equal(draw_delays(model, scene, 3, np.array([4, 1])), draws[[4, 1]])
    assert (draw_delays(model, scene, 4, np.arange(6)) != draws).any()
    assert len(np.unique(draws, axis=0)) == 6


class Ramp:
    """A model whose draws depend on each other: 0, 1, 2, ... up to a random end, then again."""

    text = content = "ramp"
    mean, largest = 1.0, 3

    def capped(self, cap: int) -> DelayModel:
        return self

    def sequence(self, generator: np.random.Generator, count: int) -> np.ndarray:
        return np.arange(count) % (2 + generator.integers(2))


def test_a_model_may_draw_an_episode_as_a_whole(
    scene: Scene, policy: Policy, worlds: WorldBatch
) -> None:
    draws = draw_delays(Ramp(), scene, 3, np.arange(20))
    assert {tuple(row[:4]) for row in draws} == {(0, 1, 0, 1), (0, 1, 2, 0)}
    rows = evaluate(
        scene, policy, get_method("naive"), 2, 1, range(8), timing=Timing(Ramp()), worlds=worlds
    )
    assert set(rows.delay_model) == {"ramp"}
    assert set(rows.delay) == {1}


def test_discarded_chunks_never_act(scene: Scene, policy: Policy, worlds: WorldBatch) -> None:
    """Told 0 and always late: with `discard` the robot has the free chunk and nothing more."""
    options: dict[str, Any] = {"hold": "zero", "worlds": worlds}
    for on_late, starves in (("play", False), ("discard", True)):
        asked = timing("constant:2", "constant:0", on_late=on_late)
        rows = evaluate(scene, policy, get_method("naive"), 2, 2, range(6), timing=asked, **options)
        arrived = (rows.length - 1) // 2
        assert (rows.late_chunks == arrived).all()
        assert (rows.dropped_chunks == (arrived if starves else 0)).all()
        expected = np.maximum(rows.length - HORIZON, 0) if starves else 0
        assert (rows.starved_ticks == expected).all()
        assert rows.seam_gap.isna().all() == starves


def exceed(scene: Scene, policy: Policy, name: str, on_exceed: str) -> pd.DataFrame:
    asked = timing("uniform:0-3", on_exceed=on_exceed)
    return evaluate(
        scene, policy, get_method(name), 4, 2, range(10), timing=asked, trained_support=(0, 1, 2)
    )


def test_delays_beyond_the_trained_ones(scene: Scene, policy: Policy) -> None:
    played = exceed(scene, policy, "prefix", "play")
    assert (played.beyond_trained == (played.exceeded_requests > 0)).all()
    assert played.beyond_trained.any()
    assert (played.late_chunks == 0).all()
    clamped = exceed(scene, policy, "prefix", "clamp")
    assert not clamped.beyond_trained.any()
    assert clamped.late_chunks.sum() > 0
    with pytest.raises(PartialResult, match="conditioned delay 3 exceeds 2, the longest") as caught:
        exceed(scene, policy, "prefix", "fail")
    assert caught.value.exit_code == 5
    assert "--on-exceed play or clamp" in caught.value.hint
    # Only a sampler that needs the training has a longest delay.
    assert not exceed(scene, policy, "pinv", "fail").exceeded_requests.any()


def test_clamped_requests_are_the_sampler_s_business_only(scene: Scene, policy: Policy) -> None:
    """Clamping to what is never exceeded changes nothing but the label."""
    rows = [
        evaluate(
            scene, policy, get_method("prefix"), 4, 2, range(10),
            timing=timing("uniform:0-3", on_exceed=how), trained_support=range(5),
        ).drop(columns="on_exceed")
        for how in ("play", "clamp")
    ]  # fmt: skip
    pd.testing.assert_frame_equal(*rows)


def test_the_oracle_and_sync_are_never_late(
    scene: Scene, policy: Policy, worlds: WorldBatch
) -> None:
    rows = {
        name: evaluate(
            scene, policy, get_method(name), 2, 0, range(10), timing=timing(), worlds=worlds
        )
        for name in ("naive", "oracle", "sync")
    }
    assert rows["naive"].late_chunks.sum() > 0
    for name in ("oracle", "sync"):
        assert not rows[name][["late_chunks", "dropped_chunks", "clipped_requests"]].any(axis=None)
    assert rows["sync"].waiting_ticks.sum() > 0
    assert not rows["sync"].starved_ticks.any()


def test_the_oracle_ignores_old_observations(
    scene: Scene, policy: Policy, worlds: WorldBatch
) -> None:
    def run(name: str, lag: int) -> pd.DataFrame:
        asked = timing("uniform:0-2", observation_lag=lag)
        rows = evaluate(
            scene, policy, get_method(name), 2, 1, range(8), timing=asked, worlds=worlds
        )
        return rows.drop(columns="observation_lag")

    pd.testing.assert_frame_equal(run("oracle", 0), run("oracle", 3))
    assert not run("naive", 0).equals(run("naive", 3))
