"""Training examples: at every recorded tick, the observation and the H actions from there on."""

from dataclasses import dataclass

import numpy as np

from rtc_cli.data.episodes import EpisodeStore
from rtc_cli.errors import UsageError


@dataclass(frozen=True)
class ChunkData:
    """N examples in physical units, float32.

    observations: (N, O); actions: (N, H, A), from the observation's tick on; valid: (N, H) bool,
    False after the end of the episode, where actions are zero and no loss is taken. Every
    recorded transition occurs once as `actions[:, 0]`: statistics for a normaliser come from
    `observations` and `actions[:, 0]`.
    """

    observations: np.ndarray
    actions: np.ndarray
    valid: np.ndarray

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def horizon(self) -> int:
        return int(self.actions.shape[1])


def chunk_windows(store: EpisodeStore, horizon: int) -> ChunkData:
    """Cut one window of `horizon` actions at every tick of every episode.

    NaN or infinity in the data raise StateError naming file and row.
    """
    store.check_finite()
    actions, valid = windows(store.actions, store.lengths, horizon)
    return ChunkData(np.array(store.observations), actions, valid)


def windows(
    actions: np.ndarray, lengths: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return windows (N, H, A) and their validity (N, H) for episodes that lie back to back.

    actions: (N, A); lengths: (E,), their sum is N. Beyond an episode's end windows hold zeros.
    """
    if horizon < 1:
        raise UsageError(f"horizon {horizon} is not possible", "give an integer >= 1")
    count = len(actions)
    ends = np.repeat(np.cumsum(lengths), lengths)
    index = np.arange(count)[:, None] + np.arange(horizon)
    valid = index < ends[:, None]
    cut = np.asarray(actions)[np.minimum(index, max(count - 1, 0))]
    cut[~valid] = 0.0
    return cut, valid
