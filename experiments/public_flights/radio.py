"""What a radio does to an identification: a flight that was logged on board, with fewer of its commands.

A radio brings each command as it was at one moment. The flight is the Crazyflie's of `real_flight`, logged at 1 kHz. It
is identified with all commands, and with one in 10, 20 and 40, each held until the next.
"""

from pathlib import Path
from typing import Annotated

import typer

import jaxos4
from experiments.monte_carlo import interval, print_table, write_report
from experiments.shared import flight_files
from experiments.verdicts.faults import thinned
from jaxos4.recording import read_recording

AIRFRAME = jaxos4.load_airframe("crazyflie")
FLIGHT, STEP = "arpl_crazyflie_rollpitch.csv", 0.01
JUDGED = "Ix", "Iy"
SHOWN = {"roll_damping": "roll damping [1/s]", "pitch_damping": "pitch damping [1/s]"}
SHOWN |= {name: f"{name} [1e-5 kg m^2]" for name in JUDGED}
UNITS = dict.fromkeys(JUDGED, 1e5)


def main(
    out: Annotated[Path, typer.Option(help="JSON file for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    every: Annotated[list[int], typer.Option(help="Keep one command in this many.")] = (1, 10, 20, 40),
    end: Annotated[float | None, typer.Option(help="Identify with the flight up to this time [s].")] = None,
) -> None:
    """Identify a flight with all of its commands, and with some."""
    recording = read_recording(*flight_files(flights, [FLIGHT]), AIRFRAME)
    settings, report = jaxos4.VehicleSettings(sample_time=STEP, end=end), {}
    for n in every:
        found = jaxos4.identify([thinned(recording, float(n))], AIRFRAME, settings=settings).to_dict()
        report[n] = {name: found[name] for name in ("result", "doubts", "verdicts", "parameters", "constants")}
        write_report(out, report)
    rows = []
    for n, found in report.items():
        known = found["parameters"] | found["constants"]
        numbers = (interval(known.get(name), UNITS.get(name, 1.0)) for name in SHOWN)
        rows.append((str(n), *numbers, *(found["verdicts"][name]["status"] for name in JUDGED)))
    headings = "one command of", *SHOWN.values(), *(f"verdict of {name}" for name in JUDGED)
    print_table("thinned commands, 95 % intervals", headings, rows, width=180)
