"""How large is the error if the simulation and the fit integrate the equations with different methods?

The script writes a folder for each method and sample time of the fit. Each folder has flights from all methods of
simulation.
"""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from experiments.shared import run_studies
from jaxos4.study import load_study


def main(
    specification: Path,
    out: Annotated[Path, typer.Option(help="Folder for the studies, new or to be resumed.")],
    fit_methods: Annotated[list[str], typer.Option(help="Integration methods of the fit.")] = ("euler", "rk4"),
    dts: Annotated[list[float], typer.Option(help="Sample times, in seconds.")] = (0.01, 0.002),
) -> None:
    """Run the study once for each integration method of the fit and each sample time."""
    study = load_study(specification)
    variants = {
        f"{method} {dt:g} s": msgspec.structs.replace(study, fit_method=method, dt=dt)
        for dt in dts
        for method in fit_methods
    }
    run_studies(variants, out)
