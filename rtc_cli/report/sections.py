"""The sections of a run's report; each function returns one, and says what is missing."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from rtc_cli.report import figures
from rtc_cli.report.document import (
    Block,
    Bullets,
    Code,
    Definitions,
    Fold,
    Note,
    Paragraph,
    Picture,
    Section,
    Table,
)
from rtc_cli.report.inputs import RunInputs
from rtc_cli.report.losses.costs import (
    class_rows,
    control_rows,
    decomposition_rows,
    loss_cells,
    recovered_rows,
)
from rtc_cli.report.render import (
    Grid,
    d90_grid,
    d90_text,
    differences_grid,
    matrix_grid,
    metrics_grid,
    success_grid,
    task_by_method_grid,
)
from rtc_cli.report.selection import fits_protocol, prepare
from rtc_cli.report.tables import (
    ALL,
    Row,
    d90_rows,
    differences,
    main_flow_steps,
    matrix_rows,
    naive_fall_rows,
    pick,
    summarise,
)
from rtc_cli.report.text import (
    GLOSSARY,
    SUMMARY_INTERVAL,
    difference_interval_text,
    interval,
    points,
    protocol_text,
)
from rtc_cli.report.varying import (
    constant,
    delay_differences_grid,
    delays_grid,
    varying,
)

CONTROL_HZ = 30.0


@dataclass(frozen=True)
class Results:
    """All rows computed from a run's episodes.

    The tables show one number of flow steps, the one used most; `every_*` holds all of them.
    """

    summary: list[Row]
    differences: list[Row]
    falls: list[Row]
    d90: list[Row]
    matrix: list[Row]
    decomposition: list[Row]
    recovered: list[Row]
    classes: list[Row]
    controls: list[Row]
    cells: list[Row]
    every_summary: list[Row]
    every_difference: list[Row]
    flow_steps: int
    all_flow_steps: tuple[int, ...]

    @property
    def losses(self) -> dict[str, list[Row]]:
        """The rows of the loss decomposition, by their keys in the JSON document."""
        return {
            "decomposition": self.decomposition,
            "recovered": self.recovered,
            "classes": self.classes,
            "controls": self.controls,
        }

    @property
    def protocols(self) -> list[str]:
        """Protocols in the order of the report."""
        return list(dict.fromkeys(row["protocol"] for row in self.summary))

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        return sorted({row["task"] for row in self.summary} - {ALL})

    @property
    def seeds(self) -> list[int]:
        """Training seeds."""
        return sorted({row["train_seed"] for row in self.summary} - {ALL})


def compute(episodes: pd.DataFrame, *, control_hz: float = CONTROL_HZ) -> Results:
    """Compute every row of the report from the episodes of a run."""
    rows, with_reference = prepare(episodes), prepare(episodes, reference=True)
    steps = main_flow_steps(rows)
    every_summary, every_difference = summarise(rows), differences(rows)
    summary = pick(every_summary, flow_steps=steps)
    matched = [cell for cell in loss_cells(with_reference) if cell.flow_steps == steps]
    decomposition = decomposition_rows(matched)
    classes = class_rows(decomposition)
    return Results(
        summary=summary,
        differences=pick(every_difference, flow_steps=steps),
        falls=naive_fall_rows(rows),
        d90=d90_rows(summary, control_hz=control_hz),
        matrix=matrix_rows(summary),
        decomposition=decomposition,
        recovered=recovered_rows(matched),
        classes=classes,
        controls=control_rows(rows, classes),
        cells=cell_keys(with_reference),
        every_summary=every_summary,
        every_difference=every_difference,
        flow_steps=steps,
        all_flow_steps=tuple(sorted(int(value) for value in rows["flow_steps"].unique())),
    )


def as_table(grid: Grid, caption: str = "") -> Table:
    """Return a grid as a block."""
    return Table(grid.columns, grid.rows, caption, grid.left)


# -- how to read -----------------------------------------------------------------------------


def how_to_read(run: RunInputs, results: Results) -> Section:
    """Explain one cycle with a drawing, and what the numbers are."""
    s, d = _example_cell(run.horizon, results.protocols)
    period = 1000.0 / CONTROL_HZ
    drawing = Picture(
        "timeline",
        f"One cycle of asynchronous execution with exec horizon {s} and delay {d}",
        figures.timeline_figure(run.horizon, s, d),
        "Each box is one action; the number is its place in its chunk. Solid boxes are executed. "
        "Hatched boxes were due before the chunk was ready, dotted boxes are replaced by a newer "
        "chunk.",
    )
    return Section(
        "read",
        "How to read this",
        [
            Paragraph(
                f"The policy predicts a chunk of H = {run.horizon} actions at once. Computing a "
                f"chunk takes d control steps (one is {period:.0f} ms). The robot does not wait: "
                "it goes on with the old chunk, and takes over the new one as soon as it is ready. "
                "By then the first d actions of the new chunk are in the past. If the new chunk "
                "does not continue what was executed meanwhile, the robot jerks or fails."
            ),
            drawing,
            Bullets(
                [
                    "`naive` ignores the problem.",
                    "`pinv` steers the new chunk towards the old one while it is computed.",
                    "`prefix` was trained with the actions of the meantime as an input.",
                ]
            ),
        ],
    )


def _example_cell(horizon: int, protocols: Sequence[str]) -> tuple[int, int]:
    fixed = [name for name in protocols if name.startswith("fixed:")]
    s = int(fixed[0].partition(":")[2]) if fixed else max(horizon // 2, 1)
    s = min(s, horizon)
    return s, min(2, s, horizon - s)


# -- success ---------------------------------------------------------------------------------


def success(results: Results) -> Section:
    """Show success against delay: figure, table of the mean, tables per task and seed."""
    blocks: list[Block] = []
    if len(results.all_flow_steps) > 1:
        others = [str(steps) for steps in results.all_flow_steps if steps != results.flow_steps]
        blocks.append(
            Note(
                f"These tables use {results.flow_steps} flow steps; {', '.join(others)} flow "
                "steps have a section of their own where they share a protocol, and are in "
                "`rows.json`."
            )
        )
    for protocol in results.protocols:
        blocks.extend(_success_blocks(results, protocol))
    return Section("success", "Success under delay", blocks)


def _success_blocks(results: Results, protocol: str) -> list[Block]:
    every = _named_methods(pick(results.summary, protocol=protocol))
    blocks: list[Block] = [Paragraph(f"**{capital(protocol_text(protocol))}.**")]
    rows = constant(every)
    if rows:
        blocks += _constant_blocks(results, rows, protocol)
    if varying(every):
        blocks += _varying_blocks(results, every)
    if len(results.seeds) > 1:
        blocks.append(Fold("The same for each training seed", [_seed_table(results, every)]))
    return blocks


def _varying_blocks(results: Results, rows: Sequence[Row]) -> list[Block]:
    """Show success where delays vary: a line per law of delays and what is told of it."""
    told = "`told`: what the samplers are told of each delay; naive has no use for it."
    caption = f"Episodes solved (%) where delays vary, {_mean_of(results)}. {told} "
    mean = delays_grid(rows)
    blocks: list[Block] = [as_table(mean, caption + SUMMARY_INTERVAL)] if mean.rows else []
    if len(results.tasks) > 1:
        grids = {task: delays_grid(rows, task=task) for task in results.tasks}
        tables = [
            as_table(grid, f"Where delays vary, task: {task}")
            for task, grid in grids.items()
            if grid.rows
        ]
        blocks.append(Fold("Where delays vary, for each task", tables))
    return blocks


def _constant_blocks(results: Results, rows: Sequence[Row], protocol: str) -> list[Block]:
    """Show success against delay: figure, table of the mean, tables per task."""
    name = f"success-{protocol.replace(':', '-')}"
    label = f"Success against delay for each method, {protocol}"
    blocks: list[Block] = []
    if protocol != "grid":  # several s per delay do not make one line
        blocks.append(
            Picture(
                name,
                label,
                figures.success_figure(rows, protocol),
                f"Bands: 95% intervals. {_scope(results)}",
            )
        )
    mean = success_grid(rows)
    episodes = sorted({row["episodes"] for row in pick(rows, task=ALL, train_seed=ALL)})
    number = f"{episodes[0]:,}" if len(episodes) == 1 else f"{episodes[0]:,} to {episodes[-1]:,}"
    caption = f"Episodes solved (%), {_mean_of(results)}; {number} episodes per number. "
    blocks.append(as_table(mean, caption + SUMMARY_INTERVAL + _beyond(rows)))
    if not mean.rows:
        blocks.append(Note("No cell was evaluated on every task yet, so there is no mean."))
    if len(results.tasks) > 1:
        tables = [
            as_table(success_grid(rows, task=task), f"Task: {task}") for task in results.tasks
        ]
        blocks.append(Fold("The same for each task", tables))
    return blocks


def _named_methods(rows: Sequence[Row]) -> list[Row]:
    """Leave out combinations that exist only for the matrix."""
    return [row for row in rows if "+" not in row["method"]]


def _beyond(rows: Sequence[Row]) -> str:
    marked = any(row["beyond_trained"] for row in rows)
    return " * the delay is larger than any seen in training." if marked else ""


def _mean_of(results: Results) -> str:
    if len(results.tasks) == 1:
        return f"task {results.tasks[0]}"
    return f"mean of {len(results.tasks)} tasks with equal weights"


def _scope(results: Results) -> str:
    seeds = len(results.seeds)
    return f"{capital(_mean_of(results))}, {seeds} training seed{'s' if seeds > 1 else ''}."


def capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]


def _seed_table(results: Results, rows: Sequence[Row]) -> Table:
    columns = [f"seed {seed}" for seed in results.seeds]
    lines = []
    for row in pick(rows, task=ALL, train_seed=ALL):
        cell = {key: row[key] for key in ("method", "delay", "exec_horizon")}
        found = [pick(rows, task=ALL, train_seed=seed, **cell) for seed in results.seeds]
        values = [points(match[0]["success"]) if match else "-" for match in found]
        lines.append([row["method"], str(row["delay"]), str(row["exec_horizon"]), *values])
    return Table(["method", "d", "s", *columns], lines, "Episodes solved (%).")


# -- differences -----------------------------------------------------------------------------


def paired_differences(results: Results) -> Section:
    """Show the paired differences with their intervals."""
    if not results.differences:
        return Section(
            "differences",
            "Differences",
            [Note("No two methods that are compared here were both evaluated.")],
        )
    blocks: list[Block] = [
        Paragraph(
            "Both methods meet the same episodes with the same noise, and both policies of a seed "
            "share their first training epochs. So they are compared pair by pair. "
            f"{difference_interval_text(results.differences)}"
        )
    ]
    for protocol in results.protocols:
        blocks.extend(_difference_blocks(results, protocol))
    return Section("differences", "Differences", blocks)


def _difference_blocks(results: Results, protocol: str) -> list[Block]:
    every = [row for row in results.differences if fits_protocol(row, protocol)]
    if not pick(every, task=ALL):
        return [Note(f"There is no difference over all tasks for protocol `{protocol}` yet.")]
    blocks: list[Block] = [Paragraph(f"**{capital(protocol_text(protocol))}.**")]
    if varying(every):
        summary = pick(results.summary, protocol=protocol)
        grid = delay_differences_grid(every, summary)
        caption = f"Percentage points where delays vary, {_mean_of(results)}."
        if grid.rows:
            blocks.append(as_table(grid, caption))
    rows = constant(every)
    if not pick(rows, task=ALL):
        return blocks
    if protocol != "grid":
        blocks.append(
            Picture(
                f"differences-{protocol.replace(':', '-')}",
                f"Paired differences of success by delay, {protocol}",
                figures.differences_figure(rows, protocol),
                "Above the line the first method solves more. Filled marks: the interval "
                "excludes 0.",
            )
        )
    blocks.append(
        as_table(
            differences_grid(rows, protocol),
            f"Percentage points, {_mean_of(results)}. Bold: the interval excludes 0. Many "
            "intervals are looked at here; about one in twenty misses the true value.",
        )
    )
    if len(results.tasks) > 1:
        tables = [
            as_table(differences_grid(rows, protocol, task=task), f"Task: {task}")
            for task in results.tasks
        ]
        blocks.append(Fold("The same for each task", tables))
    return blocks


# -- delay tolerance, fall, matrix, other metrics --------------------------------------------


def tolerance(results: Results) -> Section:
    """Show naive's fall and D90."""
    blocks: list[Block] = []
    if results.falls:
        blocks.append(_fall_table(results.falls))
    else:
        blocks.append(Note("Naive was not evaluated at delay 0 and at a larger delay."))
    d90 = _named_methods(results.d90)
    mine = pick(d90, task=ALL)
    if mine:
        caption = (
            "D90: the largest delay, interpolated, at which success is still 0.9 of naive's "
            "without delay at the same s. `> 4` means that no evaluated delay was too large. "
            f"One control step is {1000 / CONTROL_HZ:.0f} ms."
        )
        blocks.append(as_table(d90_grid(mine), caption))
        if len(results.tasks) > 1:
            blocks.append(Fold("D90 for each task", _d90_tables(d90)))
    else:
        blocks.append(
            Note(
                "D90 needs one s for several delays and naive at delay 0: evaluate with "
                "`--protocol fixed:4`. This run has none."
            )
        )
    return Section("tolerance", "How much delay is tolerated", blocks)


