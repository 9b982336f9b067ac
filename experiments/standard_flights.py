"""Experiments with noisy standard flights of the OS4: `python -m experiments NAME.run --out data/NAME.json`.

Unless a function says otherwise, the centre of each bracket is drawn within 80 % of the default half-widths around the
truth. Flights are simulated with the model that is fitted (the inverse crime), so that the Cramer-Rao bound applies.
"""

import functools
import time

import equinox as eqx
import jax
import numpy as np

import jaxos4
from experiments.monte_carlo import (
    Column,
    Row,
    check_names,
    count_results,
    covered_error,
    print_rows,
    print_table,
    product,
    study,
)
from experiments.shared import (
    DT,
    EFFICIENCY,
    ENDED,
    PARAMETERS,
    SPAN,
    Count,
    Estimators,
    Fit,
    Out,
    Seed,
    brackets_at,
    flight_keys,
    identify,
    measure,
    monte_carlo_error,
    standard_problem,
)
from jaxos4.estimators import ESTIMATORS, make_estimator
from jaxos4.models import MODELS
from jaxos4.noise import NOISES
from jaxos4.results import NINETY_FIVE

CONSTANTS = ("Ix", "Iy", "Iz", "J_R")
COVERED: dict[str, Column] = {"95 % intervals that hold [%]": lambda row: 100 * np.mean(row["covered"])}
SECONDS: dict[str, Column] = {"s": lambda row: row["flights"] * row["seconds"]}


def baselines(
    flights: Count = 200,
    seed: Seed = 5,
    channels: str = "rates",
    estimators: Estimators = (),
    noises: list[str] = tuple(NOISES),
    scales: list[float] = (0.0, 0.1, 1.0, 10.0),
    out: Out = None,
) -> None:
    """How do all estimators without a network perform, with their default settings, for each kind and scale of noise?

    The bound is always the one for white noise of the same standard deviation, so that the cost of coloured and biased
    noise is visible. At scale 0 there is no noise, and errors are in units of the bound at scale 1.
    """

    def row_of(noise: str, scale: float, estimator: str) -> Row:
        kind = NOISES[noise if scale else "white"](scale * jaxos4.SENSOR_SIGMA)
        fit = Fit(make_estimator(estimator), channels=channels, scale=scale or 1.0)
        _, (row, _) = (fit.row(flights, seed, kind) for _ in range(2))  # the first call compiles
        return row

    check_names("noises", noises, NOISES)
    check_names("estimators", estimators, ESTIMATORS)
    chosen = estimators or [name for name, kind in ESTIMATORS.items() if not kind.needs_network]
    every = product(noise=noises, scale=scales, estimator=chosen)
    trials = (trial for trial in every if trial["scale"] or trial["noise"] == noises[0])
    rows = study(out, {"seed": seed, "channels": channels, "flights": flights}, trials, row_of)
    columns: dict[str, Column] = {
        "noise": lambda row: row["noise"] if row["scale"] else "none",
        "scale": "scale",
        "estimator": "estimator",
        **EFFICIENCY,
        "bias": lambda row: float(np.abs(row["bias"]).max()) if row["bias"] else None,
        **COVERED,
        "ms": lambda row: 1000 * row["seconds"],
        **ENDED,
    }
    print_rows(f"RMSE / Cramer-Rao bound of white noise, {channels}, {flights} flights", rows, columns)


