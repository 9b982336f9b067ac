"""A real Crazyflie: one part of a flight is fitted and another predicted, by shooting and by regression.

The roll and pitch flight is cut into blocks of 5 s from 1 s on. The 1st, 3rd, ... block is fitted, the 2nd, 4th, ... is
tested, for all estimators. The inputs of the predictions are the recorded commands and, with `flapping`, the recorded
specific force along x and y. Commands are not rotor speeds: thrust as a function of the command is fitted to the
accelerometer (`thrust_curve`, `thrust_gain`). Torques, and therefore inertias, are proportional to this thrust.
"""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from jaxos4.flight import STATE_NAMES
from jaxos4.identification import refit
from jaxos4.identification.constants import vehicle_constants
from jaxos4.identification.results import RigidBody
from jaxos4.models.state import Rates
from jaxos4.recording import Stretch, averaged, cut, usable_stretches
from jaxos4.results import NINETY_FIVE

jax.config.update("jax_enable_x64", True)

AIRFRAME = jaxos4.load_airframe(Path(__file__).with_name("crazyflie.toml"))
AUTHORS = {"Ix": 1.03e-5, "Iy": 1.11e-5}
TERMS = ("offset", "damping", "flapping", "lag", "delay", "reaction", "curve", "accelerometer")
FLIGHTS = ("rollpitch", "yaw_a", "yaw_b", "hover")
HORIZONS = (0.05, 0.1, 0.25, 0.5)
MEMORIES = (0.0, 0.9, 1.0)
LAGS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09)
DELAYS = (0.0, 0.004, 0.008, 0.012, 0.016, 0.02)
# Sample time, window, the first block's begin, and the blocks' length [s].
DT, WINDOW, BEGIN, BLOCK = 0.004, 0.25, 1.0, 5.0
# The parts of a flight for the jackknife, as in `jaxos4.skill`.
PARTS = 10
NAMES = ("output-error", "hybrid", "ibss, nothing held", "ibss without flapping")
SECTIONS = ("regression", "lag", "joint")
INERTIAS = {"Ix": "alpha3", "Iy": "alpha6"}

Values = dict[str, float]


def read(folder: Path, name: str) -> jaxos4.Flight:
    """A flight, averaged to samples of 4 ms, which removes the vibration."""
    flight, _ = jaxos4.read_log(folder / f"arpl_crazyflie_{name}.csv", AIRFRAME)
    return averaged(flight, DT)


def blocks(flight: jaxos4.Flight, seconds: float) -> tuple[list[jaxos4.Flight], list[jaxos4.Flight]]:
    """The fitted and the tested blocks."""
    count = int((min(float(flight.time[-1]), seconds) - BEGIN) / BLOCK)
    begins = BEGIN + BLOCK * np.arange(count)
    parts = [cut(flight, Stretch(float(begin), float(begin) + BLOCK - DT)) for begin in begins]
    return parts[::2], parts[1::2]


def problem_of(
    parts: list[jaxos4.Flight], terms: tuple[str, ...], recordings: tuple[int, ...] | None = None
) -> jaxos4.ShootingProblem:
    """The problem of several parts of flights in windows."""
    length = round(WINDOW / DT)
    flight = jaxos4.join(parts, length=length)
    model = jaxos4.FlightModel(AIRFRAME, terms=terms, recordings=recordings or (0,) * len(parts))
    windows, sigma = flight.time.shape[0] // length, np.full(12, 0.5)
    return jaxos4.ShootingProblem(model, flight, sigma=sigma, channels="rates", method="rk4", windows=windows)


def without(terms: tuple[str, ...], *left_out: str) -> tuple[str, ...]:
    """The terms that remain."""
    return tuple(term for term in terms if term not in left_out)


