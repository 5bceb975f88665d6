"""Which episode rows count: method labels, one row per episode, and the cells of a protocol."""

import json
import re
from collections.abc import Sequence

import pandas as pd

from rtc_cli.errors import StateError

# One episode of one cell; two rows that agree here are the same measurement.
IDENTITY = (
    "task",
    "method",
    "train_seed",
    "delay",
    "exec_horizon",
    "flow_steps",
    "action_noise",
    "episode",
)
METRICS = (
    "length",
    "time_to_success_s",
    "throughput_per_min",
    "seam_jump",
    "seam_gap",
    "prefix_error",
    "action_delta",
    "action_delta2",
    "starved_ticks",
    "late_chunks",
    "dropped_chunks",
    "clipped_requests",
    "exceeded_requests",
    "waiting_ticks",
    "reaction_ticks",
    "measured_reaction_ticks",
)
# How delays vary, and what the sampler is told of them.
TIMING = ("delay_model", "estimator", "on_late", "on_exceed", "observation_lag")
# Label of cells that exist only for the loss decomposition: naive at d = 0 for every s.
OPEN_LOOP = "open-loop"
_NEEDED = (*IDENTITY, "checkpoint", "sampler", "schedule", "protocol", "solved")
# Matrix cells that are a named method: the same measurement, shown under one name.
_SAME_AS = {"base+plain": "naive", "base+pinv": "pinv", "prefix+prefix": "prefix"}
METHOD_ORDER = ("sync", "naive", "pinv", "pinv-tuned", "pinv-detached", "prefix", "oracle")


def prepare(episodes: pd.DataFrame, *, reference: bool = False) -> pd.DataFrame:
    """Return one row per measured episode, with unambiguous method names.

    A cell that belongs to two protocols may be stored twice; it counts once here. The column
    `protocols` of the result's `attrs` keeps the protocols that were asked for. Rows labelled
    `open-loop` are reference data: left out unless `reference`, and never a protocol. Rows that
    were prepared before are returned as they are. Raises StateError where columns are missing, or
    where rows of two policies would be mixed.
    """
    if "protocols" in episodes.attrs:
        return episodes
    missing = [name for name in _NEEDED if name not in episodes.columns]
    if missing:
        raise StateError(
            f"the episode rows lack the columns {', '.join(missing)}",
            "evaluate again with this version of rtc",
        )
    if not reference:
        episodes = episodes[episodes["protocol"] != OPEN_LOOP]
    if episodes.empty:
        raise StateError("there are no evaluated episodes", "run `rtc eval` first")
    rows = _label_settings(episodes.assign(method=episodes["method"].replace(_SAME_AS)))
    rows = _label_timing(_label_noise(rows))
    protocols = sorted(set(rows["protocol"].astype(str)) - {OPEN_LOOP}, key=_protocol_order)
    _refuse_mixed(rows)
    rows = rows.drop_duplicates(list(IDENTITY))
    rows = rows.assign(solved=rows["solved"].astype(bool)).reset_index(drop=True)
    rows.attrs["protocols"] = protocols
    return rows


def _label_settings(episodes: pd.DataFrame) -> pd.DataFrame:
    """Tell apart two settings that were evaluated under one method name."""
    if "settings" not in episodes.columns:
        return episodes.assign(settings="{}")
    rows = episodes.assign(settings=episodes["settings"].fillna("{}").astype(str))
    pairs = rows[["method", "settings"]].drop_duplicates()
    twice = [name for name, group in pairs.groupby("method") if len(group) > 1]
    if not twice:
        return rows
    labels = {
        (method, settings): _label(method, settings) if method in twice else method
        for method, settings in pairs.itertuples(index=False)
    }
    names = [labels[key] for key in zip(rows["method"], rows["settings"], strict=True)]
    return rows.assign(method=names)


def _label_noise(rows: pd.DataFrame) -> pd.DataFrame:
    """Tell apart what was evaluated under several world noises, as if each were a method."""
    if rows.groupby("task")["action_noise"].nunique().max() < 2:
        return rows
    return rows.assign(method=rows["method"] + " (noise " + rows["action_noise"].map(str) + ")")


def _label_timing(rows: pd.DataFrame) -> pd.DataFrame:
    """Tell what was evaluated under delays that vary, and the like, as if it were a method."""
    if not set(TIMING) <= set(rows.columns):
        return rows
    combinations = rows[list(TIMING)].drop_duplicates().itertuples(index=False, name=None)
    labels = {found: timing_label(*found) for found in combinations}
    found = zip(*(rows[name] for name in TIMING), strict=True)
    return rows.assign(method=rows["method"] + [labels[row] for row in found])