def efficiency(
    flights: Count = 512, seed: Seed = 0, scale: float = 1.0, cases: list[str] = (), out: Out = None
) -> None:
    """How close do the shooting methods come to the Cramer-Rao bound?

    By IBSS if the case names no other estimator. Several windows have free starts.
    """
    ibss, windows = jaxos4.IBSS(), {"known": False, "windows": 4}
    every = {
        "published, all": Fit(ibss),
        "published, rates": Fit(ibss, channels="rates"),
        "published, all, free start": Fit(ibss, known=False),
        "corrected, all": Fit(ibss, "corrected"),
        "corrected, rates": Fit(ibss, "corrected", "rates"),
        "published, all, 4 windows": Fit(ibss, **windows),
        "published, all, 4 windows, output error": Fit(jaxos4.OutputError(), **windows),
    }

    check_names("cases", cases, every)

    def row_of(case: str) -> Row:
        return every[case]._replace(scale=scale).row(flights, seed)[0]

    settings = {"flights": flights, "seed": seed, "scale": scale}
    rows = study(out, settings, product(case=cases or every), row_of, rows="cases")
    columns = {"case": "case", **EFFICIENCY, **COVERED, **ENDED, **SECONDS}
    print_rows(f"RMSE / bound, {flights} flights, noise {scale:g}, {monte_carlo_error(flights)}", rows, columns)


def coverage(
    flights: Count = 2000,
    seed: Seed = 11,
    model: str = "published",
    channels: str = "all",
    estimators: Estimators = ("ibss", "hybrid", "output-error"),
    scales: list[float] = (0.1, 1.0, 10.0),
    steps: int = jaxos4.NetworkEstimator.steps,
    out: Out = None,
) -> None:
    """How often do 95 % intervals contain the truth, for the alphas and for the constants of the rigid body?

    All flights have one true vehicle. The constants Ix, Iy, Iz, J_R are fitted to the alphas of each flight and their
    covariance. `steps`: training steps of the hybrid's network.
    """
    check_names("model", [model], MODELS)
    check_names("estimators", estimators, ESTIMATORS)
    vehicle, error = MODELS[model](jaxos4.OS4), np.sqrt(0.95 * 0.05 / flights)

    @functools.cache
    def network() -> jaxos4.TrainedNetwork:
        training, standard = (
            jaxos4.NetworkEstimator(channels=channels, steps=steps),
            standard_problem(vehicle, channels),
        )
        return training.fit(standard, jaxos4.Bracket.default(vehicle), key=jax.random.key(0))

    def row_of(scale: float, estimator: str) -> Row:
        chosen = make_estimator(estimator, network() if estimator == "hybrid" else None)
        row, found = Fit(chosen, model, channels, scale).row(flights, seed)
        rigid = jaxos4.fit_inertia(vehicle, found.parameters, found.covariance)
        truth = np.append(np.asarray(vehicle.airframe.inertia), vehicle.airframe.rotor_inertia)
        outside = np.abs(rigid.constants - truth) > NINETY_FIVE * np.asarray(rigid.std)
        covered = (np.isfinite(rigid.std) & ~outside).mean(axis=0).tolist()
        return row | {"constants_covered": covered, "inconsistent": float((rigid.p_value < 0.05).mean())}

    settings = {"seed": seed, "flights": flights, "model": model, "channels": channels, "monte_carlo_error": error}
    rows = study(out, settings, product(scale=scales, estimator=estimators), row_of)
    columns: dict[str, Column] = {"scale": "scale", "estimator": "estimator"}
    columns |= {
        name: lambda row, i=i: 100 * (row["covered"] + row["constants_covered"])[i]
        for i, name in enumerate((*PARAMETERS, *CONSTANTS))
    }
    columns |= {"p < 5 %": lambda row: 100 * row["inconsistent"], **SECONDS, "results": "results"}
    title = f"95 % intervals that contain the truth [%], {flights} flights, {model}, {channels}"
    print_rows(title, rows, columns)
    print(f"Monte-Carlo error of each number: {100 * error:.2f} %.")


