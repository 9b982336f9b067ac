"""The prediction of a flight as text, for a terminal: `jaxos4 predict`."""

from rich.console import Console

from ..forecast import QUANTITIES, FlightPrediction
from .text import Listing, percent, plain

# The horizons of the table, as shares of the longest.
_SHARES = (0.2, 0.5, 1.0)


def print_prediction(console: Console, found: FlightPrediction) -> None:
    """Prints notes, the errors by quantity and horizon, and their sums over all horizons."""

    def say(line: str) -> None:
        console.print(line, markup=False, highlight=False)

    for note in found.notes:
        say(f"note: {note}")
    last = found.horizons.size - 1
    places = sorted({max(round(share * (last + 1)) - 1, 0) for share in _SHARES})
    rows = []
    for name, quality in found.quality.items():
        row = name, QUANTITIES[name][0]
        for i in places:
            errors = [plain(x[i]) for x in quality[:-1]]
            rows.append((*row, f"{found.horizons[i]:.2f} s", *errors, percent(quality.coverage[i])))
        rows.append((*row, "sum", *(plain(x) for x in quality.sums.values()), ""))
    errors = ("error", "unaware", "constant", "regression", "in band %")
    Listing(("quantity", "unit", "ahead", *errors), rows, errors).print_on(console)
    say(
        "error: mean absolute error; sum: over all horizons. unaware: without the disturbance that the filters know at "
        "the start. constant: velocity and rates stay as they are. in band: inside the 95 % band."
    )
    if found.missing:
        say(f"not measured, and so not compared: {', '.join(found.missing)}.")
    steps = f"{found.time.size} starts, {last + 1} steps to {found.horizons[-1]:.3g} s"
    say(f"{found.found} predicts {found.flight}, {steps}")
