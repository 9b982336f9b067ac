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
from ..analysis.inertia import fit_inertia
from ..analysis.prediction import HORIZONS, Predictions, Skill, predictions, skill, starts
from ..bracket import Bracket
from ..errors import InputError
from ..estimate import Estimate
from ..estimators import EquationError, Hybrid, OutputError
from ..flight import Flight
from ..identification.vehicle import VehicleFit, fit_vehicle
from ..models.abstract import PARAMETER_NAMES
from ..models.corrected import CorrectedOS4
from ..models.held import hold
from ..models.vehicle import TERMS, FlightModel, has_full_scale
from ..networks import NetworkEstimator
from ..results import result_names
from ..shooting import ShootingProblem
from ._bracket_file import load_bracket
from ._json import finite
from ._recordings import Part, Recorded, load_logs

# Where the search for the noise levels begins [rad/s]: more the model's errors than the sensor's.
FIRST_SIGMA = 0.5
# How a network is trained that only has to say where to look in flights cut into windows.
_SEED_STEPS, _SEED_BATCH = 500, 64
# Of the regression that predictions are compared with: the best of those tried on real flights.
_MEMORY = 0.9
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
    model = FlightModel(vehicle, terms=_terms(terms, recorded, vehicle), recordings=recorded.recordings)
    where = Bracket.default(model) if bracket is None else load_bracket(bracket, model)
    other, seconds, notes = recorded.tested, recorded.seconds[1], recorded.notes
    if validate is not None:
        elsewhere = _other_log(logs, validate, recorded, model, part)
        other, seconds, notes = elsewhere.fitted, elsewhere.seconds[0], notes + elsewhere.notes
    if other is not None:
        try:
            starts(other)
        except ValueError:
            remedy = "give another one" if validate is not None else "give --holdout 0 or --validate"
            raise InputError(
                f"{validate or logs[0]}: nothing is long enough to be predicted {max(HORIZONS):g} s ahead; {remedy}."
            ) from None
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    sigma = np.full(12, FIRST_SIGMA)
    problem = ShootingProblem(
        model, recorded.fitted, sigma=sigma, channels="rates", method="rk4", windows=recorded.windows
    )
    there = ~np.isnan(np.asarray(problem.measured()))
    measured, unknowns = there.sum(), len(model.parameter_names) + problem.windows * problem.free_size
    if measured <= unknowns:
        raise InputError(
            f"{logs[0]}: {measured} measurements are too few for windows of {part.window:g} s; use longer."
        )
    dense = there.size * unknowns * 8 / 2**30
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
            predicted, compared = _validate(fit, model, other, same=validate is None)
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
            "tested_seconds": seconds,
            "loss": "huber" if huber else "squares",
            "notes": list(notes),
        },
    }
    return report, predicted


def _other_log(logs: list[Path], validate: Path, recorded: Recorded, model: FlightModel, part: Part) -> Recorded:
    """The log that is predicted, sampled like those that are fitted, once it is known to serve."""
    if any(validate.exists() and log.samefile(validate) for log in logs):
        raise InputError(f"--validate {validate}: is fitted; leave it out: a part of the flight is held out by itself.")
    alike = part._replace(begin=None, end=None, holdout=0.0, sample=float(recorded.fitted.dt))
    found = load_logs([validate], model.airframe, alike)
    lacks = [term for term in model.terms if term != "accelerometer" and not _able(found).get(term, True)]
    if lacks:
        raise InputError(f"--validate {validate}: {lacks[0]} needs what it did not measure; give --terms without it.")
    return found


def _able(recorded: Recorded) -> dict[str, bool]:
    """Of the terms that need more than rates, which have it in every log."""
    ax, ay, az = recorded.force_axes
    velocity = recorded.fitted.body_velocity is not None
    return {"flapping": ax and ay, "velocity": velocity, "drag": velocity and ax and ay, "accelerometer": az}


