"""`rtc eval`: success under delay, for each way of hiding it."""

from __future__ import annotations

from typing import Annotated

import typer

from rtc_cli.cli.evaluating import (
    ask,
    evaluate_asked,
    open_asked,
    read_methods,
    read_protocols,
)
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
    SeedsOption,
    TasksOption,
    WorkersOption,
    read_fixed_ms,
)
from rtc_cli.cli.output import document, output
from rtc_cli.errors import UsageError
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
    seeds: SeedsOption = None,
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
    from rtc_cli.cli.evaluated import evaluation_document, evaluation_tables
    from rtc_cli.report.sections import compute

    if charge is None and (fixed_ms or save is not None):
        raise UsageError("--fixed-ms and --save belong to --charge", "give a profile with --charge")
    if charge is not None and (delays is not None or delay_model or flow_steps is not None):
        raise UsageError(
            "--charge has delays and flow steps of its own, from the profile",
            "leave --delays, --delay-model and --flow-steps away",
        )
    if delays is not None and delay_model:
        raise UsageError(
            f"--delays {delays} and --delay-model {delay_model[0]} are two kinds of delays",
            "give one of them; a delay that does not vary is a model too: constant:2",
        )
    with output(as_json) as out:
        changes = {
            "delays": parse_delays(delays) if delays is not None else None,
            "delay_models": delay_model or (None if delays is None else []),
            "delay_cap": delay_cap,
            "estimators": estimator or None,
            "on_late": on_late,
            "on_exceed": on_exceed,
            "observation_lag": observation_lag,
            "methods": read_methods(methods),
            "protocols": read_protocols(protocol),
            "episodes": episodes,
            "flow_steps": flow_steps,
            "hold": hold,
            "matrix": matrix or (None if methods is None else False),
            "charge": None
            if charge is None
            else {
                "profile": charge,
                "fixed_ms": read_fixed_ms(fixed_ms),
                "hz": hz,
                "rounding": rounding,
            },
        }
        guidance = {
            "mask": mask,
            "max_guidance_weight": max_guidance_weight,
            "prior_std": prior_std,
        }
        asked = ask(open_asked(run), changes, tasks=tasks, seeds=seeds, guidance=guidance)
        if charge is not None:
            from rtc_cli.cli.charged import evaluate_charged, render_charged
            from rtc_cli.results import machine_record

            content = evaluate_charged(asked, workers)
            if save is not None:
                from rtc_cli.report.charge.page import save_charge_page

                save_charge_page(save, content)
            shown = document(str(asked.run.folder), machine_record(), **content)
            out.result(shown, *render_charged(content))
            return
        results = compute(evaluate_asked(asked, workers))
        out.result(evaluation_document(asked.run, results), *evaluation_tables(results))
