"""Public flights of a Crazyflie 2.1 (NanoBench): identified alone and together, and predicted whole.

Each flight is identified alone, and all together; what is refused has its cause. The moments of inertia of one vehicle
should differ by chance alone: `pairs` has the share of pairs of flights whose difference is inside its 95 %, with an
interval from a bootstrap of the flights.

The motion capture is moved to the clock of the gyro first (`clocks.py`).

Three flights are identified together, and all others are predicted: position, velocity, attitude and body rates, 50
steps of 10 ms ahead, open loop, with the recorded commands. The errors stand beside those of constant velocity and
rates, of a regression that is fitted to the first half of the flight that it predicts, and of a small network for the
rates that is trained on the identified flights. Each flight is predicted with the offsets that its own past shows.

Commands answer what disturbs the vehicle after the start, which no prediction in open loop knows. How much that costs
is simulated with the true vehicle (`gusts.py`).
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, interval, print_table, write_report
from experiments.public_flights.clocks import aligned
from experiments.public_flights.gusts import measured_share, simulated
from experiments.public_flights.rate_network import errors_of, trained
from experiments.shared import flight_files
from jaxos4.recording import Recording, read_recording
from jaxos4.results import NINETY_FIVE

AIRFRAME = jaxos4.load_airframe("crazyflie")
FITTED = ("B8_star_fast_rep1", "B5_helix_fast_mell_rep1", "B9_trefoil_fast_rep4")
PREDICTED = ("B2_circle_fast_rep2", "B3_figure8_fast_rep1", "B3_figure8_fast_rep2", "B8_star_fast_rep2")
STEP = 0.01  # [s]
INERTIAS = "Ix", "Iy"
BOOTSTRAPS, SEEDS = 2000, 3
SHOWN = 5, 10, 20, 30, 50  # steps ahead


def alone(recordings: list[Recording], end: float | None) -> dict[str, Any]:
    """The result, the doubts and the moments of inertia of these recordings; or why they are refused."""
    settings = jaxos4.VehicleSettings(sample_time=STEP, end=end)
    try:
        found = jaxos4.identify(recordings, AIRFRAME, settings=settings).to_dict()
    except jaxos4.InputError as error:
        return {"result": "refused", "doubts": [{"cause": str(error)}], "constants": {}}
    return {name: found[name] for name in ("result", "doubts", "constants")}


def agreement(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The share of pairs whose difference is inside its 95 %, over all moments of inertia, with a bootstrap by flight.

    Two draws of one flight are no pair. `None`: no pair.
    """
    names = [name for name, row in rows.items() if row["constants"]]
    inside = np.full((len(names), len(names), len(INERTIAS)), np.nan)
    for i, j in itertools.permutations(range(len(names)), 2):
        for k, inertia in enumerate(INERTIAS):
            a, b = (rows[names[place]]["constants"].get(inertia) for place in (i, j))
            if a and b:
                limit = NINETY_FIVE * np.hypot(a["std"], b["std"])
                inside[i, j, k] = abs(a["estimate"] - b["estimate"]) <= limit
    if not np.isfinite(inside).any():
        return {"flights": names, "pairs": 0, "share": None, "ci95": None}
    draws = np.random.default_rng(0).integers(len(names), size=(BOOTSTRAPS, len(names)))
    drawn = [inside[np.ix_(draw, draw)] for draw in draws]
    shares = [np.nanmean(each) for each in drawn if np.isfinite(each).any()]
    pairs = int(np.isfinite(inside).sum()) // 2
    ends = [float(x) for x in np.quantile(shares, [0.025, 0.975])]
    return {"flights": names, "pairs": pairs, "share": float(np.nanmean(inside)), "ci95": ends}


def print_flights(report: Row) -> None:
    """One line for each flight that was identified alone, and the agreement of these flights."""
    rows = (
        (
            *(flight, row["result"], *(interval(row["constants"].get(name), 1e5) for name in INERTIAS)),
            "; ".join(each["cause"] for each in row["doubts"]),
        )
        for flight, row in report["alone"].items()
    )
    headings = "flight", "result", *(f"{name} [1e-5 kg m^2]" for name in INERTIAS), "results"
    print_table("each flight alone, 95 % intervals", headings, rows, width=180)
    for which, found in report["pairs"].items():
        print(f"{which}: {found['pairs']} pairs, share inside 95 %: {found['share']}, by flight {found['ci95']}")


