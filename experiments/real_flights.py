"""Experiments with recorded flights, from the folder `--flights`, or else `$JAXOS4_FLIGHTS`.

The moments of inertia of two flights of one vehicle should differ by chance alone.
"""

import itertools
from pathlib import Path

import numpy as np

import jaxos4
from experiments.fits import INERTIAS, constants, identified
from experiments.monte_carlo import (
    Column,
    Row,
    check_names,
    groups,
    interval,
    print_rows,
    print_table,
    product,
    study,
    text,
    write_report,
)
from experiments.public_flights.gusts import measured_share, simulated
from experiments.public_flights.rate_network import errors_of, trained
from experiments.sample_times.run import VEHICLE as CINERAT
from experiments.shared import End, Estimators, Flights, Out, Report, flight_files
from experiments.verdicts.faults import thinned
from jaxos4.estimators import ESTIMATORS
from jaxos4.flight import RATES
from jaxos4.forecast.measured import Measured
from jaxos4.recording import Recording, read_recording
from jaxos4.results import NINETY_FIVE
from jaxos4.rotations import deviation

CRAZYFLIE = jaxos4.load_airframe("crazyflie")
ARPL = jaxos4.load_airframe(Path(__file__).parent / "real_flight" / "crazyflie.toml")
AUTHORS = {"Ix": 1.03e-5, "Iy": 1.11e-5}  # of the same Crazyflie, as the flights' authors measured it
PENDULUM = {"Ix": 7.21e-4, "Iy": 7.76e-4, "Iz": 8.86e-4}  # of the CineRat, by its authors, to 7 %
ARPL_FLIGHTS = ("rollpitch", "yaw_a", "yaw_b", "hover")
FITTED = ("B8_star_fast_rep1", "B5_helix_fast_mell_rep1", "B9_trefoil_fast_rep4")
PREDICTED = ("B2_circle_fast_rep2", "B3_figure8_fast_rep1", "B3_figure8_fast_rep2", "B8_star_fast_rep2")
AIRFRAMES = {f"arpl_crazyflie_{name}.csv": CRAZYFLIE for name in ARPL_FLIGHTS}
AIRFRAMES |= {f"nanobench/{name}.csv": CRAZYFLIE for name in sorted((*FITTED, *PREDICTED))}
AIRFRAMES |= {"cinerat/cinerat_281.csv": CINERAT}
STEP = 0.01  # s; of the slower logs
HORIZONS = (5, 10, 20, 30, 50)  # steps ahead, of a table
AHEAD = 0.25  # s
SEEDS = 3  # of networks
# For `capture_lag`: half of the time over which turns are compared, and the largest lag [samples]; errors above this
# many medians are outliers.
HALF, MOST, OUTLIER = 5, 6, 3.0
COMPARED = ("Ix", "Iy")
INTERVALS: dict[str, Column] = {
    f"{name} [1e-5 kg m^2]": lambda row, n=name: interval(row["constants"].get(n), 1e5) for name in COMPARED
}


def capture_lag(recording: Recording) -> float:
    """How late the motion capture is recorded, compared with the gyro [s]: by the rates of roll and pitch.

    The gyro turns the attitude that the motion capture saw before into the one that it saw after, best at this lag.
    """
    attitude = Measured.of(jaxos4.Flight(recording.time, recording.omega, recording.states)).states[:, 6:10]
    seen = np.stack(deviation(attitude[: -2 * HALF].T, attitude[2 * HALF :].T), axis=1)[:, :2]
    rates = np.nan_to_num(recording.states[:, RATES[:2]])
    turned = np.cumsum((rates[1:] + rates[:-1]) / 2, axis=0) * recording.dt
    turned = np.concatenate([np.zeros((1, 2)), turned])
    turned = turned[2 * HALF :] - turned[: -2 * HALF]
    lags, costs = np.arange(-MOST, MOST + 1), []
    for lag in lags:
        off = seen[MOST + lag : len(seen) - MOST + lag] - turned[MOST:-MOST]
        off = np.abs(off - np.nanmedian(off, axis=0))
        costs.append(np.nanmean(np.minimum(off, OUTLIER * np.nanmedian(off, axis=0))))
    best = int(np.clip(np.argmin(costs), 1, len(lags) - 2))
    before, least, after = costs[best - 1 : best + 2]  # the minimum of a parabola
    return float(recording.dt * (lags[best] + np.clip((before - after) / (before - 2 * least + after) / 2, -1, 1)))


