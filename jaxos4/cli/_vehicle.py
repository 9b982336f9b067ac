"""`jaxos4 estimate --model flight`: a real vehicle from one log or several, checked on what was not fitted."""

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from ..airframe import Airframe, load_airframe
from ..bracket import Bracket
from ..dynamics import CASCADE_ORDER, PARAMETER_NAMES, CorrectedOS4
from ..errors import InputError
from ..estimators import EquationError, Estimate, Hybrid, NetworkEstimator, OutputError
from ..flight import Flight, join
from ..flight_model import TERMS, FlightModel, with_body_velocity
from ..held import hold
from ..inertia import fit_inertia
from ..logs import averaged, cut, read_log, stretches
from ..logs.stretches import Stretch
from ..results import result_names
from ..shooting import ShootingProblem
from ..validation import Predictions, Skill, predictions, skill
from ..vehicle import VehicleFit, fit_vehicle
from ._bracket_file import load_bracket
from ._json import finite

# [s] of a window, and of a sample where a log has more: no quadrotor turns faster than these tell.
WINDOW, SAMPLE = 0.25, 0.004
# The share that is held out, where no other flight is there to be predicted.
HOLDOUT = 0.25
# What is held out comes in blocks of this length [s], so that every part of a flight is in both.
BLOCK = 5.0
# Where the search for the noise levels begins [rad/s]: more the model's errors than the sensor's.
FIRST_SIGMA = 0.5
# How a network is trained that only has to say where to look in flights cut into windows.
_SEED_STEPS, _SEED_BATCH = 500, 64
_MOST_PARTS = 3


class Recorded(NamedTuple):
    """Logs, ready to be fitted.

    - `fitted`, `tested`: one flight each, of all stretches; NaN where the other has its part. `None`: nothing held out.
    - `recordings`: the log that each stretch is from.
    - `seconds`: fitted, and tested.
    """

    fitted: Flight
    tested: Flight | None
    recordings: tuple[int, ...]
    seconds: tuple[float, float]
    notes: tuple[str, ...]


class Part(NamedTuple):
    """What of the logs is used: from and to [s], window and sample [s], the share that is held out."""

    begin: float | None
    end: float | None
    window: float
    sample: float | None
    holdout: float


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
) -> tuple[dict[str, Any], VehicleFit, Predictions | None]:
    """The report, the fit, and the predictions over what was held out. Raises `InputError` for what cannot be used."""
    if estimator not in ("ibss", "hybrid", "output-error"):
        raise InputError(f"--estimator {estimator}: a flight model is shot; use ibss, hybrid or output-error.")
    _check(part)
    begin = time.perf_counter()
    vehicle = load_airframe(airframe)
    recorded = load_logs(logs, vehicle, part)
    model = FlightModel(vehicle, terms=_terms(terms, recorded.fitted), recordings=recorded.recordings)
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
    return report, fit, predicted


def load_logs(paths: list[Path], airframe: Airframe, part: Part) -> Recorded:
    """Several logs as one flight of stretches that can be used, cut into whole windows."""
    notes: list[str] = []
    parts: list[tuple[int, Flight]] = []
    for number, path in enumerate(paths):
        flight, said = read_log(path, airframe)
        notes += [f"{path}: {note}" for note in said]
        if np.isnan(np.asarray(flight.states)[:, CASCADE_ORDER[:3]]).all(axis=0).any():
            raise InputError(f"{path}: a flight model needs p, q and r; log the gyro.")
        pieces, note = _pieces(path, flight, airframe, part)
        notes += [] if note is None else [f"{path}: {note}"]
        parts += [(number, piece) for piece in pieces]
    step = max(SAMPLE, *(float(flight.dt) for _, flight in parts)) if part.sample is None else part.sample
    length = round(part.window / step)
    if length < 4:
        raise InputError(f"--window {part.window:g}: less than four samples of {step:g} s; give at least {4 * step:g}.")
    even = [(number, _evened(paths[number], flight, step)) for number, flight in parts]
    kept = [(number, flight) for number, flight in even if flight.time.shape[0] >= length]
    if not kept:
        raise InputError(f"{paths[0]}: no part is as long as --window {part.window:g}; give a shorter one.")
    numbers = sorted({number for number, _ in kept})
    lost = [paths[number] for number in range(len(paths)) if number not in numbers]
    if lost:
        raise InputError(
            f"{lost[0]}: no part is as long as --window {part.window:g}; leave it out or give a shorter one."
        )
    together = join([flight for _, flight in kept], length=length)
    fitted, tested = _held_out(together, length, part.holdout)
    seconds = tuple(0.0 if f is None else float((~jnp.isnan(f.states[:, 7])).sum() * f.dt) for f in (fitted, tested))
    return Recorded(fitted, tested, tuple(number for number, _ in kept), (seconds[0], seconds[1]), tuple(notes))


