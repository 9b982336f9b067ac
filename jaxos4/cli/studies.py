"""`jaxos4 study`, `report` and `compare`: a noise study, its report, and the paper's comparison of methods in one."""

import time
from functools import partial
from pathlib import Path
from typing import Any

import typer

import jaxos4

from .._files import write_file
from .._xla import add_flags
from ..errors import InputError, in_words
from ..estimators import ESTIMATORS
from . import options
from ._shared import check_outputs, command, console, showing_stages


def study(
    specification: options.Specification,
    out: options.StudyOut,
    dry_run: options.DryRun = False,
    scheduler: options.Scheduler = None,
) -> None:
    """Run a noise study, or resume it.

    Finished cells are kept.
    """
    with showing_stages("loading the library"):
        wanted = jaxos4.study.load_study(specification)
    if dry_run:
        _print_plan(wanted, out)
        return
    if scheduler is None:
        dataset = run_with_bar(wanted, out)
    else:
        with _connected(scheduler) as client:
            run = partial(jaxos4.study.run_on_cluster, client=client)
            dataset = run_with_bar(wanted, out, device="Dask cluster", run=run)
    typer.echo(f"{out}: {jaxos4.report.count_outcomes(dataset)}; `jaxos4 report {out}` shows them.")


def run_with_bar(wanted: "jaxos4.study.Study", out: Path, *, device: str | None = None, **how: Any) -> Any:
    """The Dataset of `jaxos4.study.run_study`, with a progress bar. `device`: by default those of this process."""
    try:
        with showing_stages("compiling", wanted.count) as progress:
            return jaxos4.study.run_study(wanted, out, device or jaxos4.study.device_name(), progress=progress, **how)
    except KeyboardInterrupt:
        typer.echo(f"jaxos4: {out}: interrupted; run the same command again to continue.", err=True)
        raise


def _print_plan(wanted: "jaxos4.study.Study", out: Path) -> None:
    from ..report.text import Listing

    rows = jaxos4.study.plan(wanted, out)
    table = [(estimator, *map(str, counts)) for estimator, counts in rows.items()]
    Listing(("estimator", "cells", "flights"), table, ("cells", "flights")).print_on(console())
    cells, flights = (sum(column) for column in zip(*rows.values(), strict=True))
    device = jaxos4.study.device_name()
    typer.echo(f"{cells} of {wanted.count} cells to be run, {flights} flights to be identified, on {device}.")


def _connected(address: str):
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler: the package distributed is missing; install jaxos4[dask].") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        why = f"no Dask scheduler answers ({in_words(error)}); give another address"
        raise InputError(f"--scheduler {address}: {why}.") from None


def report(
    source: options.Reported, out: options.PageOut = None, csv: options.Csv = None, pdf: options.Pdf = False
) -> None:
    """Make the page of a result, or the report of a study.

    The report of a study is report.html, with figures/ as SVG.
    """
    if not source.exists():
        raise InputError(
            f"{source}: is not there; give the folder of a `jaxos4 study`, or a file of `jaxos4 estimate --out`."
        )
    if source.is_dir():
        if out is not None:
            raise InputError(f"--out: {source} is a folder, in which its report is written; leave it out.")
        with showing_stages("loading the library") as progress:
            progress("reading")
            dataset = jaxos4.study.read_results(source)
            progress("drawing")
            if csv is not None:
                check_outputs(source / "results.nc", csv=csv)
                write_file(csv, jaxos4.report.error_csv(dataset))
            page, *figures = jaxos4.report.write_report(dataset, source, pdf=pdf)
    else:
        if csv is not None:
            table = "`found.to_dataframe()` in Python makes its table"
            raise InputError(f"--csv: {source} is a result; {table}. Leave it out.")
        if pdf:
            raise InputError(f"--pdf: {source} is a result, which has a page alone; leave it out.")
        page, figures = source.with_suffix(".html") if out is None else out, []
        check_outputs(source, out=page)
        with showing_stages("loading the library") as progress:
            progress("reading")
            found = jaxos4.read_result(source)
            progress("drawing")
            jaxos4.report.write_flight_page(page, found)
    typer.echo(f"{page}: {page.stat().st_size / 1e6:.1f} MB, opens in any browser, no network needed")
    if figures:
        typer.echo(f"{figures[0].parent}: {len(figures) // (1 + pdf)} figures, as SVG{' and PDF' if pdf else ''}")
    if csv is not None:
        typer.echo(f"{csv}: errors, bounds, efficiency and coverage")


def compare(
    results: options.Compared = None,
    report: options.Page = None,
    out: options.ComparisonOut = None,
    quick: options.Quick = False,
) -> None:
    """Compare results of repeated flights, or all estimators.

    Without results, compares all estimators on the standard flight.
    """
    if results:
        if quick or out is not None:
            raise InputError(f"{'--quick' if quick else '--out'}: is for a comparison of estimators; leave it out.")
        _compare_results(results, report)
    elif report is not None:
        raise InputError("--report: is for a comparison of results; give the files of `jaxos4 estimate --out`.")
    else:
        _compare_estimators(out, quick=quick)


def _compare_results(results: list[Path], page: Path | None) -> None:
    """Exit code 1 if the results differ."""
    check_outputs(*results, report=page)
    with showing_stages("loading the library") as progress:
        progress("reading")
        found = jaxos4.compare_results(results)
        if page is not None:
            progress("drawing")
            jaxos4.report.write_comparison(page, found, command=command())
    jaxos4.report.print_comparison(console(), found)
    if page is not None:
        typer.echo(f"report: {page}")
    if found.different:
        typer.echo("jaxos4: the results differ by more than chance: see the quantities that differ", err=True)
        raise typer.Exit(1)


def _compare_estimators(out: Path | None, *, quick: bool) -> None:
    begin = time.perf_counter()
    add_flags(brief=quick)
    with showing_stages("loading the library"):
        from ..report.text import print_whole

    directory = Path("comparison-quick" if quick else "comparison") if out is None else out
    dataset = run_with_bar(comparison(quick=quick), directory)
    with showing_stages("drawing"):
        page, *_ = jaxos4.report.write_report(dataset, directory)
    print_whole(console(), jaxos4.report.error_table(dataset))
    typer.echo(f"{jaxos4.report.count_outcomes(dataset)}; {time.perf_counter() - begin:.0f} s")
    typer.echo(f"{page}: the report, with figures/ and results.nc beside it")


def comparison(*, quick: bool) -> "jaxos4.study.Study":
    """The study that compares the estimators, or a short one. A hybrid's search needs only a short training."""
    if quick:
        return jaxos4.study.Study(
            title="IBSS, network, hybrid and a Kalman filter under sensor noise, body rates alone, in short",
            channels=("rates",),
            estimators=("ibss", "network", "hybrid", "kalman"),  # kalman: the baseline that compiles fastest
            flights=128,
            network=jaxos4.study.Training(steps=500, held_out=1000),
        )
    return jaxos4.study.Study(
        title="IBSS, network, hybrid and baselines under sensor noise",
        estimators=tuple(name for name, kind in ESTIMATORS.items() if kind.in_comparison),
        flights=256,
        network=jaxos4.study.Training(steps=2000, held_out=5000, hybrid_channels="rates"),
    )
