"""Are moments of inertia right if a controller flew the vehicle through gusts?

A controller answers gusts, so on a real flight inputs and disturbances are correlated. This makes regression and output
error biased, however long the flight. Each flight: a quadrotor as small as a Crazyflie, 20 s of random references,
gusts with a correlation time of 0.25 s, rotors with a lag of 50 ms and a delay of 10 ms, commands logged. The estimator
gets an airframe whose moments of inertia are 25 % too large (even flights) or too small (odd flights); its mass, arms
and thrust are right. The controller uses the same wrong moments.

`equation-error` and `output-error` know the lag and the delay. `jaxos4.identify` refuses both for a vehicle, because
they take a disturbance for noise of the sensors. All others are those of `jaxos4.identify`, with its default terms and
the whole flight fitted.

`--references` says what is flown: random steps, the standard 3-2-1-1 references, or those that
`jaxos4.design_references` finds for the true airframe. All have the same length and the same largest angle.
"""

import functools
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import numpy as np
import typer

import jaxos4
from experiments.fits import whole
from experiments.monte_carlo import Row, covered_error, monte_carlo, print_table, results_of
from jaxos4.design import standard_references
from jaxos4.results import NINETY_FIVE

THRUST, FULL = 0.15, 2500.0  # of one rotor at full speed [N], and that speed [rad/s]
VEHICLE = jaxos4.Airframe(
    mass=0.027,
    inertia=(1.66e-5, 1.7e-5, 2.9e-5),
    rotor_positions=[(0.028, -0.028), (-0.028, -0.028), (-0.028, 0.028), (0.028, 0.028)],
    rotor_spins=(1.0, -1.0, 1.0, -1.0),
    thrust_coefficient=THRUST / FULL**2,
    drag_coefficient=0.005 * THRUST / FULL**2,
    rotor_inertia=2e-8,
    max_rotor_speed=FULL,
)
LAG, DELAY = 0.05, 0.01
INERTIAS = {"Ix": "alpha3", "Iy": "alpha6", "Iz": "alpha8"}
DT, WINDOW = 0.004, 62
# Standard deviation of the gyro's noise [rad/s].
SIGMA = 0.02
# Without a disturbance in their model. The regression's memory is the best on real flights.
WITHOUT_DISTURBANCE = {"equation-error": jaxos4.EquationError(memory=0.9), "output-error": jaxos4.OutputError()}
CHUNK = 25  # flights of one call
# The largest references of all flights: angles [rad] and vertical acceleration [m/s^2].
LARGEST = np.array([0.3, 0.3, 0.3, 1.5])


def known_airframe(i: int, wrong: float) -> jaxos4.Airframe:
    """The data of flight i that the estimator and the controller know."""
    return eqx.tree_at(lambda a: a.inertia, VEHICLE, VEHICLE.inertia * (1 + wrong * (-1) ** i))


def references_of(kind: str, gust: float, duration: float, seed: int) -> np.ndarray | None:
    """The references of all flights; `None`: random, other ones for each flight."""
    if kind == "random":
        return None
    if kind == "designed":
        loop = jaxos4.ClosedLoop(VEHICLE, rotor_lag=LAG, rotor_delay=DELAY, gust=gust)
        settings = {"angle": LARGEST[0], "acceleration": LARGEST[3], "duration": duration, "dt": DT}
        return jaxos4.design_references(loop, **settings, key=jax.random.key(seed)).designed.inputs
    return standard_references(round(duration / DT) + 1, DT, LARGEST)[kind]


def fly(
    gust: float, i: int, duration: float, seed: int, wrong: float, references: np.ndarray | None = None
) -> jaxos4.Flight:
    """Flight i at one strength of the gusts [rad/s^2]."""
    key = jax.random.fold_in(jax.random.key(seed), i)
    inertia = known_airframe(i, wrong).inertia
    loop = jaxos4.ClosedLoop(VEHICLE, rotor_lag=LAG, rotor_delay=DELAY, gust=gust, controller_inertia=inertia)
    if references is None:
        of_flight = jax.random.fold_in(key, 0)
        references = jaxos4.random_references(duration=duration, dt=DT, amplitude=LARGEST.tolist(), key=of_flight)
    return jaxos4.fly_closed_loop(loop, references, dt=DT, key=jax.random.fold_in(key, 1))