def _d90_tables(rows: Sequence[Row]) -> list[Table]:
    """One table per fixed s: tasks by methods."""
    cells = dict.fromkeys((row["protocol"], row["exec_horizon"]) for row in rows)
    return [
        as_table(
            task_by_method_grid(pick(rows, protocol=protocol, exec_horizon=s), d90_text),
            f"Control steps, {protocol}, s = {s}.",
        )
        for protocol, s in cells
    ]


def _fall_table(falls: Sequence[Row]) -> Table:
    lines = [
        [
            row["task"],
            row["protocol"],
            points(row["success_at_zero"]),
            f"{points(row['success_at_delay'])} at d={row['delay']}",
            f"{points(row['fall'])} {interval(row['low'], row['high'])}",
        ]
        for row in falls
    ]
    caption = f"What naive loses, in percentage points. {difference_interval_text(falls)}"
    return Table(["task", "protocol", "at d=0", "at the largest d", "lost"], lines, caption, left=2)


def matrix(results: Results) -> Section:
    """Show the matrix of policies and samplers."""
    title = "Policy or sampler?"
    if not results.matrix:
        note = "The matrix was not evaluated: set `eval.matrix = true` in the recipe."
        return Section("matrix", title, [Note(note)])
    caption = (
        "Episodes solved (%). base x prefix asks a policy for something it was never trained on. "
        f"{_scope(results)}"
    )
    blocks: list[Block] = [
        Paragraph(
            "Both policies with every sampler, so that the effect of training and the effect of "
            "the sampler can be told apart."
        )
    ]
    for protocol in dict.fromkeys(row["protocol"] for row in results.matrix):
        grid = matrix_grid(results.matrix, protocol)
        blocks.append(as_table(grid, f"{capital(protocol_text(protocol))}. {caption}"))
    return Section("matrix", title, blocks)


