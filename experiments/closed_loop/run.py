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
import time

import equinox as eqx
import jax
import numpy as np

import jaxos4
from experiments.closed_loop.effects import CHUNK, DELAY, DT, LAG, LARGEST, VEHICLE, flights_of, stacked
from experiments.fits import INERTIAS, given_airframe, identified, shares_of_truth, summary, whole
from experiments.monte_carlo import LOST, Row, check_names, groups, plus_minus, print_table, product, results_of, study
from experiments.shared import Count, Estimators, Out, Seed
from jaxos4.design import standard_references
from jaxos4.estimators import ESTIMATORS

WINDOW = 62  # samples
# Standard deviation of the gyro's noise [rad/s].
SIGMA = 0.02
# Without a disturbance in their model. The regression's memory is the best on real flights.
WITHOUT_DISTURBANCE = {"equation-error": jaxos4.EquationError(memory=0.9), "output-error": jaxos4.OutputError()}


def references_of(kind: str, gust: float, duration: float, seed: int) -> np.ndarray | None:
    """The references of all flights; `None`: random, other ones for each flight."""
    if kind == "random":
        return None
    if kind == "designed":
        loop = jaxos4.ClosedLoop(VEHICLE, rotor_lag=LAG, rotor_delay=DELAY, gust=gust)
        settings = {"angle": LARGEST[0], "acceleration": LARGEST[3], "duration": duration, "dt": DT}
        return jaxos4.design_references(loop, **settings, key=jax.random.key(seed)).designed.inputs
    return standard_references(round(duration / DT) + 1, DT, LARGEST)[kind]


def _fit(estimator: jaxos4.AbstractEstimator, flights: jaxos4.Flight, airframes: jaxos4.Airframe) -> jaxos4.Estimate:
    """The estimates of a batch of flights, each with its airframe."""

    def one(flight: jaxos4.Flight, airframe: jaxos4.Airframe) -> jaxos4.Estimate:
        model = jaxos4.FlightModel(airframe, terms=("offset", "damping", "lag", "delay", "reaction"))
        windows = flight.time.shape[0] // WINDOW
        flight = jax.tree.map(lambda x: x[: windows * WINDOW] if x.ndim else x, flight)
        problem = jaxos4.ShootingProblem(
            model, flight, sigma=np.full(12, SIGMA), channels="rates", method="rk4", windows=windows
        )
        return estimator(problem.hold({"rotor_lag": LAG, "rotor_delay": DELAY}))

    return eqx.filter_vmap(one)(flights, airframes)


def regress(estimator: str, flights: dict[int, jaxos4.Flight], wrong: float) -> list[Row]:
    """The rows of some flights, by their numbers, without a disturbance, in one call.

    Their standard deviations are those of white gyro noise alone.
    """
    known = [given_airframe(VEHICLE, i, 0.0, wrong) for i in flights]
    spare = CHUNK - len(flights)  # one program for all calls
    batch = (stacked(some + some[-1:] * spare) for some in (list(flights.values()), known))
    begin = time.perf_counter()
    found = jax.block_until_ready(_fit(WITHOUT_DISTURBANCE[estimator], *batch))
    results, seconds = jaxos4.result_names(found.result), time.perf_counter() - begin
    places = [jaxos4.CorrectedOS4().parameter_names.index(alpha) for alpha in INERTIAS.values()]
    ratios = 1 / np.asarray(found.parameters)[:, places] / np.asarray(VEHICLE.inertia)
    errors = np.asarray(found.std)[:, places] * ratios**2 * np.asarray(VEHICLE.inertia)
    rows = []
    for k in range(len(flights)):
        row: Row = {"result": str(results[k]), "seconds": seconds / len(flights)}
        for name, ratio, std in zip(INERTIAS, ratios[k].tolist(), errors[k].tolist(), strict=True):
            row[name] = {"error": ratio - 1, "std": std, "bound": std}
        rows.append(row)
    return rows


def search(estimator: str, flight: jaxos4.Flight, i: int, wrong: float) -> Row:
    """The row of one flight by an estimator of `jaxos4.identify`."""
    row, found = identified(flight, given_airframe(VEHICLE, i, 0.0, wrong), settings=whole(flight), estimator=estimator)
    if found is None:
        return row
    for name, one in shares_of_truth(found, VEHICLE).items():
        known = found.parameters[INERTIAS[name]]
        # The bound of the parameter, as a share of its standard deviation.
        row[name] = one | {"bound": one["std"] * (known.bound or np.nan) / (known.std or np.nan)}
    return row


def print_cases(title: str, rows: list[Row]) -> None:
    """One line for each estimator, strength of gusts and moment of inertia; one without numbers if none has any."""
    lines: list[tuple[str, ...]] = []
    for (gust, *about), some in groups(rows, "gust", "references", "estimator").items():
        begin, results, found = (f"{gust:g}", *about), results_of(some), summary(some)
        for name, row in found.items():
            sizes = plus_minus(row), f"{100 * row['rmse']:.3g}", f"{100 * row['std']:.3g}"
            shares = plus_minus(row, "efficiency", 1.0), plus_minus(row, "covered")
            lines.append((*begin, name, str(row["flights"]), *sizes, *shares, results))
        if not found:
            lines.append((*begin, *[""] * 7, results))
    figures = "flights", "bias [%]", "RMSE [%]", "std [%]", "RMSE / bound", "covered [%]", "results"
    print_table(title, ("gust", "references", "estimator", "", *figures), lines)


def main(
    flights: Count = 200,
    gusts: list[float] = (5.0, 10.0, 20.0),
    duration: float = 20.0,
    seed: Seed = 16,
    estimators: Estimators = ("equation-error", "output-error", "filter-error"),
    references: list[str] = ("random",),
    wrong: float = 0.25,
    out: Out = None,
) -> None:
    """Measure bias and coverage of moments of inertia over the strength of gusts.

    - `references`: random, designed, or a standard: 3211, doublet, ...
    - `wrong`: Error of the given moments of inertia, as a share.
    """
    check_names("estimators", estimators, ESTIMATORS)
    standard = standard_references(round(duration / DT) + 1, DT, LARGEST)
    check_names("references", references, ("random", "designed", *standard))

    @functools.cache
    def flown(gust: float, references: str) -> list[jaxos4.Flight | None]:
        wanted = references_of(references, gust, duration, seed)
        return flights_of("gusts", flights, duration, seed, gust, wrong=wrong, references=wanted)

    @functools.cache
    def regressed(gust: float, references: str, estimator: str, first: int) -> dict[int, Row]:
        some = {i: f for i, f in enumerate(flown(gust, references)) if f is not None and first <= i < first + CHUNK}
        return dict(zip(some, regress(estimator, some, wrong), strict=True))

    def row_of(gust: float, references: str, estimator: str, flight: int) -> Row:
        if (recorded := flown(gust, references)[flight]) is None:
            return {"result": LOST}
        if estimator in WITHOUT_DISTURBANCE:
            return regressed(gust, references, estimator, flight - flight % CHUNK)[flight]
        return search(estimator, recorded, flight, wrong)

    settings = {"duration": duration, "seed": seed, "wrong": wrong}
    trials = product(gust=gusts, references=references, estimator=estimators, flight=range(flights))
    rows = study(out, settings, trials, row_of)
    print_cases(f"moments of inertia from flights of {duration:g} s in closed loop", rows)
