"""A flight of an OS4: its data, and its parameters with the noise of the sensors that belongs to them."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import msgspec
import numpy as np

from .._custom_types import as_float
from ..analysis.diagnostics import residual_diagnostics
from ..analysis.evaluation import evaluate, robust_covariance
from ..errors import InputError
from ..estimate import AbstractEstimator, Estimate
from ..estimators import ESTIMATORS, Hybrid, make_estimator
from ..logs import Recording
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER
from ..networks import TrainedNetwork
from ..networks.file import load_network
from ..networks.for_flight import GivenNetwork, network_for, network_provenance
from ..recording.checks import KINEMATIC, self_checks
from ..results import result_names
from ..shooting import ShootingProblem, padded
from .answers import Answer, Solution
from .checks import check_os4
from .data import Clock, Data, HeldOut, Progress, Provenance, airframe_name, silent, versions
from .problem import Intervals, bracket_of, os4_problem
from .results import COLOURED, Identification, has_answer
from .settings import FlightSettings, class_name, name_and_class

MAX_PASSES = 3  # in which noise levels are found from residuals, before the last estimate
SETTLED = 0.2  # largest change of a noise level; weights this close to the right ones cost under 1 % of the efficiency


@dataclasses.dataclass(frozen=True)
class OS4Case:
    """A flight of an OS4, and how it is identified.

    - `data`: with the likelihood of a simulation, which has noise of the sensors only.
    - `estimator`, `name`: what searches it. `model`: the name of the equations.
    """

    data: Data[ShootingProblem]
    estimator: AbstractEstimator
    name: str
    model: str

    def solve(self, progress: Progress) -> Solution:
        """The parameters and the noise levels."""
        return Solution(self.data, fit_os4(self.estimator, self.data.likelihood, progress=progress))

    def check(self, solution: Solution, progress: Progress) -> Identification:
        """The estimate of each quantity, and the doubts about it."""
        del progress
        return check_os4(solution.data, solution.answer, self.estimator, self.name, self.model)


def prepare_os4(
    recordings: Sequence[Recording],
    model: AbstractModel,
    settings: FlightSettings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
    seed: int,
    progress: Progress,
) -> OS4Case:
    """A flight of an OS4. Arguments as of `identify`."""
    recording, *others = recordings
    subject = class_name(model, MODELS)
    if others:
        raise InputError(
            f"{others[0].name}: the {subject} model explains one flight; several need an airframe and the model flight."
        )
    name, kind, trained = _method("ibss" if estimator is None else estimator, settings, network)
    if trained is not None and not kind.shoots and bracket is not None:
        raise InputError("`bracket`: a network searches the bracket that it was trained in; leave one of them out.")
    where, shooting = bracket_of(bracket, model), {"initial_state": settings.initial_state, "window": settings.window}
    problem = os4_problem(recording, model, where, channels=settings.channels, **shooting)
    other = None if validate is None else os4_problem(validate, model, where, **shooting)
    if _has_own_channels(kind):
        problem = _restricted(problem, kind.looks_at, name, recording)
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
        held_out = HeldOut(_comparable(other, problem, validate), validate.name)
        notes += validate.named_notes
    samples = int(problem.flight.time.shape[0])
    provenance = Provenance(
        flight=recording.name,
        airframe=airframe_name(model.airframe),
        channels=problem.channels,
        initial_state=settings.initial_state,
        windows=problem.windows,
        samples=samples,
        sample_time=float(problem.flight.dt),
        network=msgspec.UNSET if trained is None else network_provenance(network, trained),
        notes=list(notes),
        **versions(problem),
    )
    findings = self_checks(recording, model.airframe, checks=KINEMATIC)
    data = Data(problem, problem, Clock(), provenance, held_out=held_out, findings=findings)
    method = estimator if isinstance(estimator, AbstractEstimator) else make_estimator(name, trained)
    return OS4Case(data, method, name, subject)


def _method(
    estimator: str | AbstractEstimator, settings: FlightSettings, network: GivenNetwork
) -> tuple[str, type[AbstractEstimator], TrainedNetwork | None]:
    """The name of an estimator, its class, and the network that it has or was given."""
    name, kind = name_and_class(estimator)
    _check_options(name, kind, settings, network)
    if network is not None and not isinstance(estimator, str):
        raise InputError(f"`network`: this {name} estimator has one already; leave it out.")
    trained = estimator.network if isinstance(estimator, Hybrid) else estimator
    if not isinstance(trained, TrainedNetwork):
        trained = network if network is None or isinstance(network, TrainedNetwork) else load_network(network)
    return name, kind, trained


def _restricted(problem: ShootingProblem, channels: str, name: str, recording: Recording) -> ShootingProblem:
    """The problem on the channels that an estimator looks at."""
    problem = problem.restrict(channels)
    if np.isnan(np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]).all(axis=0).any():
        raise InputError(f"{recording.name}: {name} needs p, q and r; use `estimator` output-error.")
    return problem


def _comparable(other: ShootingProblem, problem: ShootingProblem, validate: Recording) -> ShootingProblem:
    """The other flight's problem on the same channels."""
    other = other.restrict(problem.channels) if other.size > problem.size else other
    if np.isnan(other.recorded()).all():
        raise InputError(
            f"{validate.name}: nothing was measured among the {problem.channels} channels; give another flight."
        )
    return other


def _check_options(name: str, kind: type[AbstractEstimator], settings: FlightSettings, network: GivenNetwork) -> None:
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


def _has_own_channels(kind: type[AbstractEstimator]) -> bool:
    return kind.looks_at != "all" and not kind.needs_network


def fit_os4(estimator: AbstractEstimator, problem: ShootingProblem, *, progress: Progress = silent) -> Answer:
    """Estimate the parameters and the noise levels of one flight.

    The noise levels follow from the residuals, and the fit is repeated with them. The covariance of an estimator that
    shoots is the Cramer-Rao bound, or `robust_covariance` if residuals are coloured. The other estimators have their
    own, and estimate once more with the last noise levels.
    """

    def search(weighted: ShootingProblem, number: int) -> Estimate:
        progress(f"fitting with the noise levels of pass {number}" if number else "compiling and fitting")
        shared = padded(weighted) if estimator.shoots and not estimator.needs_network else weighted
        return jax.block_until_ready(estimator(shared))

    estimates = [search(problem, 0)]
    for number in range(1, MAX_PASSES + 2):
        last, before = estimates[-1], np.asarray(problem.sigma)
        if not has_answer(last):
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
    if not has_answer(estimate):
        return Answer(problem, estimate, np.full(problem.unknowns.count, np.inf), rollouts)
    evaluation = evaluate(problem, estimate.parameters, estimate.initial_state)
    bound, covariance = evaluation.covariance, estimate.covariance
    if estimator.shoots:
        coloured = (residual_diagnostics(evaluation).colour > COLOURED).any()
        covariance = robust_covariance(evaluation) if coloured else bound
    changed = as_float(covariance), as_float(evaluation.cost)
    estimate = eqx.tree_at(lambda e: (e.covariance, e.cost), estimate, changed)
    return Answer(problem, estimate, np.sqrt(np.diagonal(bound)), rollouts, evaluation)
