"""`rtc eval`: success under delay, for each way of hiding it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from rtc_cli.cli.live import run_jobs
from rtc_cli.cli.options import (
    ChargeOption,
    DelayCapOption,
    DelayModelOption,
    DelaysOption,
    EpisodesOption,
    EstimatorOption,
    FixedMsOption,
    FlowStepsOption,
    HzOption,
    JsonOption,
    MethodsOption,
    ObservationLagOption,
    OnExceedOption,
    OnLateOption,
    ProtocolOption,
    RoundingOption,
    RunOption,
    SaveOption,
    TasksOption,
    WorkersOption,
    check_names,
    read_fixed_ms,
    read_names,
    split_names,
)
from rtc_cli.cli.output import document, output
from rtc_cli.errors import UsageError
from rtc_cli.levels import expand, short_name
from rtc_cli.recipe import EvalConfig, Recipe
from rtc_cli.units import parse_delays

app = typer.Typer()


@app.command(
    name="eval",
    epilog="Examples:  rtc eval --delays 0-4   |   "
    "rtc eval --methods naive,prefix --protocol fixed:4   |   rtc eval --matrix --json   |   "
    "rtc eval --delay-model uniform:0-4 --estimator max-of-last:10 --protocol fixed:4",
)
def evaluate(
    run: RunOption = None,
    delays: DelaysOption = None,
    methods: MethodsOption = None,
    tasks: TasksOption = None,
    protocol: ProtocolOption = None,
    episodes: EpisodesOption = None,
    flow_steps: FlowStepsOption = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds", metavar="LIST", help="Training seeds, as in 0,2-4.  [default: the recipe's]"
        ),
    ] = None,
    hold: Annotated[
        str | None,
        typer.Option("--hold", metavar="last|zero", help="What sync executes while it waits."),
    ] = None,
    mask: Annotated[
        str | None,
        typer.Option(
            "--mask", metavar="exp|linear|zeros|ones", help="How pinv weighs the overlap beyond d."
        ),
    ] = None,
    max_guidance_weight: Annotated[
        float | None,
        typer.Option("--max-guidance-weight", metavar="BETA", help="Clip of pinv's weight."),
    ] = None,
    prior_std: Annotated[
        float | None,
        typer.Option("--prior-std", metavar="SIGMA", help="Standard deviation of pinv's prior."),
    ] = None,
    matrix: Annotated[
        bool,
        typer.Option("--matrix", help="Add {base, prefix} x {plain, pinv, prefix}."),
    ] = False,
    delay_model: DelayModelOption = None,
    delay_cap: DelayCapOption = None,
    estimator: EstimatorOption = None,
    on_late: OnLateOption = None,
    on_exceed: OnExceedOption = None,
    observation_lag: ObservationLagOption = None,
    charge: ChargeOption = None,
    fixed_ms: FixedMsOption = "",
    hz: HzOption = 30.0,
    rounding: RoundingOption = "ceil",
    save: SaveOption = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure success under delay for each way of hiding it.

    Evaluates a trained run's checkpoints; cells that the run already holds are not computed again.
    Delays are control steps. Training seeds are the unit of replication of the differences.
    Delays may vary: --delay-model says how, --estimator what the sampler is told of them.
    With --charge each method, with each number of flow steps that the profile holds, gets the delay
    that its own latency means at --hz, --fixed-ms added.
    """
    from rtc_cli.cli.evaluated import evaluation_document, evaluation_tables, selected_episodes
    from rtc_cli.pipeline.checks import check_evaluation
    from rtc_cli.pipeline.plan import eval_plan
    from rtc_cli.report.sections import compute
    from rtc_cli.runs import newest_run, open_run

    if charge is None and (fixed_ms or save is not None):
        raise UsageError("--fixed-ms and --save belong to --charge", "give a profile with --charge")
    if charge is not None and (delays is not None or delay_model or flow_steps is not None):
        raise UsageError(
            "--charge has delays and flow steps of its own, from the profile",
            "leave --delays, --delay-model and --flow-steps away",
        )
    with output(as_json) as out:
        opened = open_run(run) if run is not None else newest_run()
        if delays is not None and delay_model:
            raise UsageError(
                f"--delays {delays} and --delay-model {delay_model[0]} are two kinds of delays",
                "give one of them; a delay that does not vary is a model too: constant:2",
            )
        changes: dict[str, Any] = {
            "delays": parse_delays(delays) if delays is not None else None,
            "delay_models": delay_model or (None if delays is None else []),
            "delay_cap": delay_cap,
            "estimators": estimator or None,
            "on_late": on_late,
            "on_exceed": on_exceed,
            "observation_lag": observation_lag,
            "methods": _methods(methods),
            "protocols": split_names(protocol) if protocol is not None else None,
            "episodes": episodes,
            "flow_steps": flow_steps,
            "hold": hold,
            "matrix": matrix or (None if methods is None else False),
        }
        guidance = {
            "mask": mask,
            "max_guidance_weight": max_guidance_weight,
            "prior_std": prior_std,
        }
        config = _changed(opened.recipe, changes, guidance)
        chosen_tasks = _tasks(tasks, opened.recipe)
        chosen_seeds = _seeds(seeds, opened.recipe)
        if charge is not None:
            from rtc_cli.cli.charged import evaluate_charged, render_charged
            from rtc_cli.results import machine_record

            content = evaluate_charged(
                opened,
                config,
                chosen_tasks,
                chosen_seeds,
                charge,
                fixed_ms=read_fixed_ms(fixed_ms),
                hz=hz,
                rounding=rounding,
                workers=workers,
            )
            if save is not None:
                from rtc_cli.report.charge.page import save_charge_page

                save_charge_page(save, content)
            shown = document(str(opened.folder), machine_record(), **content)
            out.result(shown, *render_charged(content))
            return
        check_evaluation(config, opened.recipe.horizon)
        with opened.lock():
            jobs = eval_plan(opened, config, chosen_tasks, chosen_seeds)
            run_jobs(opened, jobs, workers)
        results = compute(selected_episodes(opened, config, chosen_tasks, chosen_seeds))
        out.result(evaluation_document(opened, results), *evaluation_tables(results))


