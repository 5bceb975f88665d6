"""Latencies that were published, in ms, to stand beside measured ones: other devices, 5 steps."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One published chunk: its parts in ms by name, as far as they are told apart."""

    label: str
    sampler: str
    parts: dict[str, float]
    source: str

    @property
    def total_ms(self) -> float:
        return sum(self.parts.values())


_VISION = {"vision": 18.0, "prefill": 44.0}
_RTC = "arXiv 2506.07339: pi0.5 on an RTX 4090"
_TRAINING_TIME = "arXiv 2512.05964: pi0.6 on a remote H100, the network between included"

PUBLISHED = (
    Published("RTX 4090, plain", "plain", {**_VISION, "flow steps": 14.0}, _RTC),
    Published("RTX 4090, pinv", "pinv", {**_VISION, "flow steps": 35.0}, _RTC),
    Published("remote H100, prefix", "prefix", {"end to end": 108.0}, _TRAINING_TIME),
    Published("remote H100, pinv", "pinv", {"end to end": 135.0}, _TRAINING_TIME),
)
