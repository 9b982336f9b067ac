"""`jaxos4 estimate` without `--model flight`: the parameters of an OS4 that one flight tells."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from ..analysis.diagnostics import Diagnostics, residual_diagnostics
from ..analysis.identifiability import Identifiability, identifiability
from ..analysis.inertia import fit_inertia
from ..analysis.sandwich import robust_covariance
from ..bracket import Bracket
from ..errors import InputError
from ..estimate import AbstractEstimator, Estimate, fit_start
from ..estimators import ESTIMATORS, IBSS, Hybrid
from ..flight import STATE_NAMES, STATE_UNITS
from ..identification.quality import COLOURED
from ..identification.vehicle import NO_ANSWER
from ..logs import read_flight_and_notes
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..models.state import CASCADE_ORDER
from ..networks import NetworkEstimator, TrainedNetwork, load_network
from ..results import result_names
from ..shooting import ShootingProblem
from ._choices import Channels, Estimator, InitialState, Model
from ._fitting import fit, fit_network, load_job, problem_of, seen_channels
from ._json import finite

# How long a network is trained that only has to say where to look.
SEED_STEPS = 2000
# How far apart correlations of residuals are looked at, in samples.
LAGS = 25


def identify_flight(
    console: Console,
    flight: Path,
    estimator: Estimator,
    model: Model,
    airframe: str,
    *,
    bracket: Path | None,
    channels: Channels | None,
    initial_state: InitialState,
    window: float | None,
    network: Path | None,
    validate: Path | None,
) -> dict[str, Any]:
    """The report. Raises `InputError` for what cannot be used."""
    kind = ESTIMATORS[estimator]
    learned, rates_only = kind.needs_network, kind.looks_at == "rates" and not kind.needs_network
    if network is not None and not learned:
        raise InputError(f"--network: {estimator.value} uses none; say --estimator network or hybrid, or leave it out.")
    if network is not None and estimator == "network" and bracket is not None:
        raise InputError("--bracket: the network looks in the bracket that it was trained in; leave one of them out.")
    if rates_only and channels not in (None, "rates"):
        raise InputError(f"--channels {channels}: {estimator} looks at the rates; use --estimator output-error.")
    if window is not None and not (kind.shoots or learned):
        raise InputError(f"--window: {estimator} does not shoot; use --estimator ibss, hybrid or output-error.")
    if window is not None and network is not None:
        raise InputError("--window: a network of windows serves one flight alone; leave --network out.")
    trained = None if network is None else load_network(network)
    problem, where, notes = load_job(flight, model, airframe, bracket, channels, initial_state, window)
    other = None
    if validate is not None:
        known = problem.initial_state is not None
        recorded, said = read_flight_and_notes(validate, problem.model.airframe)
        other = problem_of(validate, problem.model, recorded, None, known=known, window=window)
        notes += tuple(f"{validate}: {note}" for note in said)
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)

    begin = time.perf_counter()
    method: AbstractEstimator = IBSS() if learned else kind()
    if rates_only:
        if np.isnan(np.asarray(problem.restrict("rates").flight.states)[:, CASCADE_ORDER[:3]]).all(axis=0).any():
            raise InputError(f"{flight}: {estimator} needs p, q and r; use --estimator output-error.")
        problem = problem.restrict("rates")
    if learned:
        if trained is None:
            steps = SEED_STEPS if estimator == "hybrid" else NetworkEstimator.steps
            training = NetworkEstimator(channels=seen_channels(problem), steps=steps)
            console.print(f"note: training a network for this flight, {training.steps} steps", highlight=False)
            trained = fit_network(training, flight, problem, where, seed=0)
        different = trained.mismatch(problem)
        if different is not None:
            raise InputError(
                f"{network or 'the network'}: cannot be used on {flight}: {different}; train one with `jaxos4 train`."
            )
        if estimator == "hybrid":
            method = Hybrid(trained)
        else:
            method, problem, where = trained, problem.restrict(trained.channels), trained.bracket
    if other is not None:
        other = other.restrict(problem.channels) if other.size > problem.size else other
        if np.isnan(np.asarray(other.measured())).all():
            raise InputError(f"{validate}: nothing to compare was measured among the {problem.channels} channels.")
    problem, found, bound, rollouts = fit(method, problem, where, shoots=kind.shoots)
    name = str(result_names(found.result))
    answered = name not in NO_ANSWER
    left = None
    if answered:
        left = _diagnostics(problem, found.parameters, found.initial_state, fitted=True)
        if kind.shoots and (left.colour > COLOURED).any():
            robust = robust_covariance(problem, found.parameters, found.initial_state)
            found = eqx.tree_at(lambda e: e.covariance, found, robust)
    seconds = time.perf_counter() - begin

    return {
        "estimator": estimator.value,
        "model": model.value,
        "result": name,
        "rollouts": rollouts,
        "cost": finite(found.cost),
        "seconds": seconds,
        "parameters": _parameters(problem, where, found, bound, prior=kind.prior),
        "constants": _constants(problem.model, found) if answered else {},
        "fit": {} if left is None else _quality(problem, left),
        "validation": None if other is None or not answered else _validation(problem, found, other, validate),
        "provenance": {
            "flight": str(flight),
            "airframe": airframe,
            "channels": problem.channels,
            "initial_state": initial_state.value,
            "windows": problem.windows,
            "samples": int(problem.flight.time.shape[0]),
            "sample_time": float(problem.flight.dt),
            "notes": list(notes),
            **({} if trained is None else {"network": _network_provenance(network, trained)}),
        },
    }


def _parameters(
    problem: ShootingProblem,
    bracket: Bracket,
    found: Estimate,
    bound: Float[Array, " parameters"],
    *,
    prior: float,
) -> dict[str, dict[str, Any]]:
    identified = np.asarray(bracket.identifies(found.std, prior))
    table, half_width, model = {}, np.asarray(found.half_width(0.95)), problem.model
    known = None
    if str(result_names(found.result)) not in NO_ANSWER:
        known = identifiability(problem, bracket, found.parameters, found.initial_state)
    for i, (name, unit) in enumerate(zip(model.parameter_names, model.parameter_units, strict=True)):
        value, std = float(found.parameters[i]), float(found.std[i])
        lower, upper = float(bracket.lower[i]), float(bracket.upper[i])
        told = bool(identified[i])
        table[name] = {
            "estimate": value if told else None,
            "std": finite(std),
            "bound": finite(bound[i]),
            "ci95": [value - half_width[i], value + half_width[i]] if told else None,
            "unit": unit,
            "noise_limit": None if known is None else finite(known.noise_limit[i]),
            "note": _note(found, i, half_width[i], lower, upper) if told else _why_not_identifiable(known, name, model),
        }
    return table


def _why_not_identifiable(known: Identifiability | None, name: str, model: AbstractModel) -> str:
    reasons = {} if known is None else known.reasons(model.parameter_names)
    return f"not identifiable: {reasons[name]}" if name in reasons else "not identifiable from this flight"


def _note(found: Estimate, i: int, half_width: float, lower: float, upper: float) -> str:
    notes, value = [], float(found.parameters[i])
    if abs(value) < half_width:
        notes.append("below noise")
    if not lower <= value <= upper:
        notes.append("outside its bracket")
    if found.seed is not None and not found.seed.lower[i] <= value <= found.seed.upper[i]:
        notes.append("missed by the network, found beyond")
    return "; ".join(notes)


def _constants(model: AbstractModel, found: Estimate) -> dict[str, Any]:
    """Ix, Iy, Iz, J_R of the rigid body that explains the alphas best; empty if they are not identifiable."""
    if model.parameter_names != PARAMETER_NAMES:
        return {}
    rigid = fit_inertia(model, found.parameters, found.covariance)
    inertias = np.asarray(rigid.constants), np.asarray(rigid.std)
    if not np.isfinite(inertias[1]).all() or (inertias[1] > np.abs(inertias[0]))[:3].any():
        return {}
    return {
        **{
            name: {"estimate": float(value), "std": float(std), "unit": "kg m^2"}
            for name, value, std in zip(("Ix", "Iy", "Iz", "J_R"), *inertias, strict=True)
        },
        "consistency_p": float(rigid.p_value),
        "rigid_body": bool(rigid.is_rigid_body),
    }


def _diagnostics(problem: ShootingProblem, parameters: Array, initial_state: Array, *, fitted: bool) -> Diagnostics:
    lags = min(LAGS, problem.flight.states.shape[0] // 2)
    return residual_diagnostics(problem, parameters, initial_state, fitted=fitted, lags=lags)


def _quality(problem: ShootingProblem, left: Diagnostics) -> dict[str, dict[str, Any]]:
    return {
        STATE_NAMES[column]: {
            "rms": float(left.rms[i]),
            "unit": STATE_UNITS[column],
            "percent": finite(left.percent[i]),
            "level": float(left.level[i]),
            "level_p": float(left.level_p[i]),
            "correlation": float(left.colour[i]),
            "white_p": float(left.white_p[i]),
            "input_correlation": dict(zip(("roll", "pitch", "yaw"), left.input_correlation[i].tolist(), strict=True)),
            "input_p": float(left.input_p[i]),
        }
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if left.count[i] > 2
    }


def _validation(problem: ShootingProblem, found: Estimate, other: ShootingProblem, path: Path | None) -> dict[str, Any]:
    """How the parameters predict another flight, of which only the initial state is fitted."""
    other = eqx.tree_at(lambda p: p.sigma, other, problem.sigma)
    start, cost, sound, _ = eqx.filter_jit(fit_start)(other, found.parameters)
    told = bool(sound)
    left = _diagnostics(other, found.parameters, start, fitted=False) if told else None
    return {
        "flight": str(path),
        "cost": finite(cost) if told else None,
        "fit": None if left is None else _quality(other, left),
    }


def _network_provenance(path: Path | None, network: TrainedNetwork) -> dict[str, Any]:
    settings = {field.name: getattr(network.settings, field.name) for field in dataclasses.fields(network.settings)}
    bracket = {"lower": network.bracket.lower.tolist(), "upper": network.bracket.upper.tolist()}
    return {"file": None if path is None else str(path), "settings": settings, "bracket": bracket}
