"""An evaluation under measured latencies, as their analysis advises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rtc_cli.analysis.latency import LatencyAnalysis
from rtc_cli.execution.delay_models import LONGEST
from rtc_cli.execution.trace_delays import digest, trace_model
from rtc_cli.files import write_text
from rtc_cli.runs import Run


def keep_latencies(run: Run, analysis: LatencyAnalysis, name: str) -> Path:
    """Write the latencies after the warm-up into a run; return the file, one column of ms.

    Nothing is lost: reading it gives the same numbers, the sum of all components. Equal latencies
    have one place, whatever file they came from but for its `name`.
    """
    kept = analysis.trace.after(analysis.warm_up.rows)
    path = run.traces / digest(kept) / f"{name}.csv"
    if not path.is_file():
        values = (np.format_float_positional(value, trim="0") for value in kept.total_ms)
        write_text(path, "\n".join(["latency_ms", *values]) + "\n")
    return path


def advised(analysis: LatencyAnalysis, latencies: Path) -> dict[str, Any]:
    """Return what the analysis makes of `[eval]`: delays, s, what the sampler is told, and K.

    The advice "percentile:0.95 of this trace" is one number that is always told, so the estimator
    is a constant. No delay is cut off: a chunk of H steps or more is dropped, as it would be.
    """
    advice = analysis.recommendation
    longest = int(np.clip(analysis.measured.max(), advice.horizon - 1, LONGEST))
    told = advice.estimator if advice.delay_cond is None else f"constant:{advice.delay_cond}"
    return {
        "delay_models": [trace_model(latencies, analysis.hz, analysis.rounding)],
        "delay_cap": longest,
        "protocols": [f"fixed:{advice.exec_horizon}"],
        "estimators": [told],
        "flow_steps": analysis.trace.flow_steps,
    }
