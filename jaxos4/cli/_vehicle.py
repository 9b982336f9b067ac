"""`jaxos4 estimate --model flight`: a real vehicle from one log or several, checked on what was not fitted."""

import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.console import Console

from ..airframe import Airframe, load_airframe
from ..bracket import Bracket
from ..dynamics import PARAMETER_NAMES, CorrectedOS4
from ..errors import InputError
from ..estimators import EquationError, Estimate, Hybrid, NetworkEstimator, OutputError
from ..flight import Flight
from ..flight_model import TERMS, FlightModel, has_full_scale
from ..held import hold
from ..inertia import fit_inertia
from ..results import result_names
from ..shooting import ShootingProblem
from ..validation import Predictions, Skill, predictions, skill
from ..vehicle import VehicleFit, fit_vehicle
from ._bracket_file import load_bracket
from ._json import finite
from ._recordings import Part, load_logs

# Where the search for the noise levels begins [rad/s]: more the model's errors than the sensor's.
FIRST_SIGMA = 0.5
# How a network is trained that only has to say where to look in flights cut into windows.
_SEED_STEPS, _SEED_BATCH = 500, 64
# [GiB] of output error's dense Jacobian; a few of its size are needed.
_MOST_DENSE = 1.0
# Which alpha is torque over which inertia.
_TORQUES = {"Ix": 2, "Iy": 5, "Iz": 7}


def identify_vehicle(
    console: Console,
    logs: list[Path],
    *,
    estimator: str,
    airframe: str,
    bracket: Path | None,
    terms: str | None,
    part: Part,
    validate: Path | None,
    huber: bool,
) -> tuple[dict[str, Any], Predictions | None]:
    """The report, and the predictions over what was held out. Raises `InputError` for what cannot be used."""
    if estimator not in ("ibss", "hybrid", "output-error"):
        raise InputError(f"--estimator {estimator}: a flight model is shot; use ibss, hybrid or output-error.")
    begin = time.perf_counter()
    vehicle = load_airframe(airframe)
    recorded = load_logs(logs, vehicle, part)
    model = FlightModel(vehicle, terms=_terms(terms, recorded.fitted, vehicle), recordings=recorded.recordings)
    where = Bracket.default(model) if bracket is None else load_bracket(bracket, model)
    other = recorded.tested
    notes = recorded.notes
    if validate is not None:
        elsewhere = load_logs([validate], vehicle, part._replace(begin=None, end=None, holdout=0.0))
        other, notes = elsewhere.fitted, notes + elsewhere.notes
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    problem = _problem(model, recorded.fitted, part)
    measured = (~np.isnan(np.asarray(problem.measured()))).sum()
    if measured <= len(model.parameter_names) + problem.windows * problem.free_size:
        raise InputError(
            f"{logs[0]}: {measured} measurements are too few for windows of {part.window:g} s; use longer."
        )
    dense = problem.measured().size * (len(model.parameter_names) + problem.windows * problem.free_size) * 8 / 2**30
    if estimator == "output-error" and dense > _MOST_DENSE:
        raise InputError(
            f"--estimator output-error: its Jacobian would take {dense:.0f} GiB in {problem.windows} windows; "
            "use ibss, or less of the flight by --from and --to."
        )
    with console.status("fitting") as status:
        fit = fit_vehicle(
            problem, where, estimator=_method(estimator), huber=huber, progress=lambda stage: status.update(stage)
        )
        predicted = compared = None
        if fit.answered and other is not None:
            status.update("predicting what was not fitted")
            predicted, compared = _validate(fit, other, logs[0] if validate is None else validate)
    report = {
        "estimator": estimator,
        "model": "flight",
        "result": str(result_names(fit.estimate.result)),
        "rollouts": fit.rollouts,
        "cost": finite(fit.estimate.cost),
        "seconds": time.perf_counter() - begin,
        "parameters": _parameters(fit, where, model) if fit.answered else {},
        "held": {
            name: {"value": fit.held[name][0], "unit": unit, "note": fit.held[name][1] or "not asked"}
            for name, unit in zip(model.parameter_names, model.parameter_units, strict=True)
            if name in fit.held
        },
        "constants": _constants(fit, where, model) if fit.answered else {},
        "cut": fit.cut,
        "noise": {
            name: float(fit.problem.sigma[i])
            for name, i in (("p", 7), ("q", 9), ("r", 11), ("az", 14))
            if i in fit.problem.columns
        },
        "skill": compared,
        "provenance": {
            "flights": [str(path) for path in logs],
            "validate": None if validate is None else str(validate),
            "airframe": airframe,
            "terms": list(model.terms),
            "window": part.window,
            "sample_time": float(recorded.fitted.dt),
            "fitted_seconds": recorded.seconds[0],
            "tested_seconds": recorded.seconds[1],
            "loss": "huber" if huber else "squares",
            "notes": list(notes),
        },
    }
    return report, predicted


