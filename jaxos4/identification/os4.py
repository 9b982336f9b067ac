"""Identification of an OS4: prepare one flight, estimate parameters and sensor noise, and judge the answer."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import msgspec
import numpy as np

from .._custom_types import as_float, finite_or_none
from ..airframe import INERTIAS, MOTIONS
from ..analysis.diagnostics import Diagnostics, residual_correlations, residual_diagnostics
from ..analysis.evaluation import evaluate, robust_covariance
from ..analysis.identifiability import identifiability
from ..analysis.inertia import fit_inertia
from ..analysis.traces import os4_traces
from ..errors import InputError
from ..estimate import AbstractEstimator, Estimate, fit_start
from ..estimators import ESTIMATORS, Hybrid, make_estimator
from ..flight import STATE_NAMES, STATE_UNITS
from ..logs import Recording
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER
from ..networks import TrainedNetwork
from ..networks.estimator import GivenNetwork, network_for, network_provenance
from ..networks.file import load_network
from ..recording.checks import KINEMATIC, self_checks
from ..results import has_answer, result_names
from ..shooting import ShootingProblem, padded
from .answers import UNIT, Answer, OS4Answer, parameter_table, shared_fields
from .data import (
    Clock,
    Data,
    HeldOut,
    Progress,
    Provenance,
    airframe_name,
    class_name,
    name_and_class,
    silent,
    versions,
)
from .issues import issues_of_log, issues_of_os4
from .problem import Intervals, OS4Settings, bracket_of, os4_problem
from .quantities import os4_quantities
from .results import COLOURED, ChannelFit, Constant, OS4Identification, ParameterEstimate, RigidBody, Validation
from .verdict import CONTRADICTED, judge, result_of

MAX_PASSES = 3  # that estimate noise levels from residuals, before the last estimate
SETTLED = 0.2  # relative change of a noise level that ends the passes; such weights cost under 1 % of the efficiency


def prepare_os4(
    recordings: Sequence[Recording],
    model: AbstractModel,
    settings: OS4Settings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
    seed: int,
    progress: Progress,
) -> tuple[Data[ShootingProblem], str, AbstractEstimator]:
    """The data of one flight, and the name and object of its estimator. Arguments as in `identify`."""
    recording, *others = recordings
    if others:
        raise InputError(
            f"{others[0].name}: the {class_name(model, MODELS)} model explains one flight; several need an airframe "
            "and the model flight."
        )
    estimator = "ibss" if estimator is None else estimator
    name, kind = name_and_class(estimator)
    trained = _given_network(estimator, settings, network)
    if trained is not None and not kind.shoots and bracket is not None:
        raise InputError("`bracket`: a network searches the bracket that it was trained in; leave one of them out.")
    where = bracket_of(bracket, model)
    problem = os4_problem(recording, model, where, settings)
    other = None
    if validate is not None:
        other = os4_problem(validate, model, where, dataclasses.replace(settings, channels=None))
    if _has_own_channels(kind):
        problem = problem.restrict(kind.looks_at)
        if np.isnan(np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]).all(axis=0).any():
            raise InputError(f"{recording.name}: {name} needs p, q and r; use `estimator` output-error.")
    if kind.needs_network and trained is None:
        progress("training a network for this flight")
        trained = network_for(problem, where, recording.name, shoots=kind.shoots, seed=seed)
    if trained is not None:
        if mismatch := trained.mismatch(problem):
            raise InputError(
                f"`network`: cannot be used on {recording.name}: {mismatch}; train one with `jaxos4 train`."
            )
        if not kind.shoots:
            problem = problem.restrict(trained.channels).within(trained.bracket)
    notes, held_out = recording.notes, None
    if validate is not None and other is not None:
        other = other.restrict(problem.channels) if other.size > problem.size else other
        if np.isnan(other.recorded()).all():
            raise InputError(
                f"{validate.name}: nothing was measured among the {problem.channels} channels; give another flight."
            )
        held_out, notes = HeldOut(other, validate.name), notes + validate.named_notes
    provenance = Provenance(
        flight=recording.name,
        airframe=airframe_name(model.airframe),
        channels=problem.channels,
        initial_state=settings.initial_state,
        windows=problem.windows,
        samples=int(problem.flight.time.shape[0]),
        sample_time=float(problem.flight.dt),
        network=msgspec.UNSET if trained is None else network_provenance(network, trained),
        notes=list(notes),
        **versions(problem),
    )
    findings = self_checks(recording, model.airframe, checks=KINEMATIC)
    data = Data(problem, problem, Clock(), provenance, held_out=held_out, findings=findings)
    return data, name, estimator if isinstance(estimator, AbstractEstimator) else make_estimator(name, trained)


def _given_network(
    estimator: str | AbstractEstimator, settings: OS4Settings, network: GivenNetwork
) -> TrainedNetwork | None:
    """The network that an estimator has or was given. Raises `InputError` for options that do not fit the estimator."""
    name, kind = name_and_class(estimator)
    if network is not None and not kind.needs_network:
        raise InputError(f"`network`: {name} uses none; use `estimator` network or hybrid, or leave it out.")
    if settings.window is not None and not (kind.shoots or kind.needs_network):
        shooting = ", ".join(each for each, other in ESTIMATORS.items() if other.shoots)
        raise InputError(f"`window`: {name} does not shoot; use one of the estimators {shooting}.")
    if settings.window is not None and network is not None:
        raise InputError("`window`: a network of windows serves one flight alone; leave `network` out.")
    if _has_own_channels(kind) and settings.channels not in (None, kind.looks_at):
        raise InputError(
            f"`channels` {settings.channels}: {name} looks at the {kind.looks_at}; use `estimator` output-error."
        )
    if network is not None and not isinstance(estimator, str):
        raise InputError(f"`network`: this {name} estimator has one already; leave it out.")
    trained = estimator.network if isinstance(estimator, Hybrid) else estimator
    if isinstance(trained, TrainedNetwork):
        return trained
    return network if network is None or isinstance(network, TrainedNetwork) else load_network(network)


def _has_own_channels(kind: type[AbstractEstimator]) -> bool:
    return kind.looks_at != "all" and not kind.needs_network


def fit_os4(estimator: AbstractEstimator, problem: ShootingProblem, *, progress: Progress = silent) -> OS4Answer:
    """Estimate the parameters and the noise levels of one flight.

    The noise levels follow from the residuals, and the fit is repeated with them. The covariance of an estimator that
    shoots is the Cramer-Rao bound, or `robust_covariance` if residuals are coloured. The other estimators give their
    own covariance, and estimate once more with the last noise levels.
    """

    def search(weighted: ShootingProblem, number: int) -> Estimate:
        progress(f"fitting with the noise levels of pass {number}" if number else "compiling and fitting")
        shared = padded(weighted) if estimator.shoots and not estimator.needs_network else weighted
        return jax.block_until_ready(estimator(shared))

    estimates = [search(problem, 0)]
    for number in range(1, MAX_PASSES + 2):
        last, before = estimates[-1], np.asarray(problem.sigma)
        if not has_answer(last.result):
            break
        problem = problem.reweighted(evaluate(problem, last.parameters, last.initial_state).errors)
        settled = (np.abs(np.asarray(problem.sigma) / before - 1) < SETTLED).all()
        failed = estimator.shoots and str(result_names(last.result)) != "successful"
        is_last = settled or failed or number > MAX_PASSES
        if not is_last or not estimator.shoots:
            estimates.append(search(problem, number))
        if is_last:
            break
    estimate, rollouts = estimates[-1], sum(int(each.rollouts) for each in estimates)
    if not has_answer(estimate.result):
        return OS4Answer(problem, estimate, np.full(problem.unknowns.count, np.inf), rollouts)
    evaluation = evaluate(problem, estimate.parameters, estimate.initial_state)
    diagnostics = residual_diagnostics(evaluation)
    bound, covariance = evaluation.covariance, estimate.covariance
    if estimator.shoots:
        covariance = robust_covariance(evaluation) if (diagnostics.colour > COLOURED).any() else bound
    changed = as_float(covariance), as_float(evaluation.cost)
    estimate = eqx.tree_at(lambda e: (e.covariance, e.cost), estimate, changed)
    bounds = np.sqrt(np.diagonal(bound))
    return OS4Answer(problem, estimate, bounds, rollouts, evaluation=evaluation, diagnostics=diagnostics)


def judge_os4(data: Data, answer: OS4Answer, estimator: AbstractEstimator, name: str) -> OS4Identification:
    """The result for an OS4, with rigid body, issues and verdicts. `name`: the estimator's name."""
    search, flown = str(result_names(answer.estimate.result)), answer.evaluation
    found = OS4Identification(
        model=class_name(answer.problem.model, MODELS),
        parameters=_alphas(answer, estimator.prior),
        result=search,
        issues=tuple(issues_of_log(data.findings)),
        **shared_fields(data, answer, name),
    )
    if flown is None or answer.diagnostics is None:
        return found
    errors = np.where(np.isnan(flown.measured), np.nan, flown.errors)[:, : flown.problem.size]
    found = msgspec.structs.replace(
        found,
        rigid_body=_rigid_body(answer),
        fit=_channel_fits(answer.problem, answer.diagnostics),
        validation=None if data.held_out is None else _validate_on(answer, data.held_out),
        traces=os4_traces(flown) if flown.feasible else None,
        correlations=residual_correlations(errors, flown.torques) if flown.feasible else None,
    )
    # The answer of a method that does not shoot is not the best fit, so its residuals are not white.
    issues = issues_of_os4(data, found, found.fit if estimator.shoots else {})
    verdicts = judge(os4_quantities(found.parameters, found.rigid_body), issues)
    # Only the alphas were requested. An alpha that the flight does not show is no fault of the answer.
    wrong = [name for name in found.parameters if verdicts[name].status == CONTRADICTED]
    result = result_of(verdicts, issues, search, wrong if search == "successful" else found.parameters)
    return msgspec.structs.replace(found, verdicts=verdicts, issues=tuple(issues), result=result)


