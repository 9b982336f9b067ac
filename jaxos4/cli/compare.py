"""`jaxos4 compare`: the paper's comparison of methods under noise, from simulation to report."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ._options import Estimator
from ._output import stages

if TYPE_CHECKING:
    from ..study import Study


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
        from ..study import use_all_cores

    use_all_cores()
    directory = Path("comparison-quick" if quick else "comparison") if out is None else out
    dataset = run_with_bar(comparison(quick=quick), directory)
    print_whole(Console(highlight=False), error_table(dataset))
    with stages("drawing"):
        page, *_ = write_report(dataset, directory, with_pdf=not quick)
    typer.echo(f"{count_outcomes(dataset)}; {time.perf_counter() - begin:.0f} s")
    typer.echo(f"{page}: the report, with figures/ and results.nc beside it")


def comparison(*, quick: bool) -> "Study":
    """The study that compares the estimators: the whole one, or a short one.

    The training is shorter than the best one. The network loses accuracy, the hybrid does not: its search starts from a
    network of the rates, and a short training is enough for that.
    """
    from ..study import Study, Training

    if quick:
        return Study(
            title="IBSS, network, hybrid and a Kalman filter under sensor noise, body rates alone, in short",
            channels=("rates",),
            estimators=("ibss", "network", "hybrid", "kalman"),  # kalman: the baseline that compiles fastest
            flights=128,
            network=Training(steps=500, held_out=1000),
        )
    return Study(
        title="IBSS, network, hybrid and baselines under sensor noise",
        # The ant colony alone takes longer than all the others: `experiments/comparison` has it.
        estimators=tuple(name.value for name in Estimator if name != "ant-colony"),
        flights=256,
        network=Training(steps=2000, held_out=5000, hybrid_channels="rates"),
    )