def predict(values: Values, parts: list[jaxos4.Flight], terms: tuple[str, ...] = TERMS) -> jaxos4.Predictions:
    """Predictions for a vehicle with these parameters, over parts of flights."""
    problem = problem_of(parts, without(terms, "accelerometer"))
    parameters = jnp.asarray([values[name] for name in problem.model.parameter_names])
    return jaxos4.predictions(problem, parameters, horizons=HORIZONS)


def difference(one: jaxos4.Predictions, other: jaxos4.Predictions) -> dict[str, Any]:
    """The skill of `one` minus that of `other`, with the jackknife's standard error."""
    squares = [np.nan_to_num(np.square(x.predicted - x.measured)) for x in (one, other)]
    change = np.nan_to_num(np.square(one.initial[:, None] - one.measured))
    parts = np.array_split(np.arange(change.shape[0]), PARTS)

    def gain(kept: np.ndarray) -> np.ndarray:
        return (squares[1][kept] - squares[0][kept]).sum(axis=0) / change[kept].sum(axis=0)

    everything = np.arange(change.shape[0])
    without_part = np.stack([gain(np.setdiff1d(everything, part)) for part in parts])
    spread = np.sqrt((PARTS - 1) * np.square(without_part - without_part.mean(axis=0)).mean(axis=0))
    return {
        rate: {"difference": gain(everything)[:, i].tolist(), "std": spread[:, i].tolist()}
        for i, rate in enumerate("pqr")
    }


def worth(predicted: jaxos4.Predictions) -> dict[str, Any]:
    """The skill, for JSON."""
    found = jaxos4.skill(predicted)
    names = ("skill", "std", "rmse", "persistence")
    table = {rate: {name: getattr(found, name)[:, i].tolist() for name in names} for i, rate in enumerate("pqr")}
    return {"horizons": predicted.horizons.tolist(), "starts": found.starts, **table}


def intervals(body: RigidBody, gain: float = 1.0) -> dict[str, Any]:
    """Moments of inertia [kg m^2] with 95 % intervals; `gain` multiplies them, as torques go with thrust."""
    table = {}
    for name, row in body.constants.items():
        estimate, half_width = gain * row.estimate, gain * NINETY_FIVE * row.std
        table[name] = {"estimate": estimate, "ci95": [estimate - half_width, estimate + half_width]}
    return table


def inertias(problem: jaxos4.ShootingProblem, estimate: jaxos4.Estimate, gain: float = 1.0) -> dict[str, Any]:
    """The `intervals` of an estimate's moments of inertia."""
    names, bracket = problem.model.parameter_names, jaxos4.Bracket.default(jaxos4.FlightModel(AIRFRAME, terms=()))
    return intervals(vehicle_constants(names, estimate, bracket, AIRFRAME), gain)


def described(fit: jaxos4.VehicleFit, seconds: float, rollouts: int = 0) -> dict[str, Any]:
    """A fit, for JSON; `rollouts`: those of earlier searches, which do not count."""
    model, found = fit.problem.model, fit.estimate
    std = dict(zip(model.parameter_names, found.std.tolist(), strict=True))
    units = dict(zip(model.parameter_names, model.parameter_units, strict=True))
    return {
        "result": str(jaxos4.result_names(found.result)),
        "cost": float(found.cost),
        "rollouts": fit.rollouts - rollouts,
        "cut": fit.cut,
        "seconds": seconds,
        "parameters": {name: {"estimate": fit.values[name], "std": std[name], "unit": units[name]} for name in std},
        "held": {name: {"value": value, "note": note} for name, (value, note) in fit.held.items()},
        "inertias": inertias(fit.problem, found),
        "cross_checks": cross_checks(fit.values, std),
    }