def print_errors(report: Row) -> None:
    """One line for each flight and quantity."""
    kinds = "error", "constant", "regression", "network"

    def rows() -> Iterator[tuple[str, ...]]:
        for flight, found in report["flights"].items():
            for quantity, row in found["quantities"].items():
                cells = [row["sum"].get(kind) for kind in kinds]
                cells += [row[kind][9] if kind in row else None for kind in kinds]
                yield flight, quantity, row["unit"], *("" if x is None else f"{x:.3g}" for x in cells)

    headings = "flight", "quantity", "unit", *kinds, "0.1 s: error", *kinds[1:]
    print_table("mean absolute error: the sum over 50 steps of 10 ms, and 0.1 s ahead", headings, rows())


def print_shares(report: Row) -> None:
    """One line for each flight, or strength of the simulated gusts, and axis."""
    flights = {name: found["quantities"] for name, found in report["flights"].items()}
    flights |= {f"simulated, true vehicle, {gust} rad/s^2": found for gust, found in report["simulated"].items()}
    rows = [
        (name, axis, *(f"{found[axis][kind][n - 1]:.2g}" for kind in ("share", "error", "constant") for n in SHOWN))
        for name, found in flights.items()
        for axis in "pq"
    ]
    ahead = [f"{STEP * n:g}" for n in SHOWN]
    headings = [x for kind in ("share", "error", "constant") for x in (f"{kind}, {ahead[0]} s", *ahead[1:])]
    title = "share of a predicted rate that is measured, and mean absolute errors [rad/s]"
    print_table(title, ("flight", "rate", *headings), rows, width=180)


def main(
    out: Annotated[Path, typer.Option(help="JSON file for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    fitted: Annotated[list[str], typer.Option(help="The flights to identify together.")] = FITTED,
    predicted: Annotated[list[str], typer.Option(help="The flights to predict.")] = PREDICTED,
    compared: Annotated[list[str], typer.Option(help="The flights to identify alone.")] = (*FITTED, *PREDICTED),
    end: Annotated[float | None, typer.Option(help="Identify with the flights up to this time [s].")] = None,
    batches: Annotated[int, typer.Option(help="Batches of the network's training.")] = 300,
    gusts: Annotated[list[float], typer.Option(help="Simulated gusts [rad/s^2].")] = (0.0, 2.0, 4.0, 8.0),
    simulations: Annotated[int, typer.Option(help="Simulated flights through gusts of each strength.")] = 5,
) -> None:
    """Identify each flight and all together; identify some together, and predict the others."""
    names = tuple(dict.fromkeys((*fitted, *predicted, *compared)))
    paths = flight_files(flights, [f"nanobench/{name}.csv" for name in names])
    recordings = {
        name: aligned(read_recording(path, AIRFRAME))._replace(name=name)
        for name, path in zip(names, paths, strict=True)
    }
    settings = jaxos4.VehicleSettings(sample_time=STEP, end=end)
    found = jaxos4.identify([recordings[name] for name in fitted], AIRFRAME, settings=settings)
    print(f"{', '.join(fitted)}: {found.result}, {found.seconds:.0f} s", flush=True)
    vehicle = jaxos4.forecast.vehicle_of(found)
    networks = [trained([recordings[name] for name in fitted], batches=batches, seed=seed) for seed in range(SEEDS)]
    report: Row = {"version": jaxos4.__version__, "identification": found.to_dict(), "flights": {}}
    for name in predicted:
        prediction = jaxos4.predict(vehicle, recordings[name], sample_time=STEP)
        row = prediction.to_dict()
        for quantity, errors in errors_of(networks, recordings[name], prediction).items():
            row["quantities"][quantity] |= {"network": errors}
            row["quantities"][quantity]["sum"] |= {"network": sum(errors)}
        for axis, share in measured_share([prediction]).items():
            row["quantities"][axis] |= {"share": share}
        report["flights"][name] = row
        write_report(out, report)
    print_errors(report)
    report["simulated"] = {f"{gust:g}": simulated(gust, simulations) for gust in gusts}
    print_shares(report)
    report["alone"] = {name: alone([recordings[name]], end) for name in compared}
    trusted = {name: row for name, row in report["alone"].items() if row["result"] == "successful"}
    report["pairs"] = {"not refused": agreement(trusted), "all that have a number": agreement(report["alone"])}
    if len(compared) > 1:
        report["alone"]["all together"] = alone([recordings[name] for name in compared], end)
    write_report(out, report)
    print_flights(report)