def robust(flights: Count = 256, seed: Seed = 13) -> None:
    """How often do 95 % intervals contain the truth if the sensors' noise is coloured?

    IBSS identifies flights with Gauss-Markov noise. Intervals by the Cramer-Rao bound of white noise are compared with
    those by `jaxos4.robust_covariance`.
    """
    noise, fit = NOISES["coloured"](jaxos4.SENSOR_SIGMA), Fit(jaxos4.IBSS())
    problem, (_, found) = fit.problem, fit.row(flights, seed, noise)

    def deviations(parameters: jax.Array, states: jax.Array) -> np.ndarray:
        flown = eqx.tree_at(lambda p: p.flight.states, problem, states)
        return np.sqrt(np.diagonal(jaxos4.robust_covariance(jaxos4.evaluate(flown, parameters))))

    states = measure(noise, problem.flight, flight_keys(seed, flights)[0])
    sandwich = np.stack([deviations(*one) for one in zip(found.parameters, states, strict=True)])
    error = np.abs(np.asarray(found.parameters - problem.model.alpha))
    rows = [
        (name, *(f"{100 * share:.0f}" for share in held.mean(axis=0)), f"{100 * held.mean():.1f}")
        for name, std in (("Cramer-Rao bound", np.asarray(found.std)), ("sandwich", sandwich))
        for held in [error < NINETY_FIVE * std]
    ]
    title = (
        f"95 % intervals that hold [%], {flights} flights, Monte-Carlo error {100 * covered_error(0.95, flights):.1g} %"
    )
    print_table(title, ("covariance", *PARAMETERS, "all"), rows)


def every_setting() -> dict[str, list[Fit]]:
    """The settings of `defaults`, each with the flights on which it is measured."""

    def fits(estimator, channels="rates", known=True, scales=(1.0,), models=("published",)) -> list[Fit]:
        return [Fit(estimator, model, channels, scale, known) for model in models for scale in scales]

    both, noises = ("published", "corrected"), (0.1, 1.0, 10.0)
    squares = jaxos4.RecursiveLeastSquares
    return {
        **{f"equation error, memory {m:g}": fits(jaxos4.EquationError(memory=m)) for m in (0.0, 0.9, 0.99)},
        "equation error, memory 1 (default)": fits(jaxos4.EquationError(), scales=noises),
        **{
            f"recursive least squares, forgetting {f:g}": fits(squares(forgetting=f), known=False)
            for f in (0.98, 0.995)
        },
        "recursive least squares, forgetting 1 (default)": fits(squares(), known=False),
        "SVSF, equilibration 1": fits(jaxos4.SVSF(equilibration=1.0), scales=noises),
        **{f"SVSF, passes {n}": fits(jaxos4.SVSF(passes=n), scales=noises) for n in (1, 8)},
        "SVSF (default: equilibration 150, passes 4)": fits(jaxos4.SVSF(), scales=noises, models=both),
        "SVSF (default), free start": fits(jaxos4.SVSF(), known=False, scales=noises),
        "Kalman filter, passes 1, rates": fits(jaxos4.JointEKF(passes=1), models=both),
        "Kalman filter, passes 1": fits(jaxos4.JointEKF(passes=1), "all", models=both),
        "Kalman filter, passes 10 (default)": fits(jaxos4.JointEKF(), "all", models=both),
        "output error, ten times the noise, free start": fits(jaxos4.OutputError(), "all", False, (10.0,)),
        "IBSS, ten times the noise, free start": fits(jaxos4.IBSS(), "all", False, (10.0,)),
        **{f"ant colony, q {q:g}": fits(jaxos4.AntColony(q=q), "all") for q in (0.02, 0.1)},
        **{f"ant colony, xi {xi:g}": fits(jaxos4.AntColony(xi=xi), "all") for xi in (0.7, 1.0)},
        "ant colony, archive 30": fits(jaxos4.AntColony(archive=30), "all"),
        "ant colony (default: q 0.05, xi 0.85, archive 50)": fits(jaxos4.AntColony(), "all"),
    }