def cross_checks(values: Values, std: Values) -> dict[str, Any]:
    """Weakly identifiable parameters, compared with what the others imply: if they disagree, trust neither.

    J_R should be alpha2 Ix and also alpha5 Iy; alpha7 should be (Ix - Iy) / Iz.
    """
    checks: dict[str, Any] = {}
    for gyroscopic, alpha in (("alpha2", "alpha3"), ("alpha5", "alpha6")):
        if gyroscopic in std:
            checks[f"J_R from {gyroscopic}"] = {
                "estimate": values[gyroscopic] / values[alpha],
                "std": std[gyroscopic] / values[alpha],
            }
    if "alpha7" in std and "alpha8" in values:
        implied = values["alpha8"] * (1 / values["alpha3"] - 1 / values["alpha6"])
        checks["alpha7"] = {"estimate": values["alpha7"], "std": std["alpha7"], "of the inertias": implied}
    return checks


def fitted(problem: jaxos4.ShootingProblem) -> tuple[jaxos4.VehicleFit, float]:
    """The staged fit, and its time [s]."""
    begin = time.perf_counter()
    fit = jaxos4.fit_vehicle(problem, jaxos4.Bracket.default(problem.model))
    return fit, time.perf_counter() - begin


def hybrid_for(fit: jaxos4.VehicleFit, steps: int) -> jaxos4.Hybrid:
    """A hybrid with a network trained for this flight, at the noise levels that were found."""
    training = jaxos4.NetworkEstimator(steps=steps, batch=32, noise=(1.0, 1.0), held_out=1000, width=32, depth=1)
    bracket = jaxos4.Bracket.default(fit.problem.model)
    return jaxos4.Hybrid(training.fit(fit.problem, bracket, key=jax.random.key(0)))


def estimators(parts: tuple[list, list], steps: int, names: list[str]) -> Iterator[tuple[str, dict, tuple]]:
    """IBSS in stages; the others, and IBSS with nothing held, on its last problem; IBSS without `flapping`."""
    fit, seconds = fitted(problem_of(parts[0], TERMS))
    bracket = jaxos4.Bracket.default(problem_of(parts[0], TERMS).model)
    for name in ("ibss", *names):
        terms, extra, used, rollouts = TERMS, {}, fit, 0
        begin = time.perf_counter()
        if name == "output-error":
            used, rollouts = refit(fit, jaxos4.OutputError(), bracket), fit.rollouts
        elif name == "hybrid":
            hybrid = hybrid_for(fit, steps)
            extra["training_seconds"] = time.perf_counter() - begin
            begin = time.perf_counter()
            used, rollouts = refit(fit, hybrid, bracket), fit.rollouts
            at, seed = used.estimate.parameters, used.estimate.seed
            extra["seed_held_the_answer"] = bool(((at > seed.lower) & (at < seed.upper)).all())
        elif name == "ibss, nothing held":
            used, rollouts = refit(fit, jaxos4.IBSS(), bracket, held={}), fit.rollouts
        elif name == "ibss without flapping":
            terms = without(TERMS, "flapping")
            used, _ = fitted(problem_of(parts[0], terms))
        if name != "ibss":
            seconds = time.perf_counter() - begin
        predicted = predict(used.values, parts[1], terms)
        print(f"{name}: {seconds:.0f} s", flush=True)
        yield name, {**described(used, seconds, rollouts), **extra, "skill": worth(predicted)}, (used, predicted)


def one_step(problem: jaxos4.ShootingProblem, parameters: jax.Array) -> float:
    """The root mean square error of the rates predicted one sample ahead, over sigma."""
    model, flight = problem.model, problem.flight
    columns = np.array([STATE_NAMES.index(rate) for rate in "pqr"])
    rates, forcing, scalars = flight.states[:, columns], problem.forcing(parameters), tuple(parameters)

    def change(rates: jax.Array, forcing) -> jax.Array:
        return flight.dt * jnp.stack(model.angular_acceleration(Rates(*rates), forcing, scalars))

    rows = jax.tree.map(lambda leaf: leaf[:-1], forcing)
    predicted = (jax.vmap(change)(rates[:-1], rows) + jax.vmap(change)(rates[1:], rows)) / 2
    within = np.diff(np.asarray(flight.stretch)) == 0
    off = (jnp.diff(rates, axis=0) - predicted)[within] / problem.sigma[columns]
    return float(jnp.sqrt(jnp.nanmean(off**2)))


