"""`jaxos4 identifiability`: which parameters a flight can identify, and why not the others."""

from pathlib import Path
from typing import TYPE_CHECKING

from ._options import (
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
    chosen,
    read_bracket,
)
from ._output import check_output, option_names, stages, write_json

if TYPE_CHECKING:
    from rich.console import Console

    from ..identification import FlightInformation

# Parameters with less than this share of the largest one are not shown in a direction.
_SMALL = 0.1
_MOST_HALF_WIDTHS = 1e3


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
    """Find which of alpha_1..8 a flight can identify, and why not the others."""
    if out is not None:
        check_output(out, flight, Path(airframe), bracket)
    with stages("loading the library") as progress, option_names(bracket=bracket):
        from ..airframe import load_airframe
        from ..identification import assess
        from ..models import MODELS
        from ..recording import read_recording

        progress("reading")
        subject = MODELS[model](load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
        found = assess(
            recording,
            subject,
            bracket=read_bracket(bracket),
            channels=chosen(channels),
            initial_state=str(initial_state.value),
            window=window,
            progress=progress,
        )
    if out is not None:
        write_json(found.to_dict(), out)
    from rich.console import Console

    console = Console()
    for note in recording.notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    _print_information(console, found)


def _print_information(console: "Console", found: "FlightInformation") -> None:
    from ..report.text import Listing

    if not found.fitted:
        console.print("note: no fit; all numbers below hold at the bracket's centre", highlight=False)
    rows = []
    for name, row in found.parameters.items():
        bound, alone = (float("inf") if x is None else x for x in (row.bound, row.others_known))
        limit = f"{row.noise_limit:.2g} x" if bound <= row.half_width and row.noise_limit else "-"
        rows.append((name, row.unit, f"{bound:.2g}", f"{alone:.2g}", f"{bound / row.half_width:.2g}", limit))
    numbers = ("bound", "others known", "of bracket", "noise limit")
    Listing(("parameter", "unit", *numbers), rows, numbers).print_on(console)
    console.print(
        "bound: the smallest possible standard deviation at the noise that was found; others known: the same if all "
        "other parameters were known; of bracket: bound / half-width of the bracket, above 1 the parameter is not "
        "identifiable; noise limit: the largest noise, in multiples of the noise that was found, at which the "
        "airframe's value can be distinguished from 0.",
        highlight=False,
    )
    for name, row in found.parameters.items():
        if row.note:
            console.print(f"{name}: {row.note}", highlight=False)
    if found.eigenvalues is not None and found.directions is not None:
        _print_weakest(console, found.eigenvalues[0], dict(zip(found.parameters, found.directions[0], strict=True)))


def _print_weakest(console: "Console", eigenvalue: float, direction: dict[str, float]) -> None:
    largest = max(abs(part) for part in direction.values())
    ordered = sorted(direction.items(), key=lambda item: -abs(item[1]))
    parts = " ".join(f"{part:+.2f} {name}" for name, part in ordered if abs(part) > _SMALL * largest)
    spread = max(eigenvalue, 1e-300) ** -0.5
    size = f"{spread:.2g}" if spread < _MOST_HALF_WIDTHS else f"over {_MOST_HALF_WIDTHS:g}"
    console.print(
        f"weakest direction, in half-widths of the bracket: {parts}, known to {size} (1: no better than the bracket).",
        highlight=False,
    )
