"""`jaxos4 compare`: the paper's comparison of methods under noise, from simulation to report."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..estimators import ESTIMATORS
from ..study import Study, Training, device_name, run_here, use_all_cores
from ._studies import carry_out, summary

# Shorter training than a network takes at its best: it costs the network, and not the hybrid, which needs no more than
# the rates' network to know where to look.
STANDARD = Study(
    title="IBSS, network, hybrid and baselines under sensor noise",
    estimators=tuple(ESTIMATORS),
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
        Path | None, typer.Option(help="The folder to write; comparison, or comparison-quick, without it.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Body rates alone, 128 flights, of the baselines kalman, figures as SVG.")
    ] = False,
) -> None:
    """Compare IBSS, network, hybrid and baselines on the standard flight at three noises: table, figures, report."""
    begin = time.perf_counter()
    use_all_cores()
    wanted, folder = (QUICK, "comparison-quick") if quick else (STANDARD, "comparison")
    directory = Path(folder) if out is None else out
    dataset = carry_out(wanted, directory, device_name(), run_here)
    from ..report import error_table, write_report  # here: drawing takes seconds to import

    Console(highlight=False).print(error_table(dataset))
    with Console(stderr=True).status("drawing the report"):
        page, *_ = write_report(dataset, directory, with_pdf=not quick)
    typer.echo(f"{summary(dataset)}; {time.perf_counter() - begin:.0f} s")
    typer.echo(f"{page}: the report, with figures/ and results.nc beside it")