def regressions(found: dict[str, tuple], parts: tuple[list, list]) -> dict:
    """Equation error with the same terms: alone, and with the rotors and the held parameters of shooting.

    Alone it takes the lag and the delay with the smallest `one_step` error, the documented thrust and its curve, and
    holds nothing else.
    """
    fit, shot = found["ibss"][0], found["ibss"][0].values
    whole = problem_of(parts[0], without(TERMS, "accelerometer"))
    bare = eqx.tree_at(lambda p: p.sigma, whole, fit.problem.sigma[:12])
    of_shooting = {name: value for name, (value, _) in fit.held.items() if name in whole.model.parameter_names}

    def regress(memory: float, held: Values, *, bare: jaxos4.ShootingProblem = bare):
        model = jaxos4.hold(whole.model, held)
        problem = eqx.tree_at(lambda p: p.model, bare, model)
        estimate = jaxos4.EquationError(memory=memory)(problem, jaxos4.Bracket.default(model))
        return problem, estimate, dict(zip(model.parameter_names, estimate.parameters.tolist(), strict=True)) | held

    def jackknifed(memory: float, held: Values, gain: float) -> dict[str, Any]:
        """Inertias, with the jackknife's standard errors: these contain the errors of the model."""
        problem, estimate, _ = regress(memory, held)
        some = []
        for part in np.array_split(np.arange(bare.flight.time.shape[0]), PARTS):
            states = bare.flight.states.at[part].set(jnp.nan)
            some.append(regress(memory, held, bare=eqx.tree_at(lambda p: p.flight.states, bare, states))[1].parameters)
        covariance = jnp.diag((PARTS - 1) * jnp.var(jnp.stack(some), axis=0))
        return inertias(problem, eqx.tree_at(lambda e: e.covariance, estimate, covariance), gain)

    documented, grid = {"thrust_curve": 1.0}, []
    for lag in (0.01, *LAGS):
        for delay in DELAYS:
            problem, best_fit, values = regress(0.0, documented | {"rotor_lag": lag, "rotor_delay": delay})
            row = {"lag": lag, "delay": delay, "one_step": one_step(problem, best_fit.parameters)}
            grid.append(row | {name: 1 / values[alpha] for name, alpha in INERTIAS.items()})
    best = min(grid, key=lambda row: row["one_step"])
    own = documented | {"rotor_lag": best["lag"], "rotor_delay": best["delay"]}
    its = {name: shot[name] for name in own}
    choices = {
        "alone": (own, 1.0),
        "own rotors, holds what shooting held": (own | of_shooting, 1.0),
        "rotors of shooting": (its, shot["thrust_gain"]),
        "rotors of shooting, holds what shooting held": (its | of_shooting, shot["thrust_gain"]),
    }
    rows = {}
    for choice, (held, gain) in choices.items():
        for memory in MEMORIES:
            values = regress(memory, held)[2]
            predicted = predict(values, parts[1])
            rows[f"memory {memory:g}, {choice}"] = {
                "values": values,
                "held": sorted(held),
                "inertias": jackknifed(memory, held, gain),
                "skill": worth(predicted),
                "minus_this": {
                    name: difference(found[name][1], predicted)
                    for name in ("ibss", "ibss, nothing held")
                    if name in found
                },
            }
    return {"grid": grid, "chosen": best, "rows": rows}