def _alphas(answer: OS4Answer, prior: float) -> dict[str, ParameterEstimate]:
    """The estimate of each alpha, with the noise above which it cannot be distinguished from 0."""
    names, missing, limits = answer.problem.unknowns.names, {}, {}
    if answer.evaluation is not None:
        information = identifiability(answer.evaluation, answer.problem.unknowns.bracket)
        notes, known = information.notes(names), information.identifiable & information.excited
        missing = {name: notes[name] for i, name in enumerate(names) if not known[i] and name in notes}
        limits = {name: finite_or_none(x) for name, x in zip(names, information.noise_limit, strict=True)}
    table = parameter_table(answer, prior, missing)
    return {name: msgspec.structs.replace(row, noise_limit=limits.get(name)) for name, row in table.items()}


def _rigid_body(answer: Answer) -> RigidBody:
    """The moments of inertia that explain the alphas best; none if they are not identifiable."""
    rigid = fit_inertia(answer.problem.model, answer.estimate.parameters, answer.estimate.covariance)
    values, std = np.asarray(rigid.constants), np.asarray(rigid.std)
    if not np.isfinite(std).all() or (std > np.abs(values))[:3].any():
        return RigidBody()
    table = zip((*INERTIAS, "J_R"), values.tolist(), std.tolist(), strict=True)
    constants = {name: Constant(value, error, UNIT) for name, value, error in table}
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))