def smoothness(results: Results, more: Sequence[Block] = ()) -> Section:
    """Show seams, reactions and the other metrics at the largest delay of each protocol."""
    meaning = (
        "`seam jump`: the action change at a hand-over, relative to other steps (1 = no seam). "
        "`seam gap`: distance between new and old chunk at the hand-over. `prefix error`: distance "
        "between the new chunk and the actions already committed. `reaction, measured`: from a "
        "push until the executed actions differ from an undisturbed twin's; `possible`: the "
        "earliest that this timing allows. `-`: not defined there."
    )
    blocks: list[Block] = [Paragraph(meaning), *more]
    for protocol in results.protocols:
        blocks.extend(_metric_blocks(results, protocol))
    return Section("smoothness", "Smoothness and reaction", blocks)


def _metric_blocks(results: Results, protocol: str) -> list[Block]:
    rows = _named_methods(pick(results.summary, protocol=protocol))
    delays = sorted({row["delay"] for row in pick(rows, task=ALL)})
    if not delays:
        return [Note(f"No cell of protocol `{protocol}` covers every task yet.")]
    tables: list[Block] = [
        as_table(
            metrics_grid(rows, delay),
            f"Means over episodes, protocol `{protocol}`, d = {delay}.",
        )
        for delay in delays
    ]
    others = f"The same at the other delays, protocol `{protocol}`"
    return [tables[-1], *([Fold(others, tables[:-1])] if tables[:-1] else [])]


