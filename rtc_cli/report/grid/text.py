"""The words of a grid ablation's report: names of factors, and sentences computed from rows."""

from collections.abc import Mapping, Sequence
from typing import Any

from rtc_cli.report.grid.rows import NOISE, last_cell
from rtc_cli.report.selection import fits_protocol
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text, interval, points

QUESTION = "When does it help that a new chunk is conditioned on the actions already committed?"
NAMES = {
    "data.experts": "experts in the data",
    "data.policy_std": "policy std of the experts",
    NOISE: "execution noise",
}
SHORT_NAMES = {"data.experts": "experts", "data.policy_std": "policy std", NOISE: "noise"}


def factor_name(factor: str) -> str:
    """Return what a factor is called in figures and sentences."""
    return NAMES.get(factor, factor)


def value_text(value: Any) -> str:
    """Return one value of a factor as text: 0.5, 4, mixer."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def setting_text(settings: Mapping[str, Any]) -> str:
    """Return a setting in words, as in "execution noise = 0.1"."""
    return ", ".join(f"{factor_name(key)} = {value_text(value)}" for key, value in settings.items())


def grid_answer(
    gaps: Sequence[Row],
    effects: Sequence[Row],
    protocol: str,
    factors: Sequence[str],
) -> list[str]:
    """Return when conditioning helps, in sentences computed from the rows of one protocol.

    Per pair of methods: in how many settings the first is better, by delay; how far the gain
    reaches at the largest delay; which factors change it.
    """
    mine = [row for row in pick(gaps, task=ALL) if fits_protocol(row, protocol)]
    if not mine:
        return ["No two methods were evaluated on every task of one setting yet."]
    cell = last_cell(mine, protocol)
    sentences = []
    for method, baseline in (("prefix", "naive"), ("prefix", "pinv")):
        pair = pick(mine, method=method, baseline=baseline)
        if pick(pair, **cell):
            sentences += [_counts(pair), _range(pick(pair, **cell), factors)]
            sentences += _changes(pick(effects, method=method, baseline=baseline, **cell))
    sentences += _changes(pick(effects, method="naive", baseline=None, **cell))
    return [*sentences, difference_interval_text(mine)]


def _counts(pair: Sequence[Row]) -> str:
    """Say in how many settings the first method is better, worse or neither, at each delay."""
    parts = []
    for delay in sorted({row["delay"] for row in pair}):
        rows = pick(pair, delay=delay)
        better = sum(row["low"] is not None and row["low"] > 0 for row in rows)
        worse = sum(row["high"] is not None and row["high"] < 0 for row in rows)
        parts.append(f"at d = {delay} better in {better} and worse in {worse} of {len(rows)}")
    method, baseline = pair[0]["method"], pair[0]["baseline"]
    return (
        f"{method} against {baseline}, settings whose interval excludes 0 (mean of the tasks): "
        f"{'; '.join(parts)}."
    )


def _range(rows: Sequence[Row], factors: Sequence[str]) -> str:
    """Say where the difference at the largest delay is smallest and largest."""
    low, high = (end(rows, key=lambda row: row["difference"]) for end in (min, max))
    texts = [
        f"{_gain(row)} at {setting_text({key: row[key] for key in factors})}" for row in (low, high)
    ]
    return f"At d = {low['delay']} the difference goes from {texts[0]} to {texts[1]}."


def _changes(effects: Sequence[Row]) -> list[str]:
    """Say which factors change a quantity, the strongest first, and which are not told apart."""
    mine = sorted(pick(effects, task=ALL), key=lambda row: -abs(row["difference"]))
    if not mine:
        return []
    clear = [row for row in mine if _clear(row)]
    unclear = [_level_text(row) for row in mine if not _clear(row)]
    first = mine[0]
    what = (
        f"{first['method']} minus {first['baseline']}" if first["baseline"] else "naive's success"
    )
    where = f"at d = {first['delay']}"
    text = f"No factor clearly changes {what} {where}"
    if clear:
        listed = "; ".join(f"{_level_text(row)}: {_gain(row)}" for row in clear)
        text = f"What changes {what} {where}: {listed}"
    rest = f". Not told apart from no change: {', '.join(unclear)}" if unclear and clear else ""
    return [f"{text}{rest}."]


def _gain(row: Row) -> str:
    ends = interval(row["low"], row["high"], sign=True)
    return f"{points(row['difference'], sign=True)} points {ends}"


def _clear(row: Row) -> bool:
    return row["low"] is not None and bool(row["low"] > 0 or row["high"] < 0)


def _level_text(row: Row) -> str:
    ends = f"{value_text(row['start'])} to {value_text(row['end'])}"
    return f"{factor_name(row['factor'])} from {ends}"