def _terms(asked: str | None, recorded: Recorded, airframe: Airframe) -> tuple[str, ...]:
    """The terms asked for, or those that what was measured allows."""
    able, flight = _able(recorded), recorded.fitted
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


def _method(estimator: str):
    if estimator == "ibss":
        return None
    return OutputError() if estimator == "output-error" else _hybrid


def _hybrid(problem: ShootingProblem, bracket: Bracket) -> Estimate:
    """A network for these inputs, trained now, and shooting from its answer."""
    training = NetworkEstimator(steps=_SEED_STEPS, batch=_SEED_BATCH, noise=(1.0, 1.0), held_out=1000)
    return Hybrid(training.fit(problem, bracket, key=jax.random.key(0)))(problem, bracket)


def _validate(fit: VehicleFit, model: FlightModel, flight: Flight, *, same: bool) -> tuple[Predictions, dict[str, Any]]:
    """How far ahead the rates of a flight that was not fitted are predicted, and how regression does with the terms.

    `same`: whether it is part of the logs that were fitted, with their offsets.
    """

    def scored(parameters: Array) -> tuple[Predictions, Skill]:
        problem = eqx.tree_at(lambda p: p.flight, fit.problem, flight)
        if not same:
            problem, parameters = _another(fit, model, parameters, flight)
        predicted = predictions(problem, parameters)
        return predicted, skill(predicted)

    predicted, worth = scored(fit.estimate.parameters)
    _, theirs = scored(_regressed(fit.problem, fit.estimate.parameters))
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


def _another(fit: VehicleFit, model: FlightModel, parameters: Array, flight: Flight) -> tuple[ShootingProblem, Array]:
    """The vehicle on another flight: of what each recording has its own, the mean."""
    names, found = fit.problem.model.parameter_names, np.asarray(parameters).tolist()
    values = dict(zip(names, found, strict=True)) | {name: value for name, (value, _) in fit.held.items()}
    stretches = 1 if flight.stretch is None else int(flight.stretch.max()) + 1
    other = FlightModel(model.airframe, terms=model.terms, recordings=(0,) * stretches)
    recordings = range(1, max(model.recordings) + 2)
    means = [
        values[name] if name in values else float(np.mean([values[f"{name}_{i}"] for i in recordings]))
        for name in other.parameter_names
    ]
    problem = ShootingProblem(other, flight, sigma=fit.problem.sigma, channels="rates", method="rk4")
    return problem, jnp.asarray(means)


@eqx.filter_jit
def _regressed(problem: ShootingProblem, found: Array) -> Array:
    """What regression with the terms finds, told what it cannot find: lag, delay and thrust curve."""
    names = problem.model.parameter_names
    known = {names[i]: found[i] for i in problem.model.forcing_parameters}
    if not known:
        return EquationError(memory=_MEMORY).solution(problem, Bracket.default(problem.model))
    linear = hold(problem.model, known)
    problem = eqx.tree_at(lambda p: p.model, problem, linear)
    return linear.complete(EquationError(memory=_MEMORY).solution(problem, Bracket.default(linear)))


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
            "note": "; ".join(notes) if told else "not identifiable from these flights",
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
    told, thrust = {}, "thrust_coefficient" if gain is None else "mass"
    notes = dict.fromkeys(("Ix", "Iy"), f"if arms and {thrust} are right") | {"Iz": f"if {thrust} and drag are right"}
    for name, axis in _TORQUES.items():
        if PARAMETER_NAMES[axis] in names and whole[axis] > 0:
            std = float(np.sqrt(covariance[axis, axis])) / whole[axis] ** 2
            told[name] = {"estimate": 1 / float(whole[axis]), "std": std, "unit": "kg m^2", "note": notes[name]}
    # What is held is no evidence for or against a rigid body.
    if not set(PARAMETER_NAMES) <= set(names):
        return told
    rigid = fit_inertia(CorrectedOS4(model.airframe), jnp.asarray(whole), jnp.asarray(covariance))
    return {**told, "consistency_p": float(rigid.p_value), "rigid_body": bool(rigid.is_rigid_body)}