def _terms(asked: str | None, flight: Flight, airframe: Airframe) -> tuple[str, ...]:
    """The terms asked for, or those that what was measured allows."""
    force = np.asarray(flight.channels)[:, 12:]
    ax, ay, az = (not bool(np.isnan(force[:, i]).all()) for i in range(3))
    able = {
        "flapping": ax and ay,
        "velocity": flight.body_velocity is not None,
        "drag": flight.body_velocity is not None and ax and ay,
        "accelerometer": az,
    }
    if asked is None:
        chosen = ["offset", "damping", "reaction", *(["lag", "delay"] if flight.commanded else [])]
        if able["velocity"]:
            chosen.append("velocity")
        elif able["flapping"]:
            chosen.append("flapping")
        if able["accelerometer"]:
            # Commands are in no known proportion to thrust; what was accelerated says in which.
            chosen += ["accelerometer", *(["curve"] if flight.commanded and has_full_scale(airframe) else [])]
        return tuple(term for term in TERMS if term in chosen)
    names = [name.strip() for name in asked.split(",") if name.strip()]
    for name in names:
        if name not in TERMS:
            raise InputError(f"--terms: knows no `{name[:40]}`; the terms are {', '.join(TERMS)}.")
        if not able.get(name, True):
            raise InputError(f"--terms: {name} needs what these logs did not measure; leave it out.")
        if name == "curve" and not has_full_scale(airframe):
            raise InputError("--terms: curve needs max_rotor_speed in the airframe's file; set it or leave it out.")
    return tuple(term for term in TERMS if term in names)


def _problem(model: FlightModel, flight: Flight, part: Part) -> ShootingProblem:
    windows = flight.time.shape[0] // round(part.window / float(flight.dt))
    sigma = np.full(12, FIRST_SIGMA)
    return ShootingProblem(model, flight, sigma=sigma, channels="rates", method="rk4", windows=windows)


def _method(estimator: str):
    if estimator == "ibss":
        return None
    return OutputError() if estimator == "output-error" else _hybrid


def _hybrid(problem: ShootingProblem, bracket: Bracket) -> Estimate:
    """A network for these inputs, trained now, and shooting from its answer."""
    training = NetworkEstimator(steps=_SEED_STEPS, batch=_SEED_BATCH, noise=(1.0, 1.0), held_out=1000)
    return Hybrid(training.fit(problem, bracket, key=jax.random.key(0)))(problem, bracket)


def _validate(fit: VehicleFit, flight: Flight, path: Path) -> tuple[Predictions, dict[str, Any]]:
    """How far ahead the rates of a flight that was not fitted are predicted, and how regression does with the terms."""
    problem, found = fit.problem, fit.estimate.parameters

    def scored(parameters: Array) -> tuple[Predictions, Skill]:
        try:
            predicted = predictions(eqx.tree_at(lambda p: p.flight, problem, flight), parameters)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
        return predicted, skill(predicted)

    predicted, worth = scored(found)
    _, theirs = scored(_regressed(problem, found))
    return predicted, {
        "horizons": predicted.horizons.tolist(),
        "starts": worth.starts,
        **{
            name: {
                "skill": [finite(x) for x in worth.skill[:, i]],
                "std": [finite(x) for x in worth.std[:, i]],
                "rmse": [finite(x) for x in worth.rmse[:, i]],
                "persistence": [finite(x) for x in worth.persistence[:, i]],
                "equation_error": [finite(x) for x in theirs.skill[:, i]],
            }
            for i, name in enumerate("pqr")
        },
    }