# -- cost, training, experts -----------------------------------------------------------------


def profile(run: RunInputs) -> Section:
    """Show what a chunk costs."""
    rows: list[Row] = list(run.profile.get("rows", []))
    title = "What a chunk costs"
    if not rows:
        return Section("profile", title, [Note("No profile yet: run `rtc profile`.")])
    drawing = Picture(
        "profile", "Time of one chunk per sampler", figures.profile_figure(rows),
        "Median and 95th percentile, device-synchronised, without compilation.",
    )  # fmt: skip
    grids = [
        as_table(_profile_grid(group), caption)
        for caption, group in figures.profile_groups(rows).items()
    ]
    machine = _pairs(run.profile.get("machine", {}))
    note = Paragraph(f"Measured on: {machine}.") if machine else None
    return Section("profile", title, [drawing, *grids, *([note] if note else [])])


_PROFILE_COLUMNS = {
    "p50_ms": "p50 (ms)",
    "p95_ms": "p95 (ms)",
    "p99_ms": "p99 (ms)",
    "ratio_to_plain": "x plain",
    "compile_s": "compile (s)",
    "flops": "flops",
    "bytes": "bytes",
    "delay_at_hz": "delay (steps)",
}


def _profile_grid(rows: Sequence[Row]) -> Grid:
    shown = [key for key in _PROFILE_COLUMNS if any(row.get(key) is not None for row in rows)]
    lines = [[str(row["sampler"]), *(_short(row.get(key)) for key in shown)] for row in rows]
    return Grid(["sampler", *(_PROFILE_COLUMNS[key] for key in shown)], lines)