def _pieces(path: Path, flight: Flight, airframe: Airframe, part: Part) -> tuple[list[Flight], str | None]:
    """The stretches that can be used, or what `--from` and `--to` say, and what is told of it."""
    first, last = float(flight.time[0]), float(flight.time[-1])
    if part.begin is not None or part.end is not None:
        asked = Stretch(first if part.begin is None else part.begin, last if part.end is None else part.end)
        try:
            return [cut(flight, asked)], None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    every = stretches(flight, airframe)
    usable = [each for each in every if not each.reason]
    refused = [each for each in every if each.reason]
    if not usable:
        why = max(refused, key=lambda each: each.length)
        raise InputError(
            f"{path}: no stretch of it can be used (from {why.begin:.1f} s to {why.end:.1f} s: {why.reason}); say "
            "--from and --to to use one all the same."
        )
    if not refused:
        return [flight], None
    longest = sorted(refused, key=lambda each: -each.length)[:_MOST_PARTS]
    told = "; ".join(f"{each.begin:.1f} to {each.end:.1f} s: {each.reason}" for each in longest)
    seconds = sum(each.length for each in usable)
    return [cut(flight, each) for each in usable], (
        f"{seconds:.1f} of {last - first:.1f} s are used, in {len(usable)} stretches; not used: {told}"
        f"{'; ...' if len(refused) > _MOST_PARTS else ''} (--from and --to override)"
    )


def _evened(path: Path, flight: Flight, step: float) -> Flight:
    if float(flight.dt) > step * 1.01:
        raise InputError(f"{path}: --sample-time {step:g}: it has a sample every {float(flight.dt):.4g} s only.")
    return with_body_velocity(averaged(flight, step))


def _held_out(flight: Flight, length: int, share: float) -> tuple[Flight, Flight | None]:
    """The flight without the measurements of every so many blocks of whole windows, and with those alone."""
    if not share:
        return flight, None
    windows = flight.time.shape[0] // length
    period = round(1 / share)
    block = max(min(round(BLOCK / (length * float(flight.dt))), windows // (2 * period)), 1)
    aside = np.repeat((np.arange(windows) // block) % period == period - 1, length)
    if not aside.any() or aside.all():
        return flight, None

    def without(where: np.ndarray, flight: Flight, *, force: bool) -> Flight:
        blank = eqx.tree_at(lambda f: f.states, flight, jnp.where(where[:, None], jnp.nan, flight.states))
        if not force or flight.specific_force is None:
            return blank
        return eqx.tree_at(lambda f: f.specific_force, blank, jnp.where(where[:, None], jnp.nan, flight.specific_force))

    return without(aside, flight, force=True), without(~aside, flight, force=False)


def _check(part: Part) -> None:
    if not (math.isfinite(part.window) and part.window > 0):
        raise InputError(f"--window: must be a positive number of seconds, got {part.window:g}.")
    if part.sample is not None and not (math.isfinite(part.sample) and part.sample > 0):
        raise InputError(f"--sample-time: must be a positive number of seconds, got {part.sample:g}.")
    if not 0 <= part.holdout <= 0.5:
        raise InputError(f"--holdout: must be a share from 0 to 0.5, got {part.holdout:g}.")
    if part.begin is not None and part.end is not None and not part.begin < part.end:
        raise InputError(f"--from {part.begin:g} --to {part.end:g}: must be in this order.")


def _terms(asked: str | None, flight: Flight) -> tuple[str, ...]:
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
        chosen += ["accelerometer"] if able["accelerometer"] else []
        return tuple(term for term in TERMS if term in chosen)
    names = [name.strip() for name in asked.split(",") if name.strip()]
    for name in names:
        if name not in TERMS:
            raise InputError(f"--terms: knows no `{name[:40]}`; the terms are {', '.join(TERMS)}.")
        if not able.get(name, True):
            raise InputError(f"--terms: {name} needs what these logs did not measure; leave it out.")
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

    def scored(problem: ShootingProblem, parameters) -> tuple[Predictions, Skill]:
        try:
            predicted = predictions(eqx.tree_at(lambda p: p.flight, problem, flight), parameters)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
        return predicted, skill(predicted)

    predicted, worth = scored(fit.problem, fit.estimate.parameters)
    model, names = fit.problem.model, fit.problem.model.parameter_names
    found = dict(zip(names, np.asarray(fit.estimate.parameters).tolist(), strict=True))
    known = [name for name in ("rotor_lag", "rotor_delay", "thrust_curve") if name in names]
    linear = eqx.tree_at(lambda p: p.model, fit.problem, hold(model, {n: found[n] for n in known}) if known else model)
    regressed = EquationError(memory=0.0)(linear, Bracket.default(linear.model))
    _, theirs = scored(linear, regressed.parameters)
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
    """Ix, Iy, Iz of the rigid body that explains the alphas that are told."""
    names = fit.problem.model.parameter_names
    whole = np.asarray(bracket.center)[:8].copy()
    covariance = np.diag((1e3 * np.asarray(bracket.half_width)[:8]) ** 2)
    alphas = [name for name in PARAMETER_NAMES if name in names]
    to = [PARAMETER_NAMES.index(name) for name in alphas]
    of = [names.index(name) for name in alphas]
    whole[to] = np.asarray(fit.estimate.parameters)[of]
    covariance[np.ix_(to, to)] = np.asarray(fit.estimate.covariance)[np.ix_(of, of)]
    told = {}
    for name, axis in (("Ix", 2), ("Iy", 5), ("Iz", 7)):
        if PARAMETER_NAMES[axis] in names and whole[axis] > 0:
            std = float(np.sqrt(covariance[axis, axis])) / whole[axis] ** 2
            told[name] = {"estimate": 1 / float(whole[axis]), "std": std, "unit": "kg m^2"}
    rigid = fit_inertia(CorrectedOS4(model.airframe), jnp.asarray(whole), jnp.asarray(covariance))
    return {**told, "consistency_p": float(rigid.p_value), "rigid_body": bool(rigid.is_rigid_body)}
