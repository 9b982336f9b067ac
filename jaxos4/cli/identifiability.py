"""`jaxos4 identifiability`: which parameters a flight can identify, and why not the others."""

from pathlib import Path
from typing import TYPE_CHECKING

from .._files import read_toml
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
from ._messages import option_names
from ._output import check_output, write_json
from ._progress import stages

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
            bracket=None if bracket is None else read_toml(bracket),
            channels=None if channels is None else channels.value,
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
    import rich.box
    from rich.table import Table

    if not found.fitted:
        console.print("note: no fit; all numbers below hold at the bracket's centre", highlight=False)
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "bound", "others known", "of bracket", "noise limit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    for name, row in found.parameters.items():
        bound, alone = (float("inf") if x is None else x for x in (row.bound, row.others_known))
        limit = f"{row.noise_limit:.2g} x" if bound <= row.half_width and row.noise_limit else "-"
        table.add_row(name, row.unit, f"{bound:.2g}", f"{alone:.2g}", f"{bound / row.half_width:.2g}", limit)
    console.print(table, markup=False)
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
