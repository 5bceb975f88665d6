"""The sentences of a report that are computed from its numbers, and its fixed explanations."""

from collections.abc import Sequence

from rtc_cli.report.selection import fits_protocol
from rtc_cli.report.tables import ALL, Row, pick

QUESTION = (
    "How much success is lost when the policy needs time to think, and does training with "
    "simulated delay (prefix) win back more of it than guidance at inference time (pinv)?"
)
SUMMARY_INTERVAL = (
    "In brackets: 95% Wilson intervals. They describe these trained checkpoints "
    "(how well the episodes pin down their success), not what training again would give."
)
PROTOCOLS = {
    "paper": "protocol `paper`: a new chunk is computed as often as possible, s = max(d, 1)",
    "grid": "protocol `grid`: every legal s for each delay",
}
GLOSSARY = (
    ("chunk", "the H actions that the policy predicts at once."),
    (
        "delay d",
        "control steps from the observation until the new chunk can be used. Meanwhile the robot "
        "executes the rest of the old chunk.",
    ),
    ("exec horizon s", "control steps from one start of inference to the next."),
    ("episode, success", "one try at a task; success is the share of episodes solved."),
    ("naive", "starts each new chunk without regard for the actions executed meanwhile."),
    (
        "pinv",
        "inference-time real-time chunking (arXiv 2506.07339): the new chunk is guided towards the "
        "old one while it is computed. `pinv-tuned` is the same with settings chosen on separate "
        "validation episodes.",
    ),
    (
        "pinv-detached",
        "pinv without the backward pass; an ablation.",
    ),
    (
        "prefix",
        "training-time real-time chunking (arXiv 2512.05964): the policy was trained to take the "
        "actions that will be executed meanwhile as an input.",
    ),
    (
        "oracle",
        "a reference, not a bound: the base policy is shown the state d steps ahead, predicted "
        "without noise, so that its chunk fits the moment at which it is used.",
    ),
    (
        "open-loop, irreducible, avoidable",
        "the three parts of what delay costs: acting long on one observation; what even the "
        "oracle loses; and what naive loses beyond that.",
    ),
    (
        "control-limited, information-limited, insensitive",
        "why delay hurts on a task: mostly avoidable, mostly irreducible, or not at all.",
    ),
    ("sync", "the robot stands still while the chunk is computed."),
    (
        "base, prefix (policy)",
        "the base policy never saw a delay in training; the prefix policy was forked from it and "
        "finished with simulated delays. Both had the same number of training steps.",
    ),
    (
        "protocol",
        "which s goes with which d: `paper` is s = max(d, 1), `fixed:S` is s = S for all delays.",
    ),
    (
        "D90",
        "delay tolerance: the largest delay at which success is still 0.9 of naive's without "
        "delay, at the same s.",
    ),
    ("seam jump", "size of the action change at a hand-over, relative to other steps (1 = equal)."),
    ("seam gap", "distance of the new chunk from the old one where the new one takes over."),
    ("prefix error", "distance of the new chunk from the actions already committed."),
    (
        "measured reaction",
        "control steps from a push until the executed actions differ from an undisturbed twin's.",
    ),
    ("training seed", "one complete repetition of data collection and training."),
)


def points(value: float, *, sign: bool = False) -> str:
    """Return a rate as percentage points with one decimal."""
    text = f"{100 * value:+.1f}" if sign else f"{100 * value:.1f}"
    return "0.0" if text in ("-0.0", "+0.0") else text


def interval(low: float | None, high: float | None, *, sign: bool = False) -> str:
    """Return "(low to high)" in percentage points, or that there is none."""
    if low is None or high is None:
        return "(no interval)"
    return f"({points(low, sign=sign)} to {points(high, sign=sign)})"


def protocol_text(protocol: str) -> str:
    """Return what a protocol means, in a few words."""
    if protocol.startswith("fixed:"):
        s = protocol.partition(":")[2]
        return f"protocol `{protocol}`: s = {s} control steps at every delay"
    return PROTOCOLS.get(protocol, f"protocol `{protocol}`")


def difference_interval_text(rows: Sequence[Row]) -> str:
    """Say what the intervals of some difference rows describe."""
    if not rows:
        return ""
    by_seed = [row for row in rows if row["interval"] == "seeds"]
    if not by_seed:
        number = max(row["seeds"] for row in rows)
        few = "One training seed only" if number == 1 else f"Only {number} training seeds"
        return (
            f"{few}: the 95% intervals are paired by episode and describe these "
            "checkpoints. They say nothing about training again."
        )
    seeds = sorted({row["seeds"] for row in by_seed})
    number_text = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    text = (
        f"95% intervals over {number_text} training seeds (paired by seed, Student's t, tasks "
        "fixed and equally weighted)."
    )
    if len(by_seed) < len(rows):
        text += (
            " Where the training seeds are too few for that (one task with fewer than five), they "
            "are paired by episode and describe these checkpoints only."
        )
    tasks = max(len({row["task"] for row in rows} - {ALL}), 1)
    if tasks * (seeds[0] - 1) < 12:
        text += " This is few: the intervals are wide, and rest on the t distribution."
    return text


