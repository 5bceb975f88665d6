"""Sentences about the loss decomposition, computed from its rows."""

from collections.abc import Mapping, Sequence

from rtc_cli.report.losses.costs import CLASSES, DIFFERENT
from rtc_cli.report.selection import fits_protocol, fixed_protocols, method_order
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import interval, points

COSTS_MEANING = (
    "`oracle` is a reference, not a bound: the base policy is shown the state d steps ahead, "
    "predicted without noise. **Open-loop cost** S(0,1) − S(0,s): acting s steps on one "
    "observation, without any delay. **Irreducible cost** S(0,s) − S_oracle(d,s): lost even with "
    "the predicted state. **Avoidable cost** S_oracle(d,s) − S_naive(d,s): what that prediction, "
    "made with the true dynamics, wins over naive. They add up to S(0,1) − S_naive(d,s); a part "
    "can be negative."
)
RECOVERED_MEANING = (
    "Recovered: (S − S_naive) / (S_oracle − S_naive) in percent, for the mean as the ratio of the "
    "means; Fieller's 95% interval from the same pairs as the differences. `-`: the interval of "
    "the avoidable cost does not lie above 0. More than 100 is possible."
)
CLASS_RULE = (
    "Classes look at naive and the oracle only, at one s and the largest delay up to 4, on tasks "
    "of which naive solves {floor:g}% or more without delay. `insensitive`: the interval of the "
    "loss to delay, S(0,s) − S_naive(d,s), lies within ± {margin:g} points. Otherwise, where that "
    "interval lies above 0: `control-limited` if the interval of avoidable − irreducible lies "
    "above 0, `information-limited` if it lies below. Everything else is `undecided`."
)


def main_protocol(rows: Sequence[Row]) -> str:
    """Return the protocol that sentences and the main figure are about: fixed:4, else the first."""
    names = list(dict.fromkeys(row["protocol"] for row in rows))
    return [*fixed_protocols(names), *names, ""][0]


def loss_answer(
    decomposition: Sequence[Row], recovered: Sequence[Row], classes: Sequence[Row]
) -> list[str]:
    """Return what was lost where, and the tasks by class; nothing without the oracle."""
    protocol = main_protocol(decomposition)
    rows = pick(decomposition, protocol=protocol)
    whole = pick(rows, task=ALL)
    if not whole:
        return []
    last = max(whole, key=lambda row: row["delay"])
    cell = {name: last[name] for name in ("task", "protocol", "delay", "exec_horizon")}
    sentences = [_loss_sentence(last, pick(recovered, **cell))]
    mine = pick(classes, protocol=protocol)
    if len(mine) > 1:
        sentences.append(_class_sentence(mine))
    elif mine:
        sentences.append(f"Task `{mine[0]['task']}` is {mine[0]['class']}.")
    return sentences


def _loss_sentence(row: Row, shares: Sequence[Row]) -> str:
    start = row["success_closed_loop"]
    parts = [
        f"{points(row['irreducible'])} points are lost even to a policy that is shown the state "
        f"d steps ahead, predicted without noise (irreducible), {points(row['avoidable'])} points "
        f"{interval(row['avoidable_low'], row['avoidable_high'])} are won back by that prediction "
        "(avoidable)"
    ]
    if start is not None:
        parts.insert(
            0,
            f"{points(start)}% are solved without delay at s = 1; {points(row['open_loop_cost'])} "
            "points are lost to acting open loop",
        )
    text = f"At s = {row['exec_horizon']}, d = {row['delay']}: {', '.join(parts)}."
    by_method = {share["method"]: share for share in shares if share["recovered"] is not None}
    won = [
        f"{name} {100 * by_method[name]['recovered']:.0f}% "
        f"({100 * by_method[name]['recovered_low']:.0f} to "
        f"{100 * by_method[name]['recovered_high']:.0f})"
        for name in method_order(list(by_method))
    ]
    return text + (f" Of the avoidable part, methods recover: {', '.join(won)}." if won else "")


def _class_sentence(classes: Sequence[Row]) -> str:
    groups = []
    for name in CLASSES:
        tasks = sorted(row["task"] for row in pick(classes, **{"class": name}))
        if tasks:
            groups.append(f"{len(tasks)} {name} ({', '.join(tasks)})")
    cell = classes[0]
    return f"Why delay hurts, at s = {cell['exec_horizon']}: {'; '.join(groups)}."


def trend_sentences(gaps: Sequence[Row], classes: Sequence[Row], protocol: str) -> list[str]:
    """Say on which tasks prefix − pinv (and − pinv-tuned) has another sign than the mean."""
    kinds = {row["task"]: row["class"] for row in pick(classes, protocol=protocol)}
    found = []
    for baseline in ("pinv", "pinv-tuned"):
        mine = [
            row
            for row in pick(gaps, method="prefix", baseline=baseline)
            if fits_protocol(row, protocol)
        ]
        whole = pick(mine, task=ALL)
        if len({row["task"] for row in mine}) > 2 and whole:
            found.append(_trend_sentence(mine, whole, kinds))
    return found


def _trend_sentence(rows: Sequence[Row], whole: Sequence[Row], kinds: Mapping[str, str]) -> str:
    mean = max(whole, key=lambda row: row["delay"])
    cell = {name: mean[name] for name in ("delay", "exec_horizon")}
    tasks = [row for row in pick(rows, **cell) if row["task"] != ALL]
    against = [row for row in tasks if row["difference"] * mean["difference"] < 0]
    what = (
        f"prefix − {mean['baseline']} at s = {mean['exec_horizon']}, d = {mean['delay']} "
        f"({points(mean['difference'], sign=True)} points in the mean)"
    )
    if not against:
        return f"No task goes against the sign of {what}."
    clear = [row for row in against if _excludes_zero(row)]
    unclear = [row for row in against if not _excludes_zero(row)]
    parts = []
    if clear:
        parts.append(f"clearly: {_list(clear, kinds)}")
    if unclear:
        parts.append(f"within their intervals: {_list(unclear, kinds)}")
    return f"Against the sign of {what} go, {'; '.join(parts)}."


def _excludes_zero(row: Row) -> bool:
    return row["low"] is not None and (row["low"] > 0 or row["high"] < 0)


def _list(rows: Sequence[Row], kinds: Mapping[str, str]) -> str:
    texts = []
    for row in sorted(rows, key=lambda row: abs(row["difference"]), reverse=True):
        kind = f", {kinds[row['task']]}" if row["task"] in kinds else ""
        texts.append(f"{row['task']} ({points(row['difference'], sign=True)}{kind})")
    return ", ".join(texts)


def control_alarms(controls: Sequence[Row]) -> list[str]:
    """Return one loud sentence per method that differs from naive on an insensitive task."""
    found = []
    for row in controls:
        if row["verdict"] == DIFFERENT:
            found.append(
                f"NEGATIVE CONTROL BROKEN: on the insensitive task {row['task']}, "
                f"{row['method']} differs from naive by "
                f"{points(row['difference'], sign=True)} points "
                f"{interval(row['low'], row['high'], sign=True)} at d = {row['delay']}, "
                f"s = {row['exec_horizon']}. Find the cause before trusting other differences."
            )
    return found
