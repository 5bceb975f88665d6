"""The sections of a report about the loss decomposition, and the main figure."""

from collections.abc import Sequence

from rtc_cli.report.document import Block, Fold, Note, Paragraph, Picture, Section, Table
from rtc_cli.report.losses import figures as loss_figures
from rtc_cli.report.losses.costs import DIFFERENT, EQUAL, FLOOR, MARGIN
from rtc_cli.report.losses.grids import (
    ADD_UP,
    classes_grid,
    classes_of,
    control_grid,
    costs_by_delay_grid,
    costs_grid,
    last_delay,
    recovered_by_delay_grid,
    recovered_grid,
)
from rtc_cli.report.losses.text import (
    CLASS_RULE,
    COSTS_MEANING,
    RECOVERED_MEANING,
    control_alarms,
    main_protocol,
)
from rtc_cli.report.sections import Results, as_table, capital
from rtc_cli.report.selection import fixed_protocols
from rtc_cli.report.tables import ALL, Row, pick
from rtc_cli.report.text import difference_interval_text, protocol_text

STACKED_CAPTION = (
    "Each bar is all episodes of a task. Hatched: a negative part, drawn over the parts that it "
    "overlaps, so that bars end at 100%."
)
SEAM_CAPTION = (
    "One point per method and delay, mean over tasks; the number is the delay. Measured reaction: "
    "control steps from a push until the executed actions differ from those of an undisturbed "
    "twin, mean of the episodes in which they do before the end."
)


def glance(results: Results) -> list[Section]:
    """Show the main figure; nothing without costs of delay at a fixed s."""
    protocol = main_protocol(results.decomposition)
    if not protocol.startswith("fixed:"):
        return []
    classes = classes_of(results.classes, protocol)
    figure = loss_figures.main_figure(results.summary, results.decomposition, classes, protocol)
    caption = (
        "(a) Bands: 95% intervals for these checkpoints; the oracle is a reference. (b) "
        f"{STACKED_CAPTION}"
    )
    label = "Success against delay, and where success is lost"
    if loss_figures.main_seam_rows(results.summary, protocol):
        caption += f" (c) {SEAM_CAPTION}"
        label = "Success against delay, where success is lost, and seam against reaction"
    return [Section("glance", "At a glance", [Picture("main", label, figure, caption)])]


def losses(results: Results) -> Section:
    """Show the costs of delay, what methods recover, the classes and the negative control."""
    title = "What could be won back"
    if not results.decomposition:
        note = (
            "The losses were not taken apart: that needs the method `oracle` (a reference) in "
            "`eval.methods`, and no more than one `eval.action_noise`."
        )
        return Section("losses", title, [Note(note)])
    alarms: list[Block] = [Note(f"**{text}**") for text in control_alarms(results.controls)]
    blocks: list[Block] = [
        *alarms,
        Paragraph(COSTS_MEANING),
        Paragraph(f"{RECOVERED_MEANING} {difference_interval_text(results.decomposition)}"),
    ]
    protocols = list(dict.fromkeys(row["protocol"] for row in results.decomposition))
    fixed = fixed_protocols(protocols)
    for protocol in [*fixed, *(name for name in protocols if name not in (*fixed, "grid"))]:
        blocks.extend(_protocol_blocks(results, protocol))
    return Section("losses", title, [*blocks, *_control_blocks(results)])


def _protocol_blocks(results: Results, protocol: str) -> list[Block]:
    costs = pick(results.decomposition, protocol=protocol)
    shares = pick(results.recovered, protocol=protocol)
    classes = classes_of(results.classes, protocol)
    blocks: list[Block] = [Paragraph(f"**{capital(protocol_text(protocol))}.**")]
    if classes:
        blocks.append(_stacked(costs, classes, protocol))
    caption = f"Percentage points. {ADD_UP}."
    last = last_delay(costs)
    blocks.append(as_table(costs_grid(costs, classes, last), f"At d = {last}. {caption}"))
    if pick(costs, task=ALL) and len(results.tasks) > 1:
        blocks.append(as_table(costs_by_delay_grid(costs), f"Mean of all tasks. {caption}"))
    blocks.extend(_recovered_blocks(shares, classes, results.tasks))
    others = sorted({row["delay"] for row in costs} - {last})
    if others:
        tables = [as_table(costs_grid(costs, classes, d), f"At d = {d}.") for d in others]
        blocks.append(Fold("Costs at the other delays", tables))
    if classes:
        rule = CLASS_RULE.format(margin=100 * MARGIN, floor=100 * FLOOR)
        blocks += [Paragraph(rule), as_table(classes_grid(results.classes, protocol))]
    return blocks


def _stacked(costs: Sequence[Row], classes: dict[str, str], protocol: str) -> Picture:
    delay = last_delay(costs)
    return Picture(
        f"losses-{protocol.replace(':', '-')}",
        f"Where success is lost on each task, {protocol}, d = {delay}",
        loss_figures.losses_figure(costs, classes, delay),
        f"At d = {delay}. {STACKED_CAPTION}",
    )


def _recovered_blocks(
    shares: Sequence[Row], classes: dict[str, str], tasks: Sequence[str]
) -> list[Block]:
    if not shares:
        return []
    if len(tasks) == 1:
        table = as_table(recovered_by_delay_grid(shares, task=tasks[0]), "Recovered (%).")
        return [table]
    blocks: list[Block] = []
    if pick(shares, task=ALL):
        caption = "Avoidable cost recovered (%), mean of all tasks."
        blocks.append(as_table(recovered_by_delay_grid(shares), caption))
    tables: list[Table] = [
        as_table(recovered_grid(shares, delay, classes), f"At d = {delay}.")
        for delay in sorted({row["delay"] for row in shares}, reverse=True)
    ]
    return [*blocks, Fold("Recovered on each task", tables)]


def _control_blocks(results: Results) -> list[Block]:
    if not results.classes:
        return []
    if not results.controls:
        return [
            Note(
                "No task is insensitive by these intervals, so there is no negative control: a "
                "task on which all methods must come out equal."
            )
        ]
    names = ", ".join(dict.fromkeys(row["task"] for row in results.controls))
    counts = {v: sum(row["verdict"] == v for row in results.controls) for v in (EQUAL, DIFFERENT)}
    text = (
        f"**Negative control** ({names}): delay costs nothing there, so no method may win or lose. "
        f"Of {len(results.controls)} comparisons with naive, {counts[EQUAL]} are equal (the "
        f"interval lies within ± {100 * MARGIN:g} points), {counts[DIFFERENT]} differ (it lies "
        "outside), the others are open. `sync` is no part of it, since waiting is another loss."
    )
    tables = [
        as_table(control_grid(pick(results.controls, protocol=protocol)), f"Protocol {protocol}.")
        for protocol in dict.fromkeys(row["protocol"] for row in results.controls)
    ]
    return [Paragraph(text), Fold("Differences on the negative control", tables)]


def seam(results: Results) -> list[Block]:
    """Return the picture of seam jump against measured reaction, where both were measured."""
    protocol = main_protocol(results.summary)
    if not loss_figures.seam_rows(results.summary, protocol):
        return [Note("The reaction was not measured in this run.")]
    label = f"Seam jump against measured reaction, {protocol}"
    figure = loss_figures.seam_figure(results.summary, protocol)
    text = f"{capital(protocol_text(protocol))}. {SEAM_CAPTION}"
    return [Picture("seam-reaction", label, figure, text)]
