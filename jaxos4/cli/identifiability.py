"""`jaxos4 identifiability`: what a flight can tell of each parameter, and why not of the others."""

from pathlib import Path
from typing import Annotated

import numpy as np
import rich.box
import typer
from rich.console import Console
from rich.table import Table

from ..airframe import load_airframe
from ..bracket import Bracket
from ..dynamics import MODELS
from ..estimators import IBSS
from ..identifiability import identifiability as information_of
from ..logs import read_flight_and_notes
from ..results import result_names
from ._bracket_file import load_bracket
from ._choices import Channels, InitialState, Model
from .estimate import NO_ANSWER, fit, problem_of

# Of a direction, what is not shown: shares of a half-width below this one of the largest.
SMALL = 0.1


def identifiability(
    flight: Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="The recorded flight.")],
    model: Annotated[Model, typer.Option(help="The equations: as printed, or corrected.")] = Model["published"],
    airframe: Annotated[str, typer.Option(help="os4, os4-simulator, voos, or a TOML file.")] = "os4",
    bracket: Annotated[Path | None, typer.Option(help="TOML file: alpha1 = \\[lower, upper], ...")] = None,
    channels: Annotated[
        Channels | None, typer.Option(help="What is looked at; all that was measured without it.")
    ] = None,
    initial_state: Annotated[
        InitialState, typer.Option(help="free: estimated too; known: the first sample is exact.")
    ] = InitialState["free"],
) -> None:
    """What a flight tells of alpha_1..8, and why not of others: not excited, not told apart, below the noise."""
    console = Console()
    vehicle = MODELS[model](load_airframe(airframe))
    where = Bracket.default(vehicle) if bracket is None else load_bracket(bracket, vehicle)
    recorded, notes = read_flight_and_notes(flight, vehicle.airframe)
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    problem = problem_of(flight, vehicle, recorded, channels, known=initial_state == "known")
    problem, found, _, _ = fit(IBSS(), problem, where, shoots=True)
    fitted = str(result_names(found.result)) not in NO_ANSWER
    if not fitted:
        console.print("note: no fit; what follows is at the bracket's center, for the standard noise", highlight=False)
    known = information_of(problem, where, found.parameters, found.initial_state if fitted else None)

    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "bound", "others known", "of bracket", "shows below"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    std, alone, share, limit = (
        np.asarray(x) for x in (known.std, known.std_alone, known.std / known.half_width, known.noise_limit)
    )
    names = vehicle.parameter_names
    for i, (name, unit) in enumerate(zip(names, vehicle.parameter_units, strict=True)):
        shows = f"{limit[i]:.2g} x" if known.told[i] and limit[i] > 0 else "-"
        table.add_row(name, unit, f"{std[i]:.2g}", f"{alone[i]:.2g}", f"{share[i]:.2g}", shows)
    console.print(table, markup=False)
    console.print(
        "bound: least standard deviation at the noise found, and if all others were known; of bracket: above 1, the "
        "flight tells less than the bracket; shows below: multiples of the noise at which the airframe's own value "
        "would be told from 0.",
        highlight=False,
    )
    for name, note in known.notes(names).items():
        console.print(f"{name}: {note}", highlight=False)
    weakest = np.asarray(known.directions)[:, 0]
    parts = [
        f"{weakest[i]:+.2f} {names[i]}"
        for i in np.argsort(-np.abs(weakest))
        if abs(weakest[i]) > SMALL * abs(weakest).max()
    ]
    spread = 1 / np.sqrt(max(float(known.eigenvalues[0]), 1e-300))
    size = f"{spread:.2g}" if spread < 1e3 else "over 1000"
    console.print(
        f"told least, in half-widths: {' '.join(parts)}, to {size} (1: as well as the bracket).", highlight=False
    )
