"""`rtc report`: the report of a run, as Markdown and as one HTML page."""

from __future__ import annotations

import typer

from rtc_cli.cli.options import JsonOption, RunOption
from rtc_cli.cli.output import output

app = typer.Typer()


@app.command(epilog="Examples:  rtc report   |   rtc report --run runs/first --json")
def report(run: RunOption = None, as_json: JsonOption = False) -> None:
    """Write the report of a run: Markdown and one HTML page.

    The report lies in the run's folder `report/`, with its figures and all rows unrounded. What
    the run does not hold yet (a profile, more training seeds) is said in the report.
    """
    from rtc_cli.report.losses.grids import render_losses
    from rtc_cli.report.page import build_report
    from rtc_cli.report.terminal import render_report
    from rtc_cli.runs import newest_run, open_run

    with output(as_json) as out:
        opened = newest_run() if run is None else open_run(run)
        with opened.lock():
            built = build_report(opened.folder)
        out.result(
            built.data | {"report": str(built.html), "markdown": str(built.markdown)},
            *render_report(built.data),
            *render_losses(built.data),
            f"report: {built.html}\n        {built.markdown}",
        )