def turned_over(flight: jaxos4.Flight) -> bool:
    """True if the gusts threw the vehicle on its side: then it is lost, and nobody has its log."""
    angles = np.asarray(flight.states)[:, [jaxos4.STATE_NAMES.index(name) for name in ("phi", "theta")]]
    return bool(flight.result != jaxos4.RESULTS.successful) or bool((np.abs(angles) > np.pi / 2).any())


def _fit(
    estimator: jaxos4.AbstractEstimator, flights: jaxos4.Flight, airframes: jaxos4.Airframe
) -> tuple[jaxos4.Estimate, jax.Array]:
    """Estimates, and their standard deviations."""

    def one(flight: jaxos4.Flight, airframe: jaxos4.Airframe) -> tuple[jaxos4.Estimate, jax.Array]:
        model = jaxos4.FlightModel(airframe, terms=("offset", "damping", "lag", "delay", "reaction"))
        windows = flight.time.shape[0] // WINDOW
        flight = jax.tree.map(lambda x: x[: windows * WINDOW] if x.ndim else x, flight)
        problem = jaxos4.ShootingProblem(
            model, flight, sigma=np.full(12, SIGMA), channels="rates", method="rk4", windows=windows
        )
        found = estimator(problem.hold({"rotor_lag": LAG, "rotor_delay": DELAY}))
        return found, found.std

    return eqx.filter_vmap(one)(flights, airframes)


