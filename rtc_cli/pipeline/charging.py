"""Evaluations at equal hardware: one small evaluation per charge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtc_cli.analysis.charge import Charge, find_latencies, read_charges
from rtc_cli.errors import UsageError
from rtc_cli.pipeline.evaluation import methods_of
from rtc_cli.recipe import EvalConfig


@dataclass(frozen=True)
class Charged:
    """A charge with the evaluation that it asks for; None, and why, where no chunk can hide it."""

    charge: Charge
    config: EvalConfig | None
    reason: str = ""


def charged_by(config: EvalConfig, horizon: int) -> list[Charged]:
    """Return what `[eval.charge]` asks for; nothing without it.

    UsageError for latencies that cannot be read or lack a method's sampler. The oracle and tuned
    settings have no part in it.
    """
    charge = config.charge
    if charge is None:
        return []
    samplers = {m.name: m.sampler for m in methods_of(config) if m.schedule != "oracle"}
    charges = read_charges(
        find_latencies(charge.profile),
        samplers,
        fixed_ms=charge.fixed_ms,
        hz=charge.hz,
        rounding=charge.rounding,
    )
    return charged_evaluations(config, horizon, charges)


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
            "charge": None,
        }
        found.append(Charged(charge, config.model_copy(update=changes)))
    return found
