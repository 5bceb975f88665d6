"""Recording episodes of an actor in many worlds at once.

Episodes are numbered; they are kept whole, in the order of their numbers, up to the first at
which the transitions suffice. So the data are a function of scene, actor, first episode and
transitions: how many worlds and workers recorded them does not matter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rtc_cli.data.episodes import MANIFEST, SCHEMA, EpisodeStore, RowWriter
from rtc_cli.errors import DivergedError, StateError, UsageError
from rtc_cli.files import new_folder, write_checksums, write_json
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene, Status

# (observations (n, O), episode numbers (n,), ticks (n,)) -> physical actions (n, A)
Actor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

EPISODES_PER_SEED = 1_000_000
TOLERATED_INVALID = 100  # so many broken worlds, and more than whole episodes: the task is broken


@runtime_checkable
class MixedActor(Protocol):
    """An actor that says which of its experts acts in which episode."""

    expert_ids: tuple[str, ...]

    def expert_of(self, episode: np.ndarray) -> np.ndarray: ...


WorldsFactory = Callable[[Scene, int, int], WorldBatch]  # (scene, count, workers)


def first_data_episode(train_seed: int) -> int:
    """Return the number of the first data episode of a training seed.

    Evaluation uses episodes below 500,000, validation those from there to 1,000,000; experts
    learn on seeds from 900,000,000 on.
    """
    return EPISODES_PER_SEED * (train_seed + 1)


def collect(
    scene: Scene,
    actor: Actor,
    transitions: int,
    *,
    first_episode: int,
    seed: int,
    folder: Path | str,
    worlds: int = 256,
    workers: int = 1,
    progress: Callable[[dict[str, int]], None] | None = None,
    make_worlds: WorldsFactory = WorldBatch,
) -> EpisodeStore:
    """Record whole episodes until at least `transitions` steps are there; return them opened.

    Episode i runs in a world with seed `first_episode + i`, which is also the number that the
    actor is given; `seed` is the actor's and only recorded. Episodes whose world becomes NaN
    are left out and counted. A folder that already holds these data is returned as it is; one
    that holds others raises StateError. `progress` gets `transitions`, `target`, `episodes`.
    """
    if transitions < 1 or worlds < 1:
        raise UsageError(
            f"{transitions} transitions in {worlds} worlds are not possible", "give integers >= 1"
        )
    request = {
        "task": scene.name,
        "scene": scene.digest,
        "seed": seed,
        "first_episode": first_episode,
        "target": transitions,
        "expert_ids": list(actor.expert_ids) if isinstance(actor, MixedActor) else [],
    }
    folder = Path(folder)
    if folder.is_dir() and any(folder.iterdir()):
        return _cached(folder, request)
    count = min(worlds, transitions)
    with new_folder(folder) as temporary:
        with make_worlds(scene, count, workers) as batch:
            kept = _record(temporary, scene, actor, batch, count, request, progress)
        _write_rest(temporary, scene, actor, kept, request)
    return EpisodeStore.open(folder, verify=False)


def _cached(folder: Path, request: dict[str, Any]) -> EpisodeStore:
    store = EpisodeStore.open(folder)
    for name, wanted in request.items():
        found = store.manifest.get(name)
        if found != wanted:
            raise StateError(
                f"{folder} holds other data: {name} is {found!r}, not {wanted!r}",
                f"remove {folder} or choose another run folder",
            )
    return store


@dataclass
class _Kept:
    """What is known of the episodes that were written, in their order."""

    episodes: list[int] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    status: list[int] = field(default_factory=list)
    transitions: int = 0
    invalid: int = 0


def _record(
    folder: Path,
    scene: Scene,
    actor: Actor,
    batch: WorldBatch,
    count: int,
    request: dict[str, Any],
    progress: Callable[[dict[str, int]], None] | None,
) -> _Kept:
    kept = _Kept()
    crew = _Crew(scene, batch, count, request["first_episode"], request["target"])
    with (
        RowWriter(folder / "observations.npy", scene.obs_dim) as observations,
        RowWriter(folder / "actions.npy", scene.action_dim) as actions,
    ):
        while kept.transitions < crew.target:
            crew.start_episodes()
            crew.tick(actor)
            for episode in crew.finished_in_order():
                if kept.transitions >= crew.target:
                    break
                _keep(kept, episode, observations, actions)
                _check_invalid(kept, scene)
            if progress is not None:
                done = {"transitions": kept.transitions, "target": crew.target}
                progress({**done, "episodes": len(kept.episodes)})
    return kept


def _keep(kept: _Kept, episode: "_Episode", observations: RowWriter, actions: RowWriter) -> None:
    if episode.status == Status.INVALID:
        kept.invalid += 1
        return
    observations.append(episode.observations)
    actions.append(episode.actions)
    kept.episodes.append(episode.number)
    kept.lengths.append(len(episode.actions))
    kept.status.append(episode.status)
    kept.transitions += len(episode.actions)


def _check_invalid(kept: _Kept, scene: Scene) -> None:
    if kept.invalid > max(TOLERATED_INVALID, len(kept.episodes)):
        raise DivergedError(
            f"{kept.invalid} episodes of task {scene.name} became NaN, "
            f"{len(kept.episodes)} did not",
            "check the scene: masses, forces and joints",
        )


def _write_rest(
    folder: Path, scene: Scene, actor: Actor, kept: _Kept, request: dict[str, Any]
) -> None:
    episodes = np.array(kept.episodes, np.int64)
    expert = np.full(len(episodes), -1, np.int32)
    if isinstance(actor, MixedActor):
        expert = np.asarray(actor.expert_of(episodes), np.int32)
    np.save(folder / "lengths.npy", np.array(kept.lengths, np.int32))
    np.save(folder / "episodes.npy", episodes)
    np.save(folder / "status.npy", np.array(kept.status, np.int8))
    np.save(folder / "expert.npy", expert)
    counts = {
        "transitions": kept.transitions,
        "episodes": len(episodes),
        "invalid_episodes": kept.invalid,
        "obs_dim": scene.obs_dim,
        "action_dim": scene.action_dim,
    }
    write_json(folder / MANIFEST, {"schema": SCHEMA, **request, **counts})
    write_checksums(folder)


@dataclass(frozen=True)
class _Episode:
    number: int
    status: int
    observations: np.ndarray
    actions: np.ndarray


class _Crew:
    """Worlds that work through numbered episodes and hand them back in their order.

    An episode is run on only while those before it, as far as they have come, are too short to
    suffice; what waits keeps its world, for a broken one before it may make it needed after all.
    """

    def __init__(
        self, scene: Scene, batch: WorldBatch, count: int, first_episode: int, target: int
    ) -> None:
        self.batch, self.target = batch, target
        self._first = first_episode
        self._obs = np.zeros((count, scene.obs_dim), np.float32)
        self._observations = np.empty((count, scene.max_ticks, scene.obs_dim), np.float32)
        self._actions = np.empty((count, scene.max_ticks, scene.action_dim), np.float32)
        self._index = np.full(count, -1, np.int64)  # episode of each world; -1: free
        self._tick = np.zeros(count, np.int64)
        self._lengths: list[int] = []  # of all started episodes, so far; 0 when invalid
        self._finished: dict[int, _Episode] = {}
        self._next = 0  # the next episode to hand back
        self._handed = 0  # transitions handed back

    def start_episodes(self) -> None:
        """Give free worlds new episodes, unless those under way suffice already."""
        free = np.flatnonzero(self._index < 0)
        if not len(free) or self._handed + sum(self._lengths[self._next :]) >= self.target:
            return
        index = np.arange(len(self._lengths), len(self._lengths) + len(free))
        self._lengths.extend([0] * len(free))
        self._index[free], self._tick[free] = index, 0
        self._obs[free] = self.batch.reset(self._first + index, worlds=free)

    def tick(self, actor: Actor) -> None:
        """Let the actor act once in every world whose episode is needed."""
        active = self._needed()
        index, tick, obs = self._index[active], self._tick[active], self._obs[active]
        actions = np.asarray(actor(obs, self._first + index, tick), np.float32)
        self._check_actions(actions, index, tick)
        record = self.batch.step(actions[:, None, :], worlds=active)
        self._observations[active, tick] = obs
        self._actions[active, tick] = actions
        self._tick[active] += 1
        self._obs[active] = record.obs
        for i in index:
            self._lengths[i] += 1
        status = np.asarray(record.status)
        for world in np.flatnonzero(status != Status.RUNNING):
            self._finish(active[world], int(status[world]))

    def finished_in_order(self) -> Sequence[_Episode]:
        """Hand back the episodes that are whole, up to the first that is not."""
        ready = []
        while self._next in self._finished:
            ready.append(self._finished.pop(self._next))
            self._handed += self._lengths[self._next]
            self._next += 1
        return ready

    def _needed(self) -> np.ndarray:
        lengths = np.array(self._lengths[self._next :], np.int64)
        before = self._handed + np.cumsum(lengths) - lengths
        busy = np.flatnonzero(self._index >= 0)
        return busy[before[self._index[busy] - self._next] < self.target]

    def _finish(self, world: int, status: int) -> None:
        index, ticks = int(self._index[world]), int(self._tick[world])
        self._finished[index] = _Episode(
            number=self._first + index,
            status=status,
            observations=self._observations[world, :ticks].copy(),
            actions=self._actions[world, :ticks].copy(),
        )
        if status == Status.INVALID:
            self._lengths[index] = 0
        self._index[world] = -1

    def _check_actions(self, actions: np.ndarray, index: np.ndarray, tick: np.ndarray) -> None:
        bad = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(bad):
            where = f"episode {self._first + index[bad[0]]}, tick {tick[bad[0]]}"
            raise DivergedError(f"the actor gave NaN or infinity in {where}", "train it again")