def aligned(recording: Recording) -> Recording:
    """The recording with position, velocity and attitude on the clock of the gyro."""
    states, time = recording.states.copy(), recording.time + capture_lag(recording)
    for column in np.setdiff1d(np.arange(states.shape[1]), RATES):
        states[:, column] = np.interp(time, recording.time, recording.states[:, column])
    return recording._replace(states=states)


def disagreements(rows: dict[str, Row]) -> dict[str, dict[tuple[str, str], float]]:
    """For Ix and Iy, and each pair of flights that have them: their difference over its standard deviation."""
    table: dict[str, dict[tuple[str, str], float]] = {}
    for (one, first), (other, second) in itertools.combinations(rows.items(), 2):
        for name in COMPARED:
            a, b = (row["constants"].get(name) for row in (first, second))
            if a and b:
                z = abs(a["estimate"] - b["estimate"]) / (a["std"] ** 2 + b["std"] ** 2) ** 0.5
                table.setdefault(name, {})[one, other] = z
    return table


def skill_ahead(skill: Row | None) -> dict[str, tuple[float, float]]:
    """The skill of predictions of roll and pitch rate next to `AHEAD`, and its standard deviation."""
    if skill is None:
        return {}
    place = min(range(len(skill["horizons"])), key=lambda place: abs(skill["horizons"][place] - AHEAD))
    table = {rate: (skill[rate]["skill"][place], skill[rate]["std"][place]) for rate in "pq"}
    return {rate: (value, std) for rate, (value, std) in table.items() if value is not None and std is not None}


def real_flight(
    flights: Flights = None,
    end: End = None,
    names: list[str] = ARPL_FLIGHTS,
    estimators: Estimators = ("filter-error", "ibss"),
    out: Out = None,
) -> None:
    """Do flights of a real Crazyflie agree on its moments of inertia, and how well is the rest of a flight predicted?

    Each flight is identified alone, and all of them together, by filter error and by IBSS on the same likelihood. The
    last quarter of each flight is not fitted but predicted. Commands are not rotor speeds: thrust as a function of the
    command is fitted to the accelerometer (`thrust_curve`, `thrust_gain`), and torques, and therefore inertias, are
    proportional to this thrust.

    `z` is the difference of two flights over its standard deviation; 99 % of such figures should be below 2.58.
    """
    check_names("estimators", estimators, ESTIMATORS)
    paths = flight_files(flights, [f"arpl_crazyflie_{name}.csv" for name in names])
    flown = {name: [read_recording(path, ARPL)] for name, path in zip(names, paths, strict=True)}
    if len(flown) > 1:
        flown["all"] = [recording for (recording,) in flown.values()]

    def row_of(estimator: str, flight: str) -> Row:
        settings = jaxos4.VehicleSettings(end=end)
        found = jaxos4.identify(flown[flight], ARPL, settings=settings, estimator=estimator)
        print(f"{estimator}, {flight}: {found.seconds:.0f} s", flush=True)
        row = found.to_dict()
        return row | {"ahead": skill_ahead(row["skill"])}

    settings = {"authors": AUTHORS, "names": list(names), "end": end}
    rows = study(out, settings, product(estimator=estimators, flight=flown), row_of)
    columns: dict[str, Column] = {name: name for name in ("estimator", "flight", "result")}
    columns |= INTERVALS
    for rate in "pq":
        columns[f"skill {rate}"] = lambda row, r=rate: (
            "{:.2f} +- {:.2f}".format(*row["ahead"][r]) if r in row["ahead"] else ""
        )
    print_rows(f"moments of inertia with 95 % intervals, and the skill {AHEAD:g} s ahead", rows, columns)
    for (estimator,), some in groups(rows, "estimator").items():
        apart = disagreements({row["flight"]: row for row in some})
        worst = ", ".join(f"{name} {max(pairs.values()):.2g}" for name, pairs in apart.items())
        print(f"{estimator}: the largest disagreement of two flights (z): {worst or 'no pair'}")