def _short(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    return str(value)


def training(run: RunInputs) -> Section:
    """Show the training curves."""
    if not run.training:
        return Section("training", "Training", [Note("No training curves in this run.")])
    # The curve of a finished base policy begins with its fork's.
    curves = [c for c in run.training if c.get("checkpoint") != "fork"] or run.training
    drawing = Picture(
        "training", "Training loss by epoch", figures.training_figure(curves),
        "One line per training seed; the first epoch may lie above the picture. The loss of the "
        "prefix policy counts only the actions after the prefix, so the two are not measured by "
        "the same yardstick.",
    )  # fmt: skip
    lines = [
        [
            str(curve["task"]),
            str(curve.get("train_seed", "-")),
            str(curve.get("checkpoint", "-")),
            str(len(curve["epochs"])),
            f"{curve['loss'][-1]:.4f}" if curve["loss"] else "-",
            _rate(curve.get("samples_per_s")),
            _seconds(curve.get("seconds")),
        ]
        for curve in run.training
    ]
    columns = ["task", "seed", "policy", "epochs", "last loss", "samples/s (median)", "seconds"]
    table = Table(columns, lines, left=3)
    return Section("training", "Training", [drawing, Fold("Numbers", [table])])


def _rate(values: Any) -> str:
    if not values:
        return "-"
    return f"{float(pd.Series(values).median()):,.0f}"


def _seconds(value: Any) -> str:
    """Show seconds, given as a total or per epoch."""
    return _short(float(sum(value)) if isinstance(value, list) else value)


def experts(run: RunInputs) -> Section:
    """Show the experts that made the data."""
    title = "Experts"
    if not run.experts:
        return Section("experts", title, [Note("No expert records in this run.")])
    least = float(run.recipe.get("experts", {}).get("min_success", 0.65))
    text = (
        "Experts are trained with reinforcement learning; a random one of them acts in each "
        f"episode of the data. Those below {points(least)}% success are left out"
    )
    count = _data_setting(run, "experts")
    text += "." if count is None else f", and so are all but the first {count} by seed."
    std = _data_setting(run, "policy_std")
    if std is not None and std != 1:
        text += f" They act with {std:g} times their own standard deviation."
    table = _expert_table(run, _acting(run, least))
    diversity = _diversity([], [([], run.diversity)])
    return Section("experts", title, [Paragraph(text), table, *diversity])


def _expert_table(run: RunInputs, acting: Collection[tuple[str, int]] | None = None) -> Table:
    """Return the experts' records; with `acting`, a column says who made the data."""
    columns = ["task", "seed", "success (%)", "steps", "seconds"]
    lines = []
    for record in sorted(run.experts, key=lambda record: (record["task"], record["seed"])):
        line = [
            str(record["task"]),
            str(record["seed"]),
            points(float(record["success"])),
            f"{int(record['steps']):,}" if record.get("steps") is not None else "-",
            _short(record.get("seconds")),
        ]
        if acting is not None:
            line.append("yes" if (record["task"], record["seed"]) in acting else "no")
        lines.append(line)
    return Table(columns if acting is None else [*columns, "in the data"], lines)


def _acting(run: RunInputs, least: float) -> set[tuple[str, int]]:
    """Return (task, seed) of the experts that made the data."""
    good = [(r["task"], r["seed"]) for r in run.experts if float(r["success"]) >= least]
    count = _data_setting(run, "experts")
    return {
        pair
        for task in {task for task, _ in good}
        for pair in sorted(pair for pair in good if pair[0] == task)[:count]
    }


def _data_setting(run: RunInputs, name: str) -> Any:
    return run.recipe.get("data", {}).get(name)


def experts_of_settings(
    run: RunInputs, mixtures: Sequence[tuple[str, Sequence[Mapping[str, Any]]]]
) -> Section:
    """Show the experts of a grid, and how differently those of each setting (name, records) act."""
    if not run.experts:
        return Section("experts", "Experts", [Note("No expert records in this run.")])
    text = (
        "Experts are trained with reinforcement learning and shared by all settings, which differ "
        "in who of them acts, or how randomly."
    )
    diversity = _diversity(["setting"], [([name], records) for name, records in mixtures])
    return Section("experts", "Experts", [Paragraph(text), _expert_table(run), *diversity])


def _diversity(
    columns: list[str], mixtures: Sequence[tuple[list[str], Sequence[Mapping[str, Any]]]]
) -> list[Block]:
    """Show how differently the experts of each mixture act; `columns` name its first cells."""
    lines = [
        [*cells, str(found["task"]), str(found["experts"]), f"{found['mean_distance']:.2f}"]
        for cells, records in mixtures
        for found in records
        if found["mean_distance"] is not None  # a single expert has nobody to differ from
    ]
    if not lines:
        return []
    text = (
        "Diversity of the mixture: the Hellinger distance between the action distributions of two "
        "experts on the same states of the data, mean over states and pairs. 0: they act alike; "
        "1: no action of one is possible for the other."
    )
    return [Paragraph(text), Table([*columns, "task", "experts", "distance"], lines)]


# -- provenance ------------------------------------------------------------------------------


def provenance(run: RunInputs) -> Section:
    """Show machine, versions, hashes and the recipe."""
    blocks: list[Block] = []
    lines = [[key, value] for key, value in _flat(run.manifest)]
    if lines:
        blocks.append(Table(["what", "value"], lines, left=2))
    else:
        blocks.append(Note("The run has no manifest: machine and versions are unknown."))
    policies = _digests(run.episodes)
    if policies:
        blocks.append(Fold("Digests of policies and scenes", [policies]))
    if run.recipe_text:
        blocks.append(Fold("The recipe, resolved", [Code(run.recipe_text, "toml")]))
    else:
        blocks.append(Note("The run has no recipe.toml."))
    return Section("provenance", "Machine, versions, recipe", blocks)


def _flat(record: Any, prefix: str = "") -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for key, value in record.items():
        if isinstance(value, dict):
            found.extend(_flat(value, f"{prefix}{key} "))
        elif value is not None:
            found.append((f"{prefix}{key}".replace("_", " "), str(value)))
    return found


def _pairs(record: Any) -> str:
    return ", ".join(f"{key} {value}" for key, value in _flat(record))


def _digests(episodes: pd.DataFrame) -> Table | None:
    names = [name for name in ("policy", "scene") if name in episodes.columns]
    if not names:
        return None
    keys = ["task", "checkpoint", "train_seed"]
    rows = episodes[[*keys, *names]].drop_duplicates().sort_values(keys)
    lines = [[str(value) for value in row] for row in rows.itertuples(index=False)]
    return Table([*(key.replace("_", " ") for key in keys), *names], lines, left=len(keys + names))


def trace(results: Results) -> Section:
    """Say how every number is found again in the episode rows, with one worked example."""
    blocks: list[Block] = [
        Paragraph(
            "Every number comes from one table with one row per episode: the parquet files in "
            "`results/episodes/`. `report/rows.json` holds all rows of this report unrounded, and "
            "under `cells` the files behind each of them: a file's name begins with its cell's key."
        )
    ]
    example = reproduction(results)
    if example is not None:
        code, value = example
        blocks += [
            Paragraph(f"This line, started in the run's folder, prints **{points(value)}**:"),
            Code(code, "python"),
        ]
    lines = [
        [
            cell["task"],
            cell["method"],
            str(cell["train_seed"]),
            f"d={cell['delay']} s={cell['exec_horizon']} K={cell['flow_steps']}",
            f"{cell['solved']}/{cell['episodes']}",
            " ".join(cell["cells"]),
        ]
        for cell in results.cells
    ]
    columns = ["task", "method", "seed", "cell", "solved", "cell key"]
    table = Table(columns, lines, left=len(columns))
    blocks.append(Fold(f"All {len(lines)} cells with their keys", [table]))
    return Section("trace", "Where the numbers come from", blocks)


def cell_keys(rows: pd.DataFrame) -> list[Row]:
    """Return solved and episodes of each cell of prepared rows, with the keys of its files."""
    if "cell" not in rows.columns:
        rows = rows.assign(cell="")
    keys = ["task", "method", "train_seed", "delay", "exec_horizon", "flow_steps"]
    groups = rows.groupby(keys, sort=True)
    return [
        dict(zip(keys, (_plain(value) for value in names), strict=True))
        | {
            "solved": int(group["solved"].sum()),
            "episodes": len(group),
            "cells": sorted(group["cell"].astype(str).unique()),
        }
        for names, group in groups
    ]


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else int(value)


def reproduction(results: Results) -> tuple[str, float] | None:
    """Return a line of pandas and the success rate that it reproduces (a mean over tasks)."""
    rows = _named_methods(pick(results.summary, task=ALL, train_seed=ALL))
    # A method whose name was made longer to tell settings apart is not in the files as such.
    rows = [row for row in rows if "(" not in row["method"]]
    if not rows:
        return None
    row = max(rows, key=lambda row: (row["method"] == "prefix", row["delay"]))
    code = (
        "import pandas as pd\n"
        'rows = pd.read_parquet("results/episodes")\n'
        f'rows = rows.query(\'method == "{row["method"]}" and delay == {row["delay"]} '
        f"and exec_horizon == {row['exec_horizon']} and flow_steps == {row['flow_steps']}')\n"
        'rows = rows.drop_duplicates(["task", "train_seed", "episode"])\n'
        'print(round(100 * rows.groupby("task").solved.mean().mean(), 1))\n'
    )
    return code, row["success"]


def glossary() -> Section:
    """Explain the words."""
    return Section("glossary", "Words", [Definitions(GLOSSARY)])
