"""`jaxos4 study`, `report` and `compare`: a noise study, its report, and the paper's comparison of methods in one."""

import shlex
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from ..errors import InputError, printable
from ._options import ESTIMATORS
from ._output import check_outputs, stages

if TYPE_CHECKING:
    from ..study import Study


def study(
    specification: Annotated[Path, Argument(metavar="SPEC.toml", help="The specification of the study.")],
    out: Annotated[Path, Option(help="Folder of the study: a new one, or one to resume.")],
    dry_run: Annotated[bool, Option("--dry-run", help="Only show the plan.")] = False,
    scheduler: Annotated[str | None, Option(help="Address of a Dask scheduler. Default: this machine.")] = None,
) -> None:
    """Run a noise study, or resume it: finished cells are kept."""
    with stages("loading the library"):
        from ..study import load_study, run_on_cluster

        wanted = load_study(specification)
    if dry_run:
        _print_plan(wanted, out)
        return
    from ..report.study_tables import count_outcomes

    if scheduler is None:
        dataset = run_with_bar(wanted, out)
    else:
        with _connected(scheduler) as client:
            dataset = run_with_bar(wanted, out, device="Dask cluster", run=partial(run_on_cluster, client=client))
    typer.echo(f"{out}: {count_outcomes(dataset)}; `jaxos4 report {out}` shows them.")


def run_with_bar(wanted: "Study", out: Path, *, device: str | None = None, **how: Any) -> Any:
    """The Dataset of `jaxos4.study.carry_out`, with a progress bar. `device`: by default those of this process."""
    from ..study import carry_out, device_name

    try:
        with stages("compiling", wanted.count) as show:
            return carry_out(wanted, out, device or device_name(), progress=show, **how)
    except KeyboardInterrupt:
        typer.echo(f"jaxos4: {out}: interrupted; run the same command again to continue.", err=True)
        raise


def _print_plan(wanted: "Study", out: Path) -> None:
    from rich.console import Console

    from ..report.text import Listing
    from ..study import device_name, plan

    rows = plan(wanted, out)
    table = [(estimator, *map(str, counts)) for estimator, counts in rows.items()]
    Listing(("estimator", "cells", "flights"), table, ("cells", "flights")).print_on(Console(highlight=False))
    cells, flights = (sum(column) for column in zip(*rows.values(), strict=True))
    typer.echo(f"{cells} of {wanted.count} cells to be run, {flights} flights to be identified, on {device_name()}.")


def _connected(address: str):
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler: the package distributed is missing; install jaxos4[dask].") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        what = " ".join(str(error).split())[:120]
        raise InputError(f"--scheduler {address}: no Dask scheduler answers ({what}); give another address.") from None


def report(
    source: Annotated[Path, Argument(metavar="SOURCE", help="The folder of a study, or a file of `estimate --out`.")],
    out: Annotated[Path | None, Option(help="Of a file: the page to write. Default: beside it, as .html.")] = None,
) -> None:
    """Write the report of a study: report.html, and figures/ as SVG; or the page of a result."""
    page = source.with_suffix(".html") if out is None else out
    if not source.exists():
        raise InputError(
            f"{source}: is not there; give the folder of a `jaxos4 study`, or a file of `jaxos4 estimate --out`."
        )
    if not source.is_dir():
        check_outputs(source, out=page)
    elif out is not None:
        raise InputError(f"--out: {source} is a folder, in which its report is written; leave it out.")
    with stages("loading the library") as progress:
        from ..report import write_flight_page, write_report

        progress("reading")
        figures: list[Path] = []
        if source.is_dir():
            from ..study import read_results

            dataset = read_results(source)
            progress("drawing")
            page, *figures = write_report(dataset, source)
        else:
            from ..result_file import read_result

            found = read_result(source)
            progress("drawing")
            write_flight_page(page, found)
    typer.echo(f"{page}: {page.stat().st_size / 1e6:.1f} MB, opens in any browser, no network needed")
    if figures:
        typer.echo(f"{figures[0].parent}: {len(figures)} figures, as SVG")


def compare(
    results: Annotated[
        list[Path] | None,
        Argument(
            metavar="[RESULT.json...]", help="Files of `estimate --out` to compare. Without them: all estimators."
        ),
    ] = None,
    page: Annotated[Path | None, Option("--report", help="With results: an HTML page to write.")] = None,
    out: Annotated[Path | None, Option(help="The folder to write. Default: comparison, or comparison-quick.")] = None,
    quick: Annotated[bool, Option("--quick", help="Only body rates, 128 flights and four estimators.")] = False,
) -> None:
    """Compare results of repeated flights; or, without results, all estimators on the standard flight."""
    if results:
        if quick or out is not None:
            raise InputError(f"{'--quick' if quick else '--out'}: is for a comparison of estimators; leave it out.")
        _compare_results(results, page)
    elif page is not None:
        raise InputError("--report: is for a comparison of results; give the files of `jaxos4 estimate --out`.")
    else:
        _compare_estimators(out, quick=quick)


def _compare_results(results: list[Path], page: Path | None) -> None:
    """Exit code 1 if the results differ."""
    check_outputs(*results, report=page)
    with stages("loading the library") as progress:
        from rich.console import Console

        from ..comparison import compare_results
        from ..report import print_comparison, write_comparison

        progress("reading")
        found = compare_results(results)
        if page is not None:
            progress("drawing")
            command = shlex.join(["jaxos4", "compare", *map(str, results), "--report", str(page)])
            write_comparison(page, found, command=printable(command))
    print_comparison(Console(), found)
    if page is not None:
        typer.echo(f"report: {page}")
    if found.different:
        typer.echo("jaxos4: the results differ by more than chance: see the quantities that differ", err=True)
        raise typer.Exit(1)


def _compare_estimators(out: Path | None, *, quick: bool) -> None:
    begin = time.perf_counter()
    with stages("loading the library"):
        from rich.console import Console

        from ..report import error_table, write_report
        from ..report.study_tables import count_outcomes
        from ..report.text import print_whole

    directory = Path("comparison-quick" if quick else "comparison") if out is None else out
    dataset = run_with_bar(comparison(quick=quick), directory)
    print_whole(Console(highlight=False), error_table(dataset))
    with stages("drawing"):
        page, *_ = write_report(dataset, directory)
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
        estimators=tuple(name for name, kind in ESTIMATORS.items() if kind.in_comparison),
        flights=256,
        network=Training(steps=2000, held_out=5000, hybrid_channels="rates"),
    )