def _validate_on(answer: Answer, held_out: HeldOut) -> Validation:
    """The fit of the parameters to another flight; only its initial state is estimated."""
    other, name = eqx.tree_at(lambda p: p.sigma, held_out.problem, answer.problem.sigma), held_out.recording or ""
    start, cost, feasible, _ = eqx.filter_jit(fit_start)(padded(other), answer.estimate.parameters)
    if not bool(feasible):
        return Validation(name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, answer.estimate.parameters, start), fitted=False)
    return Validation(name, finite_or_none(cost), _channel_fits(other, diagnostics))


def _channel_fits(problem: ShootingProblem, diagnostics: Diagnostics) -> dict[str, ChannelFit]:
    """The diagnostics of each measured channel, by its name."""
    return {
        STATE_NAMES[column]: ChannelFit(
            rms=float(diagnostics.rms[i]),
            unit=STATE_UNITS[column],
            percent=finite_or_none(diagnostics.percent[i]),
            level=float(diagnostics.level[i]),
            level_p=float(diagnostics.level_p[i]),
            correlation=float(diagnostics.colour[i]),
            white_p=float(diagnostics.white_p[i]),
            input_correlation=dict(zip(MOTIONS, diagnostics.input_correlation[i].tolist(), strict=True)),
            input_p=float(diagnostics.input_p[i]),
        )
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if diagnostics.count[i] > 2
    }
