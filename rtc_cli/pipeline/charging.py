"""Evaluations at equal hardware: one small evaluation per charge, in one plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtc_cli.analysis.charge import Charge
from rtc_cli.errors import UsageError
from rtc_cli.pipeline.executors import Job
from rtc_cli.pipeline.plan import eval_plan
from rtc_cli.recipe import EvalConfig
from rtc_cli.runs import Run


@dataclass(frozen=True)
class Charged:
    """A charge with the evaluation that it asks for; None, and why, where no chunk can hide it."""

    charge: Charge
    config: EvalConfig | None
    reason: str = ""


def charged_evaluations(
    config: EvalConfig, horizon: int, charges: Sequence[Charge]
) -> list[Charged]:
    """One evaluation per charge: its method, its K, its delay; the rest as in `config`.

    A delay that the protocol's geometry does not allow at this horizon is not evaluated: its
    chunks would arrive when their predecessors have run out.
    """
    from rtc_cli.execution.protocols import protocol_cells

    found = []
    for charge in charges:
        try:
            for protocol in config.protocols:
                protocol_cells(protocol, horizon, (charge.delay,))
        except UsageError as error:
            found.append(Charged(charge, None, error.message))
            continue
        changes: dict[str, Any] = {
            "methods": (charge.method,),
            "flow_steps": charge.flow_steps,
            "delays": (charge.delay,),
            "delay_models": (),
            "delay_cap": None,
            "matrix": False,
            "tune": None,
        }
        found.append(Charged(charge, config.model_copy(update=changes)))
    return found


def charged_plan(
    run: Run, charged: Sequence[Charged], tasks: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    """The jobs of all evaluations that are possible; cells that the run holds are not repeated."""
    jobs = []
    for each in charged:
        if each.config is None:
            continue
        label = f"K = {each.charge.flow_steps}, d = {each.charge.delay}"
        for job in eval_plan(run, each.config, tasks, seeds):
            jobs.append(dataclasses.replace(job, name=f"{job.name} · {label}"))
    return jobs
