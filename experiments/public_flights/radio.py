"""What a radio does to an identification: a flight that was logged on board, with fewer of its commands.

A radio brings each command as it was at one moment. The flight is the Crazyflie's of `real_flight`, logged at 1 kHz. It
is identified with all commands, and with one in 10, 20 and 40, each held until the next.
"""

import json
import sys
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.console import Console

import jaxos4
from jaxos4.recording import Recording, read_recording
from jaxos4.results import NINETY_FIVE

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])

from shared import flight_files, table_of

jax.config.update("jax_enable_x64", True)

AIRFRAME = jaxos4.load_airframe("crazyflie")
FLIGHT, STEP = "arpl_crazyflie_rollpitch.csv", 0.01
SHOWN = {"roll_damping": 1.0, "pitch_damping": 1.0, "Ix": 1e5, "Iy": 1e5}


def thinned(recording: Recording, every: int) -> Recording:
    """The recording with one command of `every`, held until the next."""
    return recording._replace(omega=recording.omega[np.arange(len(recording.omega)) // every * every])


def main(
    out: Annotated[Path, typer.Option(help="JSON file for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    every: Annotated[list[int], typer.Option(help="Keep one command of so many.")] = (1, 10, 20, 40),
    end: Annotated[float | None, typer.Option(help="Identify with the flight up to this time [s].")] = None,
) -> None:
    """Identify a flight with all of its commands, and with some."""
    recording = read_recording(*flight_files(flights, [FLIGHT]), AIRFRAME)
    settings, report = jaxos4.VehicleSettings(sample_time=STEP, end=end), {}
    table = table_of("95 % intervals", ("one command of", *SHOWN, "result", "doubts"))
    for n in every:
        found = jaxos4.identify([thinned(recording, n)], AIRFRAME, settings=settings).to_dict()
        report[n] = {name: found[name] for name in ("result", "doubts", "parameters", "constants")}
        out.write_text(json.dumps(report, indent=1) + "\n")
        rows = found["parameters"] | found["constants"]
        cells = [
            f"{size * rows[name]['estimate']:.2f} +- {NINETY_FIVE * size * rows[name]['std']:.2f}"
            if name in rows and rows[name]["estimate"] is not None
            else ""
            for name, size in SHOWN.items()
        ]
        table.add_row(str(n), *cells, found["result"], "; ".join(each["cause"] for each in found["doubts"]))
    Console(width=180).print(table)


if __name__ == "__main__":
    typer.run(main)