def public_flights(
    flights: Flights = None,
    fitted: list[str] = FITTED,
    predicted: list[str] = PREDICTED,
    end: End = None,
    batches: int = 300,
    gusts: list[float] = (0.0, 2.0, 4.0, 8.0),
    simulations: int = 5,
    out: Report = None,
) -> None:
    """Public flights of a Crazyflie 2.1 (NanoBench): some are identified together, and others predicted whole.

    The motion capture is moved to the clock of the gyro first. The flights `fitted` are identified together, and those
    `predicted` are predicted: position, velocity, attitude and body rates, 50 steps of 10 ms ahead, open loop, with the
    recorded commands and the offsets that the past of a flight shows. The errors stand beside those of constant
    velocity and rates, of a regression that is fitted to the first half of the flight that it predicts, and of a small
    network for the rates that is trained on the identified flights, in so many batches.

    Commands answer what disturbs the vehicle after the start, which no prediction in open loop knows. How much that
    costs is simulated with the true vehicle (`gusts.py`): flights through `gusts` of these strengths [rad/s^2].
    """
    names = tuple(dict.fromkeys((*fitted, *predicted)))
    paths = flight_files(flights, [f"nanobench/{name}.csv" for name in names])
    recordings = {
        name: aligned(read_recording(path, CRAZYFLIE))._replace(name=name)
        for name, path in zip(names, paths, strict=True)
    }
    together = [recordings[name] for name in fitted]
    found = jaxos4.identify(together, CRAZYFLIE, settings=jaxos4.VehicleSettings(sample_time=STEP, end=end))
    print(f"{', '.join(fitted)}: {found.result}, {found.seconds:.0f} s", flush=True)
    vehicle = jaxos4.forecast.vehicle_of(found)
    networks = [trained(together, batches=batches, seed=seed) for seed in range(SEEDS)]
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
    print_errors(report["flights"])
    report["simulated"] = {f"{gust:g}": simulated(gust, simulations) for gust in gusts}
    print_shares(report)
    write_report(out, report)


def print_errors(flights: dict[str, Row]) -> None:
    """One line for each flight and quantity."""
    kinds, lines = ("error", "constant", "regression", "network"), []
    for flight, found in flights.items():
        for quantity, row in found["quantities"].items():
            sums = [row["sum"].get(kind) for kind in kinds]
            values = sums + [row[kind][9] if kind in row else None for kind in kinds]
            lines.append((flight, quantity, row["unit"], *map(text, values)))
    headings = "flight", "quantity", "unit", *kinds, "0.1 s: error", *kinds[1:]
    print_table("mean absolute error: the sum over 50 steps of 10 ms, and 0.1 s ahead", headings, lines)


def print_shares(report: Row) -> None:
    """One line for each flight, or strength of the simulated gusts, and axis."""
    flights = {name: found["quantities"] for name, found in report["flights"].items()}
    flights |= {f"simulated, true vehicle, {gust} rad/s^2": found for gust, found in report["simulated"].items()}
    kinds = "share", "error", "constant"
    rows = [
        (name, axis, *(f"{found[axis][kind][n - 1]:.2g}" for kind in kinds for n in HORIZONS))
        for name, found in flights.items()
        for axis in "pq"
    ]
    ahead = [f"{STEP * n:g}" for n in HORIZONS]
    headings = [x for kind in kinds for x in (f"{kind}, {ahead[0]} s", *ahead[1:])]
    title = "share of a predicted rate that is measured, and mean absolute errors [rad/s]"
    print_table(title, ("flight", "rate", *headings), rows, width=180)