def _changed(
    recipe: Recipe, changes: dict[str, Any], guidance: dict[str, str | float | None]
) -> EvalConfig:
    """Return the recipe's evaluation with the options in place, validated like a recipe."""
    from rtc_cli.recipe import recipe_from_dict

    content = recipe.model_dump(mode="json", exclude_none=True)
    content["eval"] |= {name: value for name, value in changes.items() if value is not None}
    pushed, episodes = content["eval"]["reaction_episodes"], content["eval"]["episodes"]
    content["eval"]["reaction_episodes"] = min(pushed, episodes)
    content["eval"]["pinv"] |= {n: value for n, value in guidance.items() if value is not None}
    if changes["methods"] is not None:
        content["eval"].pop("tune", None)
    if not content["eval"]["delay_models"] and changes["delay_cap"] is None:
        content["eval"].pop("delay_cap", None)
    return recipe_from_dict(content, "options", fix="change that option").eval


def _methods(text: str | None) -> tuple[str, ...] | None:
    from rtc_cli.execution.methods import list_methods
    from rtc_cli.pipeline.evaluation import TUNED

    return None if text is None else read_names(text, (*list_methods(), TUNED), "method")


def _tasks(text: str | None, recipe: Recipe) -> tuple[str, ...]:
    """Names as the recipe has them, from full or short names; a folder stands for its levels."""
    if text is None:
        return recipe.tasks
    known = {short_name(task): task for task in recipe.tasks}
    asked = dict.fromkeys(short_name(task) for task in expand(split_names(text)))
    return tuple(known[name] for name in check_names(asked, known, "task of this run"))


def _seeds(text: str | None, recipe: Recipe) -> tuple[int, ...]:
    if text is None:
        return recipe.train.seeds
    wanted = parse_delays(text, what="seeds")
    for seed in wanted:
        if seed not in recipe.train.seeds:
            raise UsageError(
                f"training seed {seed} is not in this run",
                f"its training seeds are {', '.join(map(str, recipe.train.seeds))}; "
                'add seeds to it with "rtc run --seeds"',
            )
    return wanted
