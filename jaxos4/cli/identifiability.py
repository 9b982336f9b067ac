"""`jaxos4 identifiability`: what a flight can tell of each parameter, and why not of the others."""

from pathlib import Path

import numpy as np
import rich.box
from rich.console import Console
from rich.table import Table

from ..analysis.identifiability import Identifiability, identifiability as information_of
from ..estimators import IBSS
from ..flight import STATE_NAMES
from ..identification.vehicle import NO_ANSWER
from ..results import result_names
from ._check_output import check_output
from ._choices import (
    AirframeOption,
    BracketOption,
    ChannelsOption,
    FlightFile,
    InitialState,
    InitialStateOption,
    Model,
    ModelOption,
    OutOption,
    WindowOption,
)
from ._fitting import fit, load_job
from ._json import finite, write_json

# Of a direction, what is not shown: shares of a half-width below this one of the largest.
SMALL = 0.1


def identifiability(
    flight: FlightFile,
    model: ModelOption = Model["published"],
    airframe: AirframeOption = "os4",
    bracket: BracketOption = None,
    channels: ChannelsOption = None,
    initial_state: InitialStateOption = InitialState["free"],
    window: WindowOption = None,
    out: OutOption = None,
) -> None:
    """Which of alpha_1..8 a flight can identify, and for the others the reason why not."""
    console = Console()
    if out is not None:
        check_output(out, flight, Path(airframe), bracket)
    problem, where, said = load_job(flight, model, airframe, bracket, channels, initial_state, window)
    for note in said:
        console.print(f"note: {note}", markup=False, highlight=False)
    problem, found, _, _ = fit(IBSS(), problem, where, shoots=True)
    fitted = str(result_names(found.result)) not in NO_ANSWER
    if not fitted:
        console.print("note: no fit; what follows is at the bracket's center", highlight=False)
    known = information_of(problem, where, found.parameters, found.initial_state if fitted else None)

    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "bound", "others known", "of bracket", "shows below"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    std, alone, share, limit = (
        np.asarray(x) for x in (known.std, known.std_alone, known.std / known.half_width, known.noise_limit)
    )
    names, units = problem.model.parameter_names, problem.model.parameter_units
    notes = known.notes(names)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        shows = f"{limit[i]:.2g} x" if known.identifiable[i] and limit[i] > 0 else "-"
        table.add_row(name, unit, f"{std[i]:.2g}", f"{alone[i]:.2g}", f"{share[i]:.2g}", shows)
    console.print(table, markup=False)
    console.print(
        "bound: least standard deviation at the noise found, and if all others were known; of bracket: above 1, the "
        "flight tells less than the bracket; shows below: multiples of the noise at which the airframe's own value "
        "would be told from 0.",
        highlight=False,
    )
    for name, note in notes.items():
        console.print(f"{name}: {note}", highlight=False)
    if np.isfinite(std).all():
        _print_weakest(console, known, names)
    if out is not None:
        report = {
            "flight": str(flight),
            "fitted": fitted,
            "sigma": dict(zip(STATE_NAMES, problem.sigma.tolist(), strict=True)),
            "parameters": {
                name: {
                    "bound": finite(std[i]),
                    "others_known": finite(alone[i]),
                    "half_width": float(known.half_width[i]),
                    "noise_limit": finite(limit[i]) if np.isfinite(std[i]) else None,
                    "unit": units[i],
                    "note": notes.get(name, ""),
                }
                for i, name in enumerate(names)
            },
            "eigenvalues": known.eigenvalues.tolist() if np.isfinite(std).all() else None,
            "directions": known.directions.T.tolist() if np.isfinite(std).all() else None,
        }
        write_json(report, out)


def _print_weakest(console: Console, known: Identifiability, names: tuple[str, ...]) -> None:
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