def lag_sensitivity(fit: jaxos4.VehicleFit, parts: tuple[list, list], lags: list[float]) -> list[dict[str, Any]]:
    """The last stage again with the lag held: same noise levels, same cut outliers; the delay stays free."""
    bracket, rows = jaxos4.Bracket.default(problem_of(parts[0], TERMS).model), []
    for lag in lags:
        one = refit(fit, jaxos4.IBSS(), bracket, held=fit.held | {"rotor_lag": (lag, "given")})
        rows.append(
            {
                "lag": lag,
                "delay": one.values["rotor_delay"],
                "result": str(jaxos4.result_names(one.estimate.result)),
                "cost": float(one.estimate.cost),
                "inertias": inertias(one.problem, one.estimate),
                "skill": worth(predict(one.values, parts[1])),
            }
        )
        print(f"lag {lag:g} s: {rows[-1]['inertias']}", flush=True)
    return rows


def joint(folder: Path, seconds: float) -> dict[str, Any]:
    """All flights at once, each with its own offsets: only these excite yaw."""
    parts, recordings = [], []
    for number, name in enumerate(FLIGHTS):
        flight = read(folder, name)
        for part in usable_stretches(flight, AIRFRAME):
            if part.begin < seconds:
                parts.append(cut(flight, part._replace(end=min(part.end, seconds))))
                recordings.append(number)
    kept = sorted(set(recordings))
    problem = problem_of(parts, TERMS, tuple(kept.index(number) for number in recordings))
    fit, spent = fitted(problem)
    stretches = [
        [FLIGHTS[number], float(part.time[0]), float(part.time[-1])]
        for number, part in zip(recordings, parts, strict=True)
    ]
    return {**described(fit, spent), "stretches": stretches}


def main(
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    seconds: Annotated[float, typer.Option(help="How much of each flight.")] = np.inf,
    steps: Annotated[int, typer.Option(help="Training steps of the hybrid's network.")] = 500,
    names: Annotated[list[str], typer.Option(help="Estimators besides IBSS.")] = NAMES,
    lags: Annotated[list[float], typer.Option(help="Values at which the lag is held [s].")] = LAGS,
    sections: Annotated[list[str], typer.Option(help="Some of regression, lag, joint.")] = SECTIONS,
) -> None:
    """Fit, test and compare."""
    folder = flights or (Path(os.environ["JAXOS4_FLIGHTS"]) if os.environ.get("JAXOS4_FLIGHTS") else None)
    if folder is None or not (folder / f"arpl_crazyflie_{FLIGHTS[0]}.csv").is_file():
        raise SystemExit(f"--flights: no arpl_crazyflie_{FLIGHTS[0]}.csv in {folder}: give the folder of the flights.")
    out.mkdir(parents=True, exist_ok=True)
    begin, parts = time.perf_counter(), blocks(read(folder, FLIGHTS[0]), seconds)
    report: dict[str, Any] = {
        "version": jaxos4.__version__,
        "jax": jax.__version__,
        "precision": "float64",
        "seed": 0,
        "fitted": [[float(part.time[0]), float(part.time[-1])] for part in parts[0]],
        "tested": [[float(part.time[0]), float(part.time[-1])] for part in parts[1]],
        "sample_time": DT,
        "window": WINDOW,
        "authors": AUTHORS,
    }

    def save() -> None:
        report["seconds"] = time.perf_counter() - begin
        (out / "results.json").write_text(json.dumps(report, indent=1) + "\n")

    report["estimators"], found = {}, {}
    for name, table, found[name] in estimators(parts, steps, list(names)):
        report["estimators"][name] = table
        save()
    fit, predicted = found["ibss"]
    np.savez(out / "predictions.npz", block=_block_of(predicted), **predicted._asdict())
    if "regression" in sections:
        report["regression"] = regressions(found, parts)
        save()
    if "lag" in sections:
        report["lag"] = lag_sensitivity(fit, parts, list(lags))
        save()
    if "joint" in sections:
        report["joint"] = joint(folder, seconds)
        save()


def _block_of(predicted: jaxos4.Predictions) -> np.ndarray:
    """The tested block of each start."""
    length = round(WINDOW / DT)
    return predicted.start // (int(BLOCK / DT) // length * length)


if __name__ == "__main__":
    typer.run(main)