def defaults(flights: Count = 64, seed: Seed = 7, settings: list[str] = (), out: Out = None) -> None:
    """Are the estimators' defaults the best of their settings?

    Flights are identified with each value of a setting. The bound is that of the channels that the estimator sees.
    """
    every = every_setting()
    check_names("settings", settings, every)

    @functools.cache
    def least_costs(*flown) -> np.ndarray:
        return np.asarray(Fit(jaxos4.OutputError(), *flown).row(flights, seed)[1].cost)

    def row_of(setting: str, model: str, scale: float) -> Row:
        (fit,) = (fit for fit in every[setting] if (fit.model, fit.scale) == (model, scale))
        row, found = fit.row(flights, seed)
        if not fit.estimator.shoots:  # its cost is that of another criterion
            return row | {"gap": None}
        least = least_costs(fit.model, fit.channels, fit.scale, fit.known)
        return row | {"gap": float(np.max(np.asarray(found.cost) - least))}

    chosen = {name: every[name] for name in settings or every}
    trials = ({"setting": s, "model": fit.model, "scale": fit.scale} for s, some in chosen.items() for fit in some)
    rows = study(out, {"flights": flights, "seed": seed}, trials, row_of)
    columns = {"setting": "setting", "model": "model", "noise": "scale", **SPAN, **COVERED, "gap": "gap", **ENDED}
    print_rows(f"{flights} flights, {monte_carlo_error(flights)}", rows, columns)


def long_flight(
    duration: float = 60.0,
    flights: Count = 8,
    seed: Seed = 3,
    drifts: list[float] = (0.0, 1e-4, 1e-3),
    windows: list[int] = (1, 6, 30, 120),
    estimators: Estimators = ("ibss", "output-error"),
    out: Out = None,
) -> None:
    """How many windows does a long flight need if it drifts away from its model?

    The true rotor speeds differ from the recorded ones by a constant factor for each rotor and flight, of standard
    deviation `drifts`. The model has no term for this factor. The simulated body rates drift away from the measured
    ones, and the drift grows with the length of a window.
    """
    check_names("estimators", estimators, ESTIMATORS)
    model, compared = jaxos4.PublishedOS4(jaxos4.OS4), (0, 2, 3, 5, 7)  # identifiable parameters that are not 0
    recorded = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe, duration=duration), dt=DT)
    noise = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)

    @functools.cache
    def flown(drift: float) -> jax.Array:
        @jax.jit
        @jax.vmap
        def fly(key: jax.Array) -> jax.Array:
            factor_key, noise_key = jax.random.split(key)
            actual = recorded.omega * (1 + drift * jax.random.normal(factor_key, (4,)))
            return noise(jaxos4.simulate(model, model.alpha, actual, dt=DT), key=noise_key).states

        return fly(jax.random.split(jax.random.key(seed), flights))

    def row_of(drift: float, windows: int, estimator: str) -> Row:
        settings = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "rates", "windows": windows}
        problem, brackets = jaxos4.ShootingProblem(model, recorded, **settings), brackets_at(model, 0.3, flights)
        for _ in range(2):  # the first call compiles
            begin = time.perf_counter()
            found = jax.block_until_ready(identify(make_estimator(estimator), problem, brackets, flown(drift)))
        seconds, results = time.perf_counter() - begin, jaxos4.result_names(found.result)
        errors = np.asarray(found.parameters / model.alpha - 1)[results == "successful"][:, compared]
        return {
            "results": count_results(results),
            "successful": len(errors),
            "percent": (100 * np.sqrt(np.mean(errors**2, axis=0))).tolist() if len(errors) else None,
            "rollouts": float(np.mean(found.rollouts)),
            "seconds": seconds / flights,
        }

    trials = product(drift=drifts, windows=windows, estimator=estimators)
    rows = study(out, {"seed": seed, "duration": duration, "flights": flights}, trials, row_of)
    columns: dict[str, Column] = {name: name for name in ("drift", "windows", "estimator")}
    columns |= {
        PARAMETERS[at]: lambda row, i=i: row["percent"][i] if row["percent"] else "-" for i, at in enumerate(compared)
    }
    columns |= {"s": "seconds", **ENDED}
    print_rows(f"RMS error [%] on {flights} flights of {duration:g} s, rates", rows, columns)


SCRIPTS = {
    "baselines.run": baselines,
    "coverage.robust": robust,
    "coverage.run": coverage,
    "defaults.run": defaults,
    "efficiency.run": efficiency,
    "long_flight.run": long_flight,
}
