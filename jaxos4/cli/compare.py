"""`jaxos4 compare`: the paper's comparison of methods under noise, from simulation to report."""

import time
from pathlib import Path
from typing import Annotated

import typer

from ._output import stages


def compare(
    out: Annotated[
        Path | None, typer.Option(help="The folder to write. Default: comparison, or comparison-quick.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Only body rates, 128 flights, four estimators, and SVG figures.")
    ] = False,
) -> None:
    """Compare all estimators on the standard flight at three noise levels: table, figures, report."""
    begin = time.perf_counter()
    with stages("loading the library"):
        from rich.console import Console

        from ..report import error_table, write_report
        from ..report.study_terminal import count_outcomes, run_with_bar
        from ..report.text import print_whole
        from ..study import comparison, use_all_cores

    use_all_cores()
    wanted, folder = (comparison.QUICK, "comparison-quick") if quick else (comparison.STANDARD, "comparison")
    directory = Path(folder) if out is None else out
    dataset = run_with_bar(wanted, directory)
    print_whole(Console(highlight=False), error_table(dataset))
    with stages("drawing"):
        page, *_ = write_report(dataset, directory, with_pdf=not quick)
    typer.echo(f"{count_outcomes(dataset)}; {time.perf_counter() - begin:.0f} s")
    typer.echo(f"{page}: the report, with figures/ and results.nc beside it")
