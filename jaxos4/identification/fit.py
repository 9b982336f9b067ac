"""Fits one flight of an OS4; fits a vehicle at the shortest sample time that does not influence the answer.

Short samples contain the vibration of the sensors. Long samples hide motion. The flight is fitted at several sample
times. A sample time that the user gives is fitted in the same way, and longer ones beside it.

The rule takes the shortest sample time at which the innovations of the body rates are nearly white, and the moments of
inertia agree with those at the next longer sample time within two standard deviations and are known nearly as well. If
there is none, it takes the shortest with nearly white innovations, or else the one with the least correlated ones.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import msgspec
import numpy as np
from jaxtyping import Float

from .._custom_types import as_float
from ..airframe import AXES, YAW
from ..analysis.diagnostics import residual_diagnostics
from ..analysis.evaluation import evaluate, robust_covariance
from ..errors import InputError, TrainingError
from ..estimate import REACH, AbstractEstimator, Estimate
from ..estimators import ESTIMATORS, IBSS, FilterError, Hybrid, make_estimator
from ..networks.estimator import GivenNetwork, most_agile_windows, network_for, network_provenance, vehicle_network_for
from ..results import has_answer, result_names
from ..shooting import InnovationsProblem, ShootingProblem, padded
from .answers import OS4Answer, VehicleAnswer, dominated, vehicle_constants
from .data import Data, Progress, name_and_class, silent
from .intervals import at_lowest, corrected
from .prepare_os4 import Intervals, bracket_of
from .results import COLOURED, Constant, SampleTime
from .search import Optimum, search, search_all

DEFAULT = "filter-error"
"""The estimator of a vehicle, which flies in closed loop."""

MAX_PASSES = 3  # that estimate noise levels from residuals, before the last estimate
SETTLED = 0.2  # relative change of a noise level that ends the passes; such weights cost under 1 % of the efficiency
TOLERANCE = 1e-3  # of `FilterError`: it stops within 0.05 standard deviations of the minimum
WHITE = 0.06  # largest correlation of innovations that count as white, in addition to chance
CHANCE = 3.0  # standard errors of a correlation; the largest of 24 (3 rates, 8 lags) is compared
FAR = 2.0  # times the limit for white innovations; beyond it, shorter samples are unlikely to be white
AGREE = 2.0  # most standard deviations between two answers that agree
DISCRETE = 0.03  # relative error of discretisation
WIDER = 1.5  # intervals wider than at twice the sample time by this factor would agree with anything
NEAR_LIMIT = 0.95  # share of the way to its limit; an unknown beyond it starts no other search


def os4_estimator(
    data: Data[ShootingProblem],
    estimator: str | AbstractEstimator,
    bracket: Intervals,
    *,
    seed: int,
    progress: Progress,
) -> tuple[Data[ShootingProblem], AbstractEstimator]:
    """The data of an OS4 and their estimator, with a network trained for them in this bracket if a name was given."""
    if not isinstance(estimator, str):
        return data, estimator
    progress("training a network for this flight")
    problem, name, shoots = data.problem, str(data.provenance.flight), ESTIMATORS[estimator].shoots
    trained = network_for(problem, bracket_of(bracket, problem.model), name, shoots=shoots, seed=seed)
    problem = problem if shoots else problem.within(trained.bracket)
    provenance = msgspec.structs.replace(data.provenance, network=network_provenance(None, trained))
    data = dataclasses.replace(data, likelihood=problem, problem=problem, provenance=provenance)
    return data, make_estimator(estimator, trained)


def fit_os4(estimator: AbstractEstimator, problem: ShootingProblem, *, progress: Progress = silent) -> OS4Answer:
    """Estimate the parameters and the noise levels of one flight.

    The noise levels follow from the residuals, and the fit is repeated with them. The covariance of an estimator that
    shoots is the Cramer-Rao bound, or `robust_covariance` if residuals are coloured. The other estimators give their
    own covariance, and estimate once more with the last noise levels.
    """

    def search(weighted: ShootingProblem, number: int) -> Estimate:
        progress(f"fitting with the noise levels of pass {number}" if number else "compiling and fitting")
        if estimator.shoots and not estimator.needs_network:
            weighted = padded(weighted)  # flights of other lengths then share programs
        return jax.block_until_ready(estimator(weighted))

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


def vehicle_estimator(estimator: str | AbstractEstimator, network: GivenNetwork) -> str:
    """The name of an estimator of vehicles. Raises `InputError` for one that a controller biases, and for a network."""
    name, kind = name_and_class(estimator)
    if not kind.in_closed_loop:
        fitting = ", ".join(each for each, other in ESTIMATORS.items() if other.in_closed_loop)
        raise InputError(
            f"`estimator` {name}: is biased by a controller that answers gusts, as every vehicle has; use one of "
            f"{fitting}."
        )
    if network is not None or isinstance(estimator, Hybrid):
        raise InputError("`network`: a vehicle's network is trained for its own flights; use `estimator` hybrid.")
    return name


def fit_vehicle(
    several: Sequence[Data[InnovationsProblem]],
    estimator: str | AbstractEstimator,
    *,
    choose: bool,
    seed: int,
    progress: Progress,
) -> tuple[VehicleAnswer, tuple[SampleTime, ...]]:
    """The parameters and the disturbances at the chosen sample time.

    `FilterError` searches at the sample times, with the user's settings if it was given as an object. Any other
    estimator then searches at the chosen one.

    **Arguments:** `several`: the data, the shortest sample time first. `choose`: whether to choose a sample time;
    otherwise the first is used. `seed`: random seed for training a network.

    **Returns:** the answer, and a row for each sample time that belongs to it.
    """
    default = FilterError(tolerance=TOLERANCE)
    estimator = default if estimator == DEFAULT else estimator
    solver = estimator if isinstance(estimator, FilterError) else default
    answers, rows = [], []
    if solver is estimator or len(several) > 1:
        answers, rows = fit_sample_times(several, solver, choose=choose, progress=progress)
    place = chosen_place(rows) if choose and rows else 0
    if solver is estimator:
        answer = answers[place]
    else:
        data = answers[place].optimum.data if answers else several[0]
        data, solver = _vehicle_estimator(data, estimator, seed=seed, progress=progress)
        answer = corrected(search(solver, data, progress=progress))
    answer = at_lowest(answer, solver, progress=progress)
    rows[place : place + 1] = [sample_time_of(answer)]
    # After a restart, the rows of the other sample times belong to the abandoned minimum.
    return answer, (rows[place],) if answer.optimum.restarts else tuple(rows)


def _vehicle_estimator(
    data: Data[InnovationsProblem], estimator: str | AbstractEstimator, *, seed: int, progress: Progress
) -> tuple[Data[InnovationsProblem], AbstractEstimator]:
    """The data, with a note if a network was trained for them, and the estimator, with that network."""
    if not isinstance(estimator, str):
        return data, estimator
    if not ESTIMATORS[estimator].needs_network:
        return data, make_estimator(estimator)
    progress("training a network for these flights")
    begin, seen = time.perf_counter(), most_agile_windows(data.problem)
    name, solver = str((data.provenance.flights or ["flight"])[0]), IBSS()
    try:
        solver = Hybrid(vehicle_network_for(seen, name, seed=seed), seen=seen)
        what = f"its network was trained for these flights in {time.perf_counter() - begin:.0f} s"
    except TrainingError as error:
        what = f"no network for these flights ({error}); IBSS searched the whole bracket"
    notes = [*data.provenance.notes, f"{estimator}: {what}"]
    provenance = msgspec.structs.replace(data.provenance, notes=notes)
    return dataclasses.replace(data, provenance=provenance), solver


def fit_sample_times(
    several: Sequence[Data[InnovationsProblem]], solver: AbstractEstimator, *, choose: bool, progress: Progress
) -> tuple[list[VehicleAnswer], list[SampleTime]]:
    """The answers at the sample times that can be compared, the shortest first, and a row for each.

    Samples that hold the controller's answers as commands are a kind of their own: feedthroughs explain most of their
    innovations. They are fitted only if the other kind has no white innovations, and first if a search of all
    parameters at its longest samples shows that these are far from white. The first kind with white innovations ends
    the fits. The kind with the least correlated innovations is returned.

    `choose`: whether to choose the sample time; otherwise only the kind of the first is fitted.
    """
    kinds = [[each for each in several if each.contains_answers == contains] for contains in (False, True)]
    order = [(kind, None) for kind in kinds if kind and (choose or kind[0] is several[0])]
    if len(order) > 1:
        (kind, _), other = order
        progress(_fitting(kind[-1]))
        found = search_all(solver, kind[-1])
        row = sample_time_of(corrected(found))
        is_far = row.constants and not is_white(row, FAR)
        order = [other, (kind, found)] if is_far else [(kind, found), other]
    fitted = []
    for kind, longest in order:
        answers = []
        for optimum in search_sample_times(kind, solver, longest=longest, progress=progress):
            progress("computing intervals")
            answer = corrected(optimum)
            answers.insert(0, (answer, sample_time_of(answer)))
        fitted.append(answers)
        if any(row.constants and is_white(row) for _, row in answers):
            break
    answers, rows = zip(*min(fitted, key=_least_correlation), strict=True)
    return list(answers), list(rows)


def _fitting(data: Data[InnovationsProblem]) -> str:
    return f"fitting samples of {1e3 * float(data.problem.flight.dt):.3g} ms"


def _least_correlation(fitted: Sequence[tuple[VehicleAnswer, SampleTime]]) -> float:
    return min((abs(row.correlation) for _, row in fitted if row.constants), default=math.inf)


def search_sample_times(
    several: Sequence[Data[InnovationsProblem]],
    estimator: AbstractEstimator,
    *,
    longest: Optimum | None = None,
    progress: Progress = silent,
) -> Iterator[Optimum]:
    """The optimum at each sample time, the longest first.

    Each search starts at the answer for the next longer sample time, if that is a minimum. It starts at the bracket's
    centre where feedthroughs are no longer estimated.

    **Arguments:** `several`: one flight at several sample times, each twice the one before. `longest`: the result of
    `search_all` for the longest samples, if it is known.
    """
    optimum, first = None, longest
    for data in reversed(several):
        progress(_fitting(data))
        start, own, compared = None, data.likelihood, None
        if optimum is not None and bool(own.answers_within) == bool(optimum.likelihood.answers_within):
            start, compared = start_of(own, optimum.unrestricted), optimum.compared_delay
        optimum, first = search(estimator, data, start=start, first=first, compared_delay=compared), None
        yield optimum


def start_of(likelihood: InnovationsProblem, found: Estimate) -> Float[np.ndarray, " unknowns"] | None:
    """The start of a search from the estimate for longer samples; `None` if that is no minimum."""
    own, start = likelihood.problem.unknowns, np.asarray(found.parameters)
    off = np.abs(start[: own.count] - np.asarray(own.center)) / np.asarray(own.half_width)
    # Near a limit, the answer may be another minimum.
    is_minimum = str(result_names(found.result)) == "successful" and (off < NEAR_LIMIT * REACH).all()
    return start if is_minimum else None


def chosen_place(rows: Sequence[SampleTime]) -> int:
    """The index of the sample time that the rule chooses. `rows`: the shortest sample time first."""
    answered = [i for i, row in enumerate(rows) if row.constants] or [0]
    longer = dict(itertools.pairwise(answered))
    clean = [i for i in answered if is_white(rows[i])]
    clean = clean or [min(answered, key=lambda i: abs(rows[i].correlation))]
    return next((i for i in clean[:-1] if _agree(rows[i], rows[longer[i]])), clean[0])


def is_white(row: SampleTime, far: float = 1.0) -> bool:
    """Whether the largest correlation of innovations is at most `far` times the limit for nearly white ones."""
    return abs(row.correlation) <= far * (WHITE + CHANCE / math.sqrt(max(row.samples, 1)))


def _agree(row: SampleTime, other: SampleTime) -> bool:
    """Whether the next longer sample time with an answer agrees, and Ix or Iy is not clearly more certain there."""
    pairs = {name: (one, other.constants[name]) for name, one in row.constants.items() if name in other.constants}
    less_certain = any(one.std > WIDER * two.std for name, (one, two) in pairs.items() if name != YAW.inertia)
    return bool(pairs) and not moved(row, other) and not less_certain


def moved(row: SampleTime, other: SampleTime) -> list[str]:
    """The moments of inertia that another sample time contradicts."""

    def differs(one: Constant, two: Constant) -> bool:
        return abs(one.estimate - two.estimate) > AGREE * max(one.std, two.std) + DISCRETE * one.estimate

    both = [name for name in row.constants if name in other.constants]
    return [name for name in both if differs(row.constants[name], other.constants[name])]


def sample_time_of(answer: VehicleAnswer) -> SampleTime:
    """The answer at one sample time. Without a thrust, torques have no scale, so there is no answer."""
    answered = answer.answered and {*answer.gains} <= {*answer.free}
    constants = vehicle_constants(answer).constants if answered else {}
    if answered and YAW.motion in dominated(answer):
        constants = {name: row for name, row in constants.items() if name != YAW.inertia}
    found = [answer.disturbances[axis.rate] for axis in AXES if axis.rate in answer.disturbances] * answer.answered
    largest, samples = max((row.correlation for row in found), key=abs, default=1.0), 0
    if answer.answered and answer.estimate.parts is not None:
        # Squared innovations have a mean of 1, so that their sum is their number.
        samples = round(float(np.asarray(answer.estimate.parts.products)[:, : len(AXES), 0].sum() / len(AXES)))
    return SampleTime(float(answer.problem.flight.dt), constants, largest, samples)