def radio(flights: Flights = None, every: list[int] = (1, 10, 20, 40), end: End = None, out: Out = None) -> None:
    """What does a radio do to an identification? A flight that was logged on board, with fewer of its commands.

    A radio brings each command as it was at one moment. The flight is one of `real_flight`, logged at 1 kHz. It is
    identified with one command in so many, each held until the next.
    """
    (path,) = flight_files(flights, ["arpl_crazyflie_rollpitch.csv"])
    recording, settings = read_recording(path, CRAZYFLIE), jaxos4.VehicleSettings(sample_time=STEP, end=end)

    def row_of(n: int) -> Row:
        found = jaxos4.identify([thinned(recording, float(n))], CRAZYFLIE, settings=settings).to_dict()
        return {name: found[name] for name in ("result", "doubts", "verdicts", "parameters", "constants")}

    rows = study(out, {"end": end}, product(n=every), row_of)
    columns: dict[str, Column] = {"one command of": "n"}
    for name in ("roll_damping", "pitch_damping"):
        columns[f"{name.replace('_', ' ')} [1/s]"] = lambda row, name=name: interval(row["parameters"].get(name), 1.0)
    columns |= INTERVALS
    columns |= {f"verdict of {name}": lambda row, name=name: row["verdicts"][name]["status"] for name in COMPARED}
    print_rows("thinned commands, 95 % intervals", rows, columns, width=180)


def judged(path: Path, airframe: jaxos4.Airframe) -> Row:
    """Result, value, standard deviation, verdict and reasons of each quantity."""
    row, found = identified(path, airframe)
    for name in INERTIAS if found is not None else ():
        verdict = found.verdicts.get(name)
        status, reasons = (found.result, []) if verdict is None else (verdict.status, list(verdict.reasons))
        row[name] = {"status": status, "reasons": reasons} | constants(found).get(name, {})
    return row


def verdicts(flights: Flights = None, names: list[str] = tuple(AIRFRAMES), out: Out = None) -> None:
    """Which verdicts have moments of inertia on real flights, each identified alone; and do repeated flights agree?

    The airframe of each vehicle has the rotors where their centres were measured. Motion capture is not shifted.
    """
    check_names("names", names, AIRFRAMES)
    paths = dict(zip(names, flight_files(flights, names), strict=True))
    rows = study(out, {}, product(flight=names), lambda flight: judged(paths[flight], AIRFRAMES[flight]))
    lines = []
    vehicles: dict[str, dict[str, Row]] = {}
    for row in rows:
        known = {name: row[name] for name in INERTIAS if name in row}
        for name, one in known.items():
            lines.append((row["flight"], name, interval(one, 1e5), one["status"], "; ".join(one["reasons"])))
        if row["result"] == "refused":
            lines.append((row["flight"], "", "", "refused", *row["doubts"]))
        vehicle = row["flight"].split("/")[0] if "/" in row["flight"] else "arpl_crazyflie"
        # With or without a reservation.
        trusted = {n: one for n, one in known.items() if "estimate" in one and one["status"].startswith("identified")}
        vehicles.setdefault(vehicle, {})[row["flight"]] = {"constants": trusted}
    print_table("verdicts of real flights", ("flight", "", "1e-5 kg m^2, 95 %", "verdict", "reasons"), lines, width=200)
    lines = []
    for vehicle, flown in vehicles.items():
        for name, apart in disagreements(flown).items():
            known, inside = (
                sum(name in each["constants"] for each in flown.values()),
                [z <= NINETY_FIVE for z in apart.values()],
            )
            lines.append((vehicle, name, str(known), f"{sum(inside)} of {len(inside)}", f"{max(apart.values()):.2f}"))
    headings = "vehicle", "", "identified", "differences inside their 95 %", "largest [std]"
    print_table("repeated flights of one vehicle", headings, lines)


SCRIPTS = {
    "public_flights.radio": radio,
    "public_flights.run": public_flights,
    "real_flight.run": real_flight,
    "verdicts.real": verdicts,
}
