"""Identification of an OS4 model from one flight."""

import time
from collections.abc import Callable

import numpy as np

from ..analysis.identifiability import identifiability_of
from ..bracket import Bracket
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..estimators import Hybrid, make_estimator
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER
from ..networks import TrainedNetwork
from ..recording.reading import Recording
from ..results import result_names
from ..shooting import ShootingProblem
from .constants import flight_constants
from .flight_fit import FlightFit, fit_flight
from .network import GivenNetwork, loaded, network_for, network_provenance
from .parameters import parameter_table
from .problem import Intervals, bracket_of, flight_problem
from .provenance import airframe_name, class_name, name_and_class, shooting_names, versions
from .quality import channel_fits, validate_on
from .results import FlightIdentification, ParameterEstimate, RigidBody, finite_or_none, has_answer


def identify_flight(
    recording: Recording,
    model: AbstractModel,
    *,
    estimator: str | AbstractEstimator,
    bracket: Intervals,
    channels: str | None,
    initial_state: str,
    window: float | None,
    network: GivenNetwork,
    seed: int,
    validate: Recording | None,
    progress: Callable[[str], None],
) -> FlightIdentification:
    """What `jaxos4.identify` does with a model in alpha_1..8. The arguments are the same."""
    name, kind = name_and_class(estimator)
    _check_options(name, kind, channels, window, network)
    if network is not None and not isinstance(estimator, str):
        raise InputError(f"`network`: this {name} estimator has one already; leave it out.")
    own = estimator.network if isinstance(estimator, Hybrid) else estimator
    trained = own if isinstance(own, TrainedNetwork) else loaded(network)
    if trained is not None and not kind.shoots and bracket is not None:
        raise InputError("`bracket`: a network searches the bracket that it was trained in; leave one of them out.")
    where, shooting = bracket_of(bracket, model), {"initial_state": initial_state, "window": window}
    problem = flight_problem(recording, model, channels=channels, **shooting)
    other = None if validate is None else flight_problem(validate, model, **shooting)
    begin = time.perf_counter()
    if _has_own_channels(kind):
        problem = _restricted(problem, kind.looks_at, name, recording)
    if kind.needs_network and trained is None:
        progress("training a network for this flight")
        trained = network_for(problem, where, recording.name, shoots=kind.shoots, seed=seed)
    method = make_estimator(estimator, trained) if isinstance(estimator, str) else estimator
    if trained is not None:
        _check_match(trained, problem, recording)
        if not kind.shoots:
            problem, where = problem.restrict(trained.channels), trained.bracket
    if validate is not None and other is not None:
        other = _comparable(other, problem, validate)
    fit = fit_flight(method, problem, where, progress=progress)
    seconds, problem, estimate = time.perf_counter() - begin, fit.problem, fit.estimate
    validation, notes = None, list(recording.notes)
    if validate is not None and other is not None:
        notes += validate.named_notes
        validation = validate_on(problem, estimate, other, validate.name) if has_answer(estimate) else None
    return FlightIdentification(
        estimator=name,
        model=class_name(model, MODELS),
        result=str(result_names(estimate.result)),
        rollouts=fit.rollouts,
        cost=finite_or_none(estimate.cost),
        seconds=seconds,
        parameters=_parameters(fit, where, kind.prior),
        rigid_body=flight_constants(model, estimate) if has_answer(estimate) else RigidBody(),
        fit={} if fit.diagnostics is None else channel_fits(problem, fit.diagnostics),
        validation=validation,
        provenance={
            "flight": recording.name,
            "airframe": airframe_name(model.airframe),
            "channels": problem.channels,
            "initial_state": initial_state,
            "windows": problem.windows,
            "samples": int(problem.flight.time.shape[0]),
            "sample_time": float(problem.flight.dt),
            "notes": notes,
            **({} if trained is None else {"network": network_provenance(network, trained)}),
            **versions(problem),
        },
        estimate=estimate,
        problem=problem,
    )


def _restricted(problem: ShootingProblem, channels: str, name: str, recording: Recording) -> ShootingProblem:
    """The problem on the channels that an estimator looks at."""
    problem = problem.restrict(channels)
    if np.isnan(np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]).all(axis=0).any():
        raise InputError(f"{recording.name}: {name} needs p, q and r; use `estimator` output-error.")
    return problem


def _check_match(network: TrainedNetwork, problem: ShootingProblem, recording: Recording) -> None:
    mismatch = network.mismatch(problem)
    if mismatch is not None:
        raise InputError(f"`network`: cannot be used on {recording.name}: {mismatch}; train one with `jaxos4 train`.")


def _comparable(other: ShootingProblem, problem: ShootingProblem, validate: Recording) -> ShootingProblem:
    """The other flight's problem on the same channels."""
    other = other.restrict(problem.channels) if other.size > problem.size else other
    if np.isnan(other.recorded()).all():
        raise InputError(
            f"{validate.name}: nothing was measured among the {problem.channels} channels; give another flight."
        )
    return other


def _check_options(
    name: str, kind: type[AbstractEstimator], channels: str | None, window: float | None, network: GivenNetwork
) -> None:
    if network is not None and not kind.needs_network:
        raise InputError(f"`network`: {name} uses none; use `estimator` network or hybrid, or leave it out.")
    if window is not None and not (kind.shoots or kind.needs_network):
        raise InputError(f"`window`: {name} does not shoot; use one of the estimators {shooting_names()}.")
    if window is not None and network is not None:
        raise InputError("`window`: a network of windows serves one flight alone; leave `network` out.")
    if _has_own_channels(kind) and channels not in (None, kind.looks_at):
        raise InputError(f"`channels` {channels}: {name} looks at the {kind.looks_at}; use `estimator` output-error.")


def _has_own_channels(kind: type[AbstractEstimator]) -> bool:
    return kind.looks_at != "all" and not kind.needs_network


def _parameters(fit: FlightFit, bracket: Bracket, prior: float) -> dict[str, ParameterEstimate]:
    estimate, names = fit.estimate, fit.problem.model.parameter_names
    limit, notes, excited = np.full(len(names), np.nan), {}, np.ones(len(names), dtype=bool)
    if fit.evaluation is not None:
        information = identifiability_of(fit.evaluation, bracket)
        limit, notes = information.noise_limit, information.notes(names)
        excited = information.identifiable & information.excited
    return parameter_table(
        fit.problem.model,
        estimate,
        fit.bound,
        bracket,
        prior=prior,
        reason=lambda i: "not identifiable from this flight" if excited[i] else notes[names[i]],
        noise_limit=lambda i: finite_or_none(limit[i]),
    )
