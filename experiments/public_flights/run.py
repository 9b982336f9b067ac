"""Public flights of a Crazyflie 2.1 (NanoBench): some are identified together, and all others are predicted whole.

Position, velocity, attitude and body rates, 50 steps of 10 ms ahead, open loop, with the recorded commands. The errors
stand beside those of constant velocity and rates, and of a regression that is fitted to the first half of the flight
that it predicts. Each flight is predicted with the offsets that its own past shows.
"""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import jax
import typer
from rich.console import Console

import jaxos4
from jaxos4.recording import read_recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import flight_files, table_of

jax.config.update("jax_enable_x64", True)

AIRFRAME = jaxos4.load_airframe("crazyflie")
FITTED = ("B8_star_fast_rep1", "B5_helix_fast_mell_rep1", "B9_trefoil_fast_rep4")
PREDICTED = ("B2_circle_fast_rep2", "B3_figure8_fast_rep1", "B3_figure8_fast_rep2", "B8_star_fast_rep2")
TERMS = ("offset", "center_of_mass", "damping", "velocity", "voltage", "motor", "delay", "reaction", "accelerometer")
TERMS += ("inflow", "drag")
STEP = 0.01  # [s]


def print_table(report: dict[str, Any]) -> None:
    """One line for each flight and quantity."""
    headings = "flight", "quantity", "unit", "error", "constant", "regression", "0.1 s: error", "constant", "regression"
    table = table_of("mean absolute error: the sum over 50 steps of 10 ms, and 0.1 s ahead", headings)
    for flight, found in report["flights"].items():
        for quantity, row in found["quantities"].items():
            kinds = ("error", "constant", "regression")
            cells = [row["sum"][kind] for kind in kinds] + [row[kind][9] for kind in kinds]
            table.add_row(flight, quantity, row["unit"], *("" if x is None else f"{x:.3g}" for x in cells))
    Console(width=150).print(table)


def main(
    out: Annotated[Path, typer.Option(help="JSON file for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    fitted: Annotated[list[str], typer.Option(help="The flights to identify together.")] = FITTED,
    predicted: Annotated[list[str], typer.Option(help="The flights to predict.")] = PREDICTED,
    end: Annotated[float | None, typer.Option(help="Identify with the flights up to this time [s].")] = None,
) -> None:
    """Identify some flights together, and predict the others."""
    names = (*fitted, *predicted)
    paths = flight_files(flights, [f"nanobench/{name}.csv" for name in names])
    recordings = {name: read_recording(path, AIRFRAME) for name, path in zip(names, paths, strict=True)}
    settings = jaxos4.VehicleSettings(terms=TERMS, sample_time=STEP, end=end)
    found = jaxos4.identify([recordings[name] for name in fitted], AIRFRAME, settings=settings)
    print(f"{', '.join(fitted)}: {found.result}, {found.seconds:.0f} s", flush=True)
    vehicle = jaxos4.forecast.vehicle_of(found)
    report: dict[str, Any] = {"version": jaxos4.__version__, "identification": found.to_dict(), "flights": {}}
    for name in predicted:
        report["flights"][name] = jaxos4.predict(vehicle, recordings[name], sample_time=STEP).to_dict()
        out.write_text(json.dumps(report, indent=1) + "\n")
    print_table(report)


if __name__ == "__main__":
    typer.run(main)
