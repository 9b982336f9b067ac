"""`jaxos4 study`: a noise study, resumed by the same command."""

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ._output import stages

if TYPE_CHECKING:
    from ..study import Study

Executor = StrEnum("Executor", ["local", "dask"])


def study(
    specification: Annotated[Path, typer.Argument(metavar="SPEC.toml", help="The specification of the study.")],
    out: Annotated[Path, typer.Option(help="Folder of the study: a new one, or one to resume.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show the plan.")] = False,
    executor: Annotated[Executor, typer.Option(help="local: this machine; dask: a cluster.")] = Executor["local"],
    scheduler: Annotated[str | None, typer.Option(help="Address of the Dask scheduler, for dask.")] = None,
) -> None:
    """Run a noise study, or resume it: finished cells are kept."""
    if (executor is Executor["dask"]) != (scheduler is not None):
        raise InputError("--executor dask and --scheduler ADDRESS: give both, or neither.")
    with stages("loading the library"):
        from ..study import load_study, run_on_cluster, use_all_cores

        use_all_cores()  # before anything is computed
        wanted = load_study(specification)
    if dry_run:
        _print_plan(wanted, out)
        return
    from ..report.study_terminal import count_outcomes, run_with_bar

    if scheduler is None:
        dataset = run_with_bar(wanted, out)
    else:
        with _connected(scheduler) as client:
            dataset = run_with_bar(wanted, out, device="Dask cluster", run=partial(run_on_cluster, client=client))
    typer.echo(f"{out}: {count_outcomes(dataset)}; `jaxos4 report {out}` shows them.")


def _print_plan(wanted: "Study", out: Path) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from ..study import device_name, plan

    rows = plan(wanted, out)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("estimator", "cells", "flights", "programs", "networks", "time [min]"):
        table.add_column(heading, justify="left" if heading == "estimator" else "right")
    for *counts, seconds in rows:
        table.add_row(*map(str, counts), "-" if seconds is None else f"{seconds / 60:.1f}")
    Console(highlight=False).print(table)
    cells, flights = sum(row.cells for row in rows), sum(row.flights for row in rows)
    typer.echo(
        f"{cells} of {wanted.count} cells to be run, {flights} flights to be identified, on {device_name()}. The time "
        "is known for estimators with finished cells. It does not include the training of networks."
    )


def _connected(address: str):
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--executor dask: the package distributed is missing; install jaxos4[dask].") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        what = " ".join(str(error).split())[:120]
        raise InputError(f"--scheduler {address}: no Dask scheduler answers ({what}); give another address.") from None
