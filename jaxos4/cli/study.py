"""`jaxos4 study`: a noise study, resumed by the same command."""

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from ..errors import InputError
from ..study import Study, device_name, load_study, plan, run_here, run_on_cluster, use_all_cores
from ._studies import carry_out, summary

Executor = StrEnum("Executor", ["local", "dask"])


def study(
    specification: Annotated[Path, typer.Argument(metavar="SPEC.toml", help="What is flown, measured and identified.")],
    out: Annotated[Path, typer.Option(help="The study's folder: new, or to be resumed.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what there is to do.")] = False,
    executor: Annotated[Executor, typer.Option(help="This machine's devices, or a Dask cluster.")] = Executor["local"],
    scheduler: Annotated[str | None, typer.Option(help="Address of the Dask scheduler.")] = None,
) -> None:
    """Run a noise study, or go on with it: cells that are there are kept."""
    use_all_cores()  # before an airframe's table computes anything
    wanted = load_study(specification)
    if (executor is Executor["dask"]) != (scheduler is not None):
        raise InputError("--executor dask and --scheduler ADDRESS: give both, or neither.")
    if dry_run:
        _say_plan(wanted, out)
        return
    if scheduler is None:
        dataset = carry_out(wanted, out, device_name(), run_here)
    else:
        with _connected(scheduler) as client:
            dataset = carry_out(wanted, out, "Dask cluster", partial(run_on_cluster, client=client))
    typer.echo(f"{out}: {summary(dataset)}; `jaxos4 report {out}` shows them.")


def _say_plan(wanted: Study, out: Path) -> None:
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
        "is known for estimators with finished cells, without the training of networks."
    )


def _connected(address: str):
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--executor dask: needs the package distributed; install jaxos4[dask].") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        what = " ".join(str(error).split())[:120]
        raise InputError(f"--scheduler {address}: no Dask scheduler answers there ({what}).") from None
