"""`jaxos4 report`: the HTML report and the figures of a study."""

from pathlib import Path
from typing import Annotated

import typer

from ._output import stages


def report(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a study, with its results.nc.")],
) -> None:
    """Write the report of a study: report.html and figures/ as SVG and PDF."""
    with stages("loading the library") as progress:
        from ..report import read_results, write_report

        progress("reading")
        dataset = read_results(directory)
        progress("drawing")
        written = write_report(dataset, directory)
    figures = {path.stem for path in written[1:]}
    typer.echo(f"{written[0]}: {written[0].stat().st_size / 1e6:.1f} MB, opens in any browser, no network needed")
    if figures:
        typer.echo(f"{written[1].parent}: {len(figures)} figures, each as SVG and PDF")
