"""`jaxos4 report`: the HTML report and the figures of a study."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console


def report(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a study, with its results.nc.")],
) -> None:
    """Write the report of a study: report.html and figures/ as SVG and PDF."""
    from ..report import read_results, write_report  # here, because matplotlib is slow to import

    with Console(stderr=True).status("drawing"):
        written = write_report(read_results(directory), directory)
    figures = {path.stem for path in written[1:]}
    typer.echo(f"{written[0]}: {written[0].stat().st_size / 1e6:.1f} MB, opens in any browser, no network needed")
    if figures:
        typer.echo(f"{written[1].parent}: {len(figures)} figures, each as SVG and PDF")