def stacked(modules: list) -> object:
    """Modules of equal shapes as one batch."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *modules)


def regress(estimator: str, flights: dict[int, jaxos4.Flight], wrong: float) -> list[Row]:
    """The rows of some flights, by their numbers, without a disturbance, in one call.

    Their standard deviations are those of white gyro noise alone.
    """
    known = [known_airframe(i, wrong) for i in flights]
    spare = CHUNK - len(flights)  # one program for all calls
    batch = (stacked(some + some[-1:] * spare) for some in (list(flights.values()), known))
    begin = time.perf_counter()
    found, stds = jax.block_until_ready(_fit(WITHOUT_DISTURBANCE[estimator], *batch))
    results, seconds = jaxos4.result_names(found.result), time.perf_counter() - begin
    places = [jaxos4.CorrectedOS4().parameter_names.index(alpha) for alpha in INERTIAS.values()]
    values = 1 / np.asarray(found.parameters)[:, places]
    errors = np.asarray(stds)[:, places] * values**2
    rows = []
    for k in range(len(flights)):
        row: Row = {"result": str(results[k]), "seconds": seconds / len(flights)}
        for name, value, std in zip(INERTIAS, values[k].tolist(), errors[k].tolist(), strict=True):
            row[name] = {"estimate": value, "std": std, "bound": std}
        rows.append(row)
    return rows


def search(estimator: str, flight: jaxos4.Flight, i: int, wrong: float) -> Row:
    """The row of one flight by an estimator of `jaxos4.identify`."""
    begin = time.perf_counter()
    found = jaxos4.identify(flight, known_airframe(i, wrong), settings=whole(flight), estimator=estimator)
    row: Row = {"result": found.result, "seconds": time.perf_counter() - begin}
    constants = found.rigid_body.constants
    for name, alpha in INERTIAS.items():
        if name in constants:
            known, value = found.parameters[alpha], constants[name]
            # The bound of the parameter, as a share of its standard deviation.
            bound = value.std * (known.bound or np.nan) / (known.std or np.nan)
            row[name] = {"estimate": value.estimate, "std": value.std, "bound": bound}
    return row


def summary(rows: list[Row]) -> dict[str, Row]:
    """For each moment of inertia: figures over the flights with an estimate, each with its Monte-Carlo error.

    `bias`, `rmse`: as shares of the truth. `std`, `bound`: root mean square, as shares of the truth. `wrong`: the
    share of flights that ended successful with a 95 % interval that misses the truth.
    """
    found = {}
    for name, truth in zip(INERTIAS, VEHICLE.inertia.tolist(), strict=True):
        some = [row for row in rows if name in row]
        if not some:
            continue
        count = len(some)
        values, std, bound = (np.array([row[name][k] for row in some]) / truth for k in ("estimate", "std", "bound"))
        errors, successful = values - 1, np.array([row["result"] == "successful" for row in some])
        covered = np.abs(errors) <= NINETY_FIVE * std
        rmse, claimed, least = (float(np.sqrt(np.mean(np.square(x)))) for x in (errors, std, bound))
        found[name] = {
            "flights": count,
            "bias": float(errors.mean()),
            "bias_error": float(errors.std(ddof=1) / np.sqrt(count)) if count > 1 else None,
            "rmse": rmse,
            "std": claimed,
            "bound": least,
            "efficiency": rmse / least,
            "efficiency_error": rmse / least / np.sqrt(2 * count),
            "covered": float(covered.mean()),
            "covered_error": covered_error(covered.mean(), count),
            "wrong": float((successful & ~covered).sum() / len(rows)),
        }
    return found


def table_rows(report: Row) -> Iterator[tuple[str, ...]]:
    """One line for each estimator, strength of gusts and moment of inertia."""
    for case in report["cases"]:
        for name, row in case["summary"].items():
            error = "" if row["bias_error"] is None else f" +- {100 * row['bias_error']:.2g}"
            yield (
                *(f"{case['gust']:g}", case["references"], case["estimator"], name, str(row["flights"])),
                *(f"{100 * row['bias']:.3g}{error}", f"{100 * row['rmse']:.3g}", f"{100 * row['std']:.3g}"),
                f"{row['efficiency']:.2f} +- {row['efficiency_error']:.2f}",
                f"{100 * row['covered']:.1f} +- {100 * row['covered_error']:.1f}",
                results_of(case),
            )


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each strength.")] = 200,
    gusts: Annotated[list[float], typer.Option(help="Standard deviations of the gusts [rad/s^2].")] = (5.0, 10.0, 20.0),
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 20.0,
    seed: Annotated[int, typer.Option(help="Random seed of references, gusts and noise.")] = 16,
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = (
        *("equation-error", "output-error", "filter-error"),
    ),
    references: Annotated[list[str], typer.Option(help="random, designed, or a standard: 3211, doublet, ...")] = (
        "random",
    ),
    wrong: Annotated[float, typer.Option(help="Error of the given moments of inertia, as a share.")] = 0.25,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure bias and coverage of moments of inertia over the strength of gusts."""

    @functools.cache
    def flown(gust: float, references: str) -> list[jaxos4.Flight | None]:
        wanted = references_of(references, gust, duration, seed)
        every = (fly(gust, i, duration, seed, wrong, wanted) for i in range(flights))
        return [None if turned_over(flight) else flight for flight in every]

    @functools.cache
    def regressed(gust: float, references: str, estimator: str, first: int) -> dict[int, Row]:
        some = {i: f for i, f in enumerate(flown(gust, references)) if f is not None and first <= i < first + CHUNK}
        return dict(zip(some, regress(estimator, some, wrong), strict=True))

    def row_of(flight: jaxos4.Flight, i: int, gust: float, references: str, estimator: str) -> Row:
        if estimator in WITHOUT_DISTURBANCE:
            return regressed(gust, references, estimator, i - i % CHUNK)[i]
        return search(estimator, flight, i, wrong)

    settings = {"duration": duration, "seed": seed, "wrong": wrong}
    cases = [
        {"gust": gust, "references": kind, "estimator": name}
        for gust, kind, name in itertools.product(gusts, references, estimators)
    ]
    report = monte_carlo(out, settings, cases, lambda gust, references, **_: flown(gust, references), row_of, summary)
    figures = "flights", "bias [%]", "RMSE [%]", "std [%]", "RMSE / bound", "covered [%]", "results"
    title = f"moments of inertia from flights of {duration:g} s in closed loop"
    print_table(title, ("gust", "references", "estimator", "", *figures), table_rows(report))