def answer(summary: Sequence[Row], gaps: Sequence[Row], falls: Sequence[Row]) -> list[str]:
    """Return the answer in two or three sentences, computed from the rows of the first protocol."""
    protocols = list(dict.fromkeys(row["protocol"] for row in summary))
    if not protocols:
        return ["There are no evaluated episodes."]
    first = [_fall_sentence(summary, falls, protocols[0])]
    comparisons = [
        _comparison_sentence(summary, gaps, protocols[0], baseline)
        for baseline in ("pinv", "pinv-tuned")
    ]
    return [sentence for sentence in (*first, *comparisons) if sentence]


def _fall_sentence(summary: Sequence[Row], falls: Sequence[Row], protocol: str) -> str:
    fall = pick(falls, task=ALL, protocol=protocol)
    if not fall:
        return "This run does not hold naive at delay 0 and at a larger delay: its fall is unknown."
    row = fall[0]
    where = _scope(summary)
    lost = f"{points(row['fall'])} points are lost {interval(row['low'], row['high'])}"
    if row["fall"] < 0:
        lost = f"{points(-row['fall'])} points more"
    return (
        f"Naive execution solves {points(row['success_at_zero'])}% of the episodes without delay "
        f"and {points(row['success_at_delay'])}% at a delay of {row['delay']} control steps "
        f"({where}): {lost}."
    )


def _scope(summary: Sequence[Row]) -> str:
    tasks = sorted({row["task"] for row in summary} - {ALL})
    seeds = {row["train_seed"] for row in summary} - {ALL}
    what = f"mean of {len(tasks)} tasks" if len(tasks) > 1 else f"task {tasks[0]}"
    return f"{what}, {len(seeds)} training seed{'s' if len(seeds) > 1 else ''}"


def _comparison_sentence(
    summary: Sequence[Row], gaps: Sequence[Row], protocol: str, baseline: str
) -> str:
    mine = [
        row
        for row in pick(gaps, task=ALL, method="prefix", baseline=baseline)
        if fits_protocol(row, protocol)
    ]
    if not mine and baseline != "pinv":
        return ""
    if not mine:
        return "prefix and pinv were not both evaluated: they are not compared here."
    last = max(mine, key=lambda row: row["delay"])
    cell = {"delay": last["delay"], "exec_horizon": last["exec_horizon"]}
    scores = {
        name: pick(summary, task=ALL, train_seed=ALL, protocol=protocol, method=name, **cell)
        for name in ("prefix", baseline)
    }
    values = (
        f"prefix solves {points(scores['prefix'][0]['success'])}%, "
        f"{baseline} {points(scores[baseline][0]['success'])}%"
        if all(scores.values())
        else f"prefix against {baseline}"
    )
    verdict = _verdict(last)
    others = _where_clear([row for row in mine if row is not last])
    return (
        f"At that delay {values}: a difference of {points(last['difference'], sign=True)} points "
        f"{interval(last['low'], last['high'], sign=True)}, {verdict}{others}."
    )


def _verdict(row: Row) -> str:
    number = "one training seed" if row["seeds"] == 1 else f"{row['seeds']} training seeds"
    scope = "" if row["interval"] == "seeds" else f" for these checkpoints ({number})"
    if row["low"] is None or row["high"] is None:
        return "for which no interval can be given"
    if row["low"] > 0:
        return f"so prefix is better{scope}"
    if row["high"] < 0:
        return f"so prefix is worse{scope}"
    return f"an interval that contains 0, so this run does not tell them apart{scope}"


def _where_clear(rows: Sequence[Row]) -> str:
    better = [row["delay"] for row in rows if row["low"] is not None and row["low"] > 0]
    worse = [row["delay"] for row in rows if row["high"] is not None and row["high"] < 0]
    unclear = [row["delay"] for row in rows if row["delay"] not in {*better, *worse}]
    parts = []
    for delays, what in ((better, "better"), (worse, "worse"), (unclear, "not told apart")):
        if delays:
            parts.append(f"{what} at d = {', '.join(str(d) for d in sorted(delays))}")
    return f"; at the other delays prefix is {', '.join(parts)}" if parts else ""


def ablation_answer(gaps: Sequence[Row], baseline: str, protocol: str) -> list[str]:
    """Return one sentence per variant: where it differs from the baseline variant."""
    sentences = []
    mine = [row for row in pick(gaps, task=ALL) if fits_protocol(row, protocol)]
    for variant in dict.fromkeys(row["method"] for row in mine):
        rows = pick(mine, method=variant)
        last = max(rows, key=lambda row: row["delay"])
        sentences.append(
            f"`{variant}` against `{baseline}` at delay {last['delay']}: "
            f"{points(last['difference'], sign=True)} points "
            f"{interval(last['low'], last['high'], sign=True)}"
            f"{_ablation_verdict(last)}."
        )
    return sentences or [f"There is no variant to compare with `{baseline}` yet."]


def _ablation_verdict(row: Row) -> str:
    if row["low"] is None or row["high"] is None:
        return ", without an interval"
    if row["low"] > 0 or row["high"] < 0:
        clear = "better" if row["low"] > 0 else "worse"
        return f", {clear}" + ("" if row["interval"] == "seeds" else " for these checkpoints")
    return ", not told apart"
