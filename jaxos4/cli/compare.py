"""`jaxos4 compare`: the paper's comparison of methods under noise, from simulation to report."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..study import Study, Training, use_all_cores
from ._choices import Estimator

# The training is shorter than the best one. The network loses accuracy, the hybrid does not: its search starts from a
# network of the rates, and a short training is enough for that.
STANDARD = Study(
    title="IBSS, network, hybrid and baselines under sensor noise",
    estimators=tuple(estimator.value for estimator in Estimator),
    flights=256,
    network=Training(steps=2000, held_out=5000, hybrid_channels="rates"),
)
QUICK = Study(
    title="IBSS, network, hybrid and a Kalman filter under sensor noise, body rates alone, in short",
    channels=("rates",),
    estimators=("ibss", "network", "hybrid", "kalman"),  # kalman: the baseline that compiles fastest
    flights=128,
    network=Training(steps=500, held_out=1000),
)


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
    use_all_cores()
    wanted, folder = (QUICK, "comparison-quick") if quick else (STANDARD, "comparison")
    directory = Path(folder) if out is None else out
    from ..report import error_table, write_report  # here, because matplotlib is slow to import
    from ..report.progress import count_outcomes, run_with_bar

    dataset = run_with_bar(wanted, directory)
    Console(highlight=False).print(error_table(dataset))
    with Console(stderr=True).status("drawing the report"):
        page, *_ = write_report(dataset, directory, with_pdf=not quick)
    typer.echo(f"{count_outcomes(dataset)}; {time.perf_counter() - begin:.0f} s")
    typer.echo(f"{page}: the report, with figures/ and results.nc beside it")