@eqx.filter_jit
def _regressed(problem: ShootingProblem, found: Array) -> Array:
    """What regression with the terms finds, told what it cannot find: lag, delay and thrust curve."""
    names = problem.model.parameter_names
    known = {names[i]: found[i] for i in problem.model.driving}
    if not known:
        return EquationError(memory=0.0).solution(problem, Bracket.default(problem.model))
    linear = hold(problem.model, known)
    problem = eqx.tree_at(lambda p: p.model, problem, linear)
    return linear.complete(EquationError(memory=0.0).solution(problem, Bracket.default(linear)))


def _parameters(fit: VehicleFit, bracket: Bracket, model: FlightModel) -> dict[str, dict[str, Any]]:
    found = fit.estimate
    half_width = np.asarray(found.half_width(0.95))
    places = {name: i for i, name in enumerate(fit.problem.model.parameter_names)}
    table = {}
    for number, (name, unit) in enumerate(zip(model.parameter_names, model.parameter_units, strict=True)):
        if name not in places:
            continue
        i = places[name]
        value, std = float(found.parameters[i]), float(found.std[i])
        told = np.isfinite(std) and std <= float(bracket.half_width[number])
        outside = not float(bracket.lower[number]) <= value <= float(bracket.upper[number])
        notes = ["below noise"] * bool(abs(value) < half_width[i]) + ["outside its bracket"] * bool(outside)
        table[name] = {
            "estimate": value if told else None,
            "std": finite(std),
            "bound": finite(fit.bound[i]),
            "ci95": [value - half_width[i], value + half_width[i]] if told else None,
            "note": "; ".join(notes) if told else "not told by these flights",
            "unit": unit,
        }
    return table


def _constants(fit: VehicleFit, bracket: Bracket, model: FlightModel) -> dict[str, Any]:
    """Ix, Iy, Iz of the rigid body that explains the alphas that are told.

    Torques are as much larger than the airframe says as thrust is, where an accelerometer tells that: alpha3, alpha6
    and alpha8 are divided by `thrust_gain`.
    """
    names, values = fit.problem.model.parameter_names, np.asarray(fit.estimate.parameters)
    gain = names.index("thrust_gain") if "thrust_gain" in names else None
    whole, slopes = np.asarray(bracket.center)[:8].copy(), np.zeros((8, len(names)))
    spread = (1e3 * np.asarray(bracket.half_width)[:8]) ** 2
    for to, name in enumerate(PARAMETER_NAMES):
        if name not in names:
            continue
        of = names.index(name)
        whole[to], slopes[to, of], spread[to] = values[of], 1.0, 0.0
        if gain is not None and to in _TORQUES.values():
            whole[to] /= values[gain]
            slopes[to, of], slopes[to, gain] = 1 / values[gain], -whole[to] / values[gain]
    covariance = slopes @ np.asarray(fit.estimate.covariance) @ slopes.T + np.diag(spread)
    told, note = {}, f"if arms and {'thrust_coefficient' if gain is None else 'mass'} are right"
    for name, axis in _TORQUES.items():
        if PARAMETER_NAMES[axis] in names and whole[axis] > 0:
            std = float(np.sqrt(covariance[axis, axis])) / whole[axis] ** 2
            told[name] = {"estimate": 1 / float(whole[axis]), "std": std, "unit": "kg m^2", "note": note}
    rigid = fit_inertia(CorrectedOS4(model.airframe), jnp.asarray(whole), jnp.asarray(covariance))
    return {**told, "consistency_p": float(rigid.p_value), "rigid_body": bool(rigid.is_rigid_body)}