def timing_label(
    delay_model: str, estimator: str, on_late: str, on_exceed: str, observation_lag: int
) -> str:
    """Return what is said after a method's name; "" for one delay that everybody knows."""
    constant = re.fullmatch(r"constant:\d+", delay_model) is not None
    parts = [
        "" if estimator == "exact" else estimator,
        "" if on_late == "play" else on_late,
        "" if on_exceed == "play" else on_exceed,
        f"lag {observation_lag}" if observation_lag else "",
    ]
    said = ", ".join(part for part in parts if part)
    if constant:
        return f" (delays constant, {said})" if said else ""
    return f" (delays {', '.join(part for part in (delay_model, said) if part)})"


def condition_label(method: str) -> str:
    """Return the part of a method's name that tells noise and delays; "" where there is none."""
    found = re.search(r" \((noise|delays) .*\)$", method)
    return found[0] if found else ""


def delay_label(method: str) -> str:
    """Return the part of a method's name that tells delays that vary; "" where there is none."""
    found = re.search(r" \(delays .*\)$", method)
    return found[0] if found else ""


def _label(method: str, settings: str) -> str:
    try:
        values = json.loads(settings)
        text = ", ".join(f"{name}={value}" for name, value in sorted(values.items()))
    except (ValueError, AttributeError):
        text = settings
    return f"{method} ({text})" if text else method


def _refuse_mixed(rows: pd.DataFrame) -> None:
    """Refuse two results for one episode: another policy or another evaluation seed."""
    who = ["task", "method", "train_seed"]
    outcome = [name for name in ("solved", "length") if name in rows.columns]
    mixed = _conflicts(rows, list(IDENTITY), outcome)
    what = "two different results for the same episodes"
    if "policy" in rows.columns and mixed.empty:
        mixed = _conflicts(rows, who, ["policy"])
        what = "episodes of two policies"
    if not mixed.empty:
        task, method, seed = mixed.iloc[0][who]
        raise StateError(
            f'task "{task}", method "{method}", training seed {seed} holds {what}',
            "a policy or the evaluation seed changed between evaluations: use a new run folder",
        )


def _conflicts(rows: pd.DataFrame, keys: list[str], values: list[str]) -> pd.DataFrame:
    distinct = rows[[*keys, *values]].drop_duplicates()
    return distinct[distinct.duplicated(keys)]


def protocols_of(rows: pd.DataFrame) -> list[str]:
    """Return the protocols of prepared rows: `paper` first, then `fixed:S`, then `grid`."""
    return list(rows.attrs.get("protocols") or sorted(rows["protocol"].unique()))


def in_protocol(rows: pd.DataFrame, protocol: str) -> pd.DataFrame:
    """Return the rows whose (delay, exec_horizon) belong to a protocol, whatever their label."""
    if protocol == "paper":
        return rows[rows["exec_horizon"] == rows["delay"].clip(lower=1)]
    fixed = re.fullmatch(r"fixed:(\d+)", protocol)
    if fixed:
        return rows[rows["exec_horizon"] == int(fixed[1])]
    if protocol == "grid":
        return rows
    return rows[rows["protocol"] == protocol]


def fixed_protocols(protocols: Sequence[str]) -> list[str]:
    """Return the protocols with one s for all delays; s = 4, the usual one, first."""
    fixed = [name for name in protocols if name.startswith("fixed:")]
    return sorted(fixed, key=lambda name: (name != "fixed:4", int(name.partition(":")[2])))


def fits_protocol(row: dict[str, object], protocol: str) -> bool:
    """Say whether a row with `delay` and `exec_horizon` is a cell of a protocol."""
    delay, exec_horizon = int(str(row["delay"])), int(str(row["exec_horizon"]))
    if protocol == "paper":
        return exec_horizon == max(delay, 1)
    fixed = re.fullmatch(r"fixed:(\d+)", protocol)
    return exec_horizon == int(fixed[1]) if fixed else True


def method_order(names: Sequence[str]) -> list[str]:
    """Sort method names: the known ones as the tables show them, then others by name."""
    known = {name: place for place, name in enumerate(METHOD_ORDER)}
    base = [re.split(r" \(", name)[0] for name in names]
    return [
        name
        for _, _, name in sorted(
            (known.get(stem, len(known)), name, name)
            for stem, name in zip(base, names, strict=True)
        )
    ]


def _protocol_order(protocol: str) -> tuple[int, str]:
    first = {"paper": 0, "grid": 2}
    return first.get(protocol, 1), protocol
