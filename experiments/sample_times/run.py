"""Is the answer the same at every sample time? And is it right if the logged rotor speeds are noisy?

Each flight: a CineRat (3-inch quadrotor, rotors with a lag of 25 ms) flies random references through gusts. The
estimator gets the true airframe. Rotor speeds or commands are logged every `--dt` seconds, and the flight is fitted at
several sample times. A sample time of 0 is the one that the rule chooses.

The simulator is finer than the controller, which runs every 4 ms, or as often as the log is written if that is more
often: four steps in each of its runs. Its references change as often as it runs. A slower log has some of its rows: if
references changed only where the log has a row, commands would change little in between. A command that the log holds
for n runs of the controller is late by (n - 1) / 2 runs: the true delay of the rotors is then negative.
"""

import functools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, covered_error, monte_carlo, print_table, results_of
from jaxos4.recording import Recording
from jaxos4.results import NINETY_FIVE

VEHICLE = jaxos4.Airframe(
    mass=0.428,
    inertia=(6.3e-4, 7.5e-4, 8.9e-4),
    rotor_positions=[(-0.0455, -0.0635), (0.0455, -0.0635), (-0.0455, 0.0635), (0.0455, 0.0635)],
    rotor_spins=(-1.0, 1.0, 1.0, -1.0),
    thrust_coefficient=2.66e-7,
    drag_coefficient=2.66e-9,
    rotor_inertia=9e-7,
    max_rotor_speed=4100.0,
)
SAMPLE_TIMES = (0, 0.004, 0.008, 0.016, 0.032)
LAG, PERIOD = 0.025, 0.004  # of rotors and controller [s]
TRUTH = {
    "Ix": 6.3e-4,
    "Iy": 7.5e-4,
    "Iz": 8.9e-4,
    "rotor_reaction": 9e-7 / 8.9e-4,
    "rotor_delay": 0.0,
    "rotor_lag": LAG,
    "roll_damping": 0.0,
    "yaw_damping": 0.0,
}
UNITS = {"rotor_delay": (1e3, "ms"), "roll_damping": (1.0, "1/s"), "yaw_damping": (1.0, "1/s")}


def fly(logged: str, dt: float, duration: float, gust: float, noise: float, seed: int) -> jaxos4.Flight:
    """One flight. `noise`: of logged rotor speeds, as a share of the median of their changes from sample to sample."""
    every = max(round(dt / PERIOD), 1)
    loop = jaxos4.ClosedLoop(VEHICLE, rotor_lag=LAG, rotor_delay=0.0, gust=gust, logged=logged)
    first, second = jax.random.split(jax.random.key(seed))
    references = jaxos4.random_references(duration=duration, dt=dt / every, key=first)
    flight = jaxos4.fly_closed_loop(loop, references, dt=dt / every, key=second, substeps=4)
    flight = Recording.of(flight, "flight").rows(slice(None, None, every)).flight
    if not noise:
        return flight
    omega = np.asarray(flight.omega)
    size = noise * np.median(np.abs(np.diff(omega, axis=0)))
    noisy = omega + size * np.random.default_rng(seed).normal(size=omega.shape)
    return eqx.tree_at(lambda f: f.omega, flight, np.maximum(noisy, 0.0))


def fit(flight: jaxos4.Flight, sample_time: float) -> Row:
    """The answer at one sample time: value and standard deviation of each quantity."""
    begin = time.perf_counter()
    settings = jaxos4.VehicleSettings(sample_time=sample_time or None, holdout=0.0)
    found = jaxos4.identify(flight, VEHICLE, settings=settings)
    known = {name: (row.estimate, row.std) for name, row in found.rigid_body.constants.items()}
    known |= {name: (row.estimate, row.std) for name, row in found.parameters.items() if name in TRUTH}
    return {
        "result": found.result,
        "sample_time": found.provenance.sample_time,
        "seconds": time.perf_counter() - begin,
        "found": {name: pair for name, pair in known.items() if None not in pair},
    }


def truth_of(logged: str, dt: float) -> dict[str, float]:
    """The true values for a log with rows every `dt` seconds."""
    held = (max(round(dt / PERIOD), 1) - 1) * PERIOD / 2 if logged == "commands" else 0.0
    return TRUTH | {"rotor_delay": -held}


def summary(rows: list[Row], true: dict[str, float]) -> dict[str, Row]:
    """For each quantity: mean error with its Monte-Carlo error, and coverage. Shares of the truth if that is not 0."""
    found = {}
    for name, truth in true.items():
        pairs = np.array([row["found"][name] for row in rows if name in row["found"]])
        if len(pairs) < 2:
            continue
        error, scale = pairs[:, 0] - truth, (name not in UNITS and truth) or 1.0
        covered = float(np.mean(np.abs(error) <= NINETY_FIVE * pairs[:, 1]))
        found[name] = {
            "flights": len(pairs),
            "mean": float(error.mean() / scale),
            "mean_error": float(error.std(ddof=1) / np.sqrt(len(pairs)) / scale),
            "covered": covered,
            "covered_error": covered_error(covered, len(pairs)),
        }
    return found


def table_rows(report: Row) -> Iterator[tuple[str, ...]]:
    """One line for each sample time and quantity."""
    for case in report["cases"]:
        for name, row in case["summary"].items():
            factor, unit = UNITS.get(name, (100.0, "%"))
            mean = f"{factor * row['mean']:.2g} +- {factor * row['mean_error']:.1g} {unit}"
            covered = f"{100 * row['covered']:.0f} +- {100 * row['covered_error']:.0f}"
            yield f"{1e3 * case['sample_time']:g}", name, str(row["flights"]), mean, covered, results_of(case)


def main(
    flights: Annotated[int, typer.Option(help="Number of flights.")] = 40,
    logged: Annotated[str, typer.Option(help="speeds or commands.")] = "speeds",
    sample_times: Annotated[list[float], typer.Option(help="[s]; 0: the rule chooses.")] = SAMPLE_TIMES,
    dt: Annotated[float, typer.Option(help="Sample time of the log [s].")] = 0.004,
    noise: Annotated[float, typer.Option(help="Noise of rotor speeds, as a share of their median change.")] = 0.0,
    gust: Annotated[float, typer.Option(help="Standard deviation of the gusts [rad/s^2].")] = 1.0,
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 60.0,
    seed: Annotated[int, typer.Option(help="Random seed of the first flight; each has one more.")] = 0,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure errors and coverage at several sample times."""
    settings = {"logged": logged, "dt": dt, "noise": noise, "gust": gust, "duration": duration, "seed": seed}
    flown = [fly(logged, dt, duration, gust, noise, seed + i) for i in range(flights)]
    cases = [{"sample_time": each} for each in sample_times]

    def row_of(flight: jaxos4.Flight, i: int, sample_time: float) -> Row:
        return fit(flight, sample_time)

    counted = functools.partial(summary, true=truth_of(logged, dt))
    report = monte_carlo(out, settings, cases, lambda **_: flown, row_of, counted)
    headings = "ms", "", "flights", "mean error", "covered [%]", "results"
    print_table("errors by sample time", headings, table_rows(report), width=120)
