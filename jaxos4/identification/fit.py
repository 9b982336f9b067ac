"""The fit: the parameters with their errors, and the noise that belongs to them.

The noise of a simulated likelihood is that of the sensors; it follows from the residuals, and the fit is repeated with
it. A likelihood of innovations has its noise among its unknowns, and is fitted once.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._custom_types import as_float
from ..analysis.diagnostics import Diagnostics, residual_diagnostics
from ..analysis.evaluation import Evaluation, evaluate, robust_covariance
from ..bracket import GAUSSIAN_PRIOR, is_identifiable
from ..estimate import AbstractEstimator, Estimate
from ..models.abstract import Parameter
from ..results import RESULTS
from ..shooting import InnovationsProblem, Parts, ShootingProblem, Unknowns, padded
from ..shooting.gains import LogNoise
from .jackknife import disagreement, parts_of
from .prepare import Case, Progress
from .results import COLOURED, Disturbance, HeldParameter, has_answer

# Noise levels are computed at most this often before the last estimate.
_PASSES = 3
# Noise levels have settled if none changes by more than this share. Weights this close to the right ones cost less
# than 1 % of the efficiency.
_SETTLED = 0.2
# A parameter that must not be negative, and is so by this many standard deviations, is fixed at 0.
_NEGATIVE = 2.0
# A parameter is fixed at its plain value unless that raises the cost by more than the first number: near it, a cost
# with kinks is not quadratic, and standard deviations are too small. A value further off than the second number of
# standard deviations is never tried.
_CLEARLY, _SURELY = 5.0, 12.0
PRIOR_NOTE = "not identifiable from these flights; the other intervals allow for its bracket, as a standard deviation"
NEGATIVE_NOTE = "came out negative, which is impossible; at the limit"
_PLAIN_NOTE = "at the usual value, which these flights do not contradict"


class Fit(NamedTuple):
    """An estimate with everything that the search found.

    - `problem`: the flight, with the noise levels of the sensors that were found.
    - `estimate`: with its cost and covariance at these noise levels.
    - `bound`: standard deviations of the parameters if the model were right: the Cramer-Rao bound.
    - `rollouts`: of all searches together.
    - `diagnostics`: of the residuals; `evaluation`: the flight simulated at the estimate. `None` without an answer, and
      for innovations.
    - `held`: parameters of a vehicle that are not estimated. `negative`: value and standard deviation of those that
      came out negative, and so are 0; the other intervals allow for their standard deviation.
    - `widened`: by which factor an interval was widened because parts of the flights disagree, by parameter.
    - `profiled`: by which factor the profile of the likelihood made an interval longer, by parameter.
    - `is_lowest`: false if the cost is known to be lower elsewhere.
    - `disturbances`: by channel. `noise`: the same as logarithms. Only for innovations.
    - `searched`: the problem of innovations with what is fixed, and its estimate with the covariance of the search.
    """

    problem: ShootingProblem
    estimate: Estimate
    bound: Float[np.ndarray, " parameters"]
    rollouts: int
    diagnostics: Diagnostics | None = None
    evaluation: Evaluation | None = None
    held: dict[str, HeldParameter] = {}
    negative: dict[str, tuple[float, float]] = {}
    widened: dict[str, float] = {}
    profiled: dict[str, float] = {}
    is_lowest: bool = True
    disturbances: dict[str, Disturbance] = {}
    noise: LogNoise | None = None
    searched: tuple[InnovationsProblem, Estimate] | None = None

    @property
    def answered(self) -> bool:
        """Whether there is an estimate at all."""
        return has_answer(self.estimate)

    @property
    def free(self) -> list[int]:
        """The places of the parameters that are estimated."""
        return [i for i, name in enumerate(self.problem.model.parameter_names) if name not in self.held]


def fit_case(case: Case, *, first: Estimate | None = None, progress: Progress = lambda stage: None) -> Fit:
    """The fit of a prepared case, by its likelihood. `first`: see `fit_innovations`."""
    if isinstance(case.problem, InnovationsProblem):
        return fit_innovations(
            case.estimator, case.problem, case.recording, shooting=case.shooting, first=first, progress=progress
        )
    return fit_flight(case.estimator, case.problem, progress=progress)


def fit_flight(
    estimator: AbstractEstimator, problem: ShootingProblem, *, progress: Progress = lambda stage: None
) -> Fit:
    """Estimate the parameters and the noise levels of one flight.

    The covariance of an estimator that shoots is the Cramer-Rao bound, or `robust_covariance` if residuals are
    coloured. The other estimators have their own, and estimate once more with the last noise levels.
    """

    def search(weighted: ShootingProblem, number: int) -> Estimate:
        progress(f"fitting with the noise levels of pass {number}" if number else "compiling and fitting")
        shared = padded(weighted) if estimator.shoots and not estimator.needs_network else weighted
        return jax.block_until_ready(estimator(shared))

    estimates = [search(problem, 0)]
    for number in range(1, _PASSES + 2):
        last, before = estimates[-1], np.asarray(problem.sigma)
        if not has_answer(last):
            break
        problem = problem.reweighted(evaluate(problem, last.parameters, last.initial_state).errors)
        settled = (np.abs(np.asarray(problem.sigma) / before - 1) < _SETTLED).all()
        failed = estimator.shoots and bool(last.result != RESULTS.successful)
        is_last = settled or failed or number > _PASSES
        if not is_last or not estimator.shoots:
            estimates.append(search(problem, number))
        if is_last:
            break
    estimate, rollouts = estimates[-1], sum(int(each.rollouts) for each in estimates)
    if not has_answer(estimate):
        return Fit(problem, estimate, np.full(problem.unknowns.count, np.inf), rollouts)
    evaluation = evaluate(problem, estimate.parameters, estimate.initial_state)
    bound, covariance = evaluation.covariance, estimate.covariance
    diagnostics = residual_diagnostics(evaluation)
    if estimator.shoots:
        coloured = (diagnostics.colour > COLOURED).any()
        covariance = robust_covariance(evaluation) if coloured else bound
    estimate = eqx.tree_at(
        lambda e: (e.covariance, e.cost), estimate, (as_float(covariance), as_float(evaluation.cost))
    )
    return Fit(problem, estimate, np.sqrt(np.diagonal(bound)), rollouts, diagnostics, evaluation)


def fit_innovations(
    estimator: AbstractEstimator,
    problem: InnovationsProblem,
    recording: np.ndarray,
    *,
    shooting: ShootingProblem | None = None,
    first: Estimate | None = None,
    progress: Progress = lambda stage: None,
) -> Fit:
    """Estimate the parameters of a vehicle, and the disturbances that its model lacks.

    The bracket is a prior of all parameters. A parameter about which the flights say less than the bracket is not
    estimated. A parameter that came out negative, though physics forbids it, is fixed at 0. One that came
    out near its plain value is fixed there. Intervals widen if parts of the flights disagree.

    **Arguments:**

    - `recording`: the number of the recording of each sample.
    - `shooting`: the flight and its model, if that of the problem is padded.
    - `first`: the estimate of all parameters, if it was computed before.
    """
    own, names = problem.problem.unknowns, problem.model.parameter_names
    problem, found, rollouts, notes, negative, freed = _searched(estimator, problem, first, progress)
    progress("computing errors")
    values, covariance = np.asarray(found.parameters), np.asarray(found.covariance) + freed
    std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))[: own.count]
    noise = problem.noise(values)
    free, factor = np.flatnonzero(~np.isin(names, [*notes, *negative])), np.ones(values.size)
    if has_answer(found):
        factor[free] = _widening(problem, found, free, recording)
        notes = dict.fromkeys(not_identifiable(problem, factor[: own.count] * std), PRIOR_NOTE) | notes
    held = {
        name: HeldParameter(float(values[i]), own.units[i], notes[name])
        for i, name in enumerate(names)
        if name in notes
    }
    spread = as_float(covariance * np.outer(factor, factor))
    shooting = problem.problem if shooting is None else shooting
    sigma = np.array(shooting.sigma)
    sigma[shooting.columns] = np.exp(noise.sensor)
    sigma = as_float(np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0))
    return Fit(
        problem=eqx.tree_at(lambda p: p.sigma, shooting, sigma),
        estimate=eqx.tree_at(lambda e: e.covariance, found, spread),
        bound=std,
        rollouts=rollouts,
        held=held,
        negative=negative,
        widened={names[i]: float(factor[i]) for i in range(own.count) if factor[i] > 1 and names[i] not in held},
        disturbances=_disturbances(problem, found, noise),
        noise=noise,
        searched=(problem, found),
    )


def not_identifiable(problem: InnovationsProblem, std: Float[np.ndarray, " parameters"]) -> list[str]:
    """The parameters about which the flights say less than the bracket."""
    own = problem.problem.unknowns
    known = np.asarray(is_identifiable(std, np.asarray(own.half_width), GAUSSIAN_PRIOR))
    return [own.names[i] for i in np.flatnonzero(~known)]


def _searched(
    estimator: AbstractEstimator, problem: InnovationsProblem, first: Estimate | None, progress: Progress
) -> tuple[InnovationsProblem, Estimate, int, dict[str, str], dict[str, tuple[float, float]], np.ndarray]:
    """The problem with some parameters fixed at values that the flights do not contradict, and its estimate.

    **Returns:** also the rollouts of all searches, why parameters are fixed at their plain value, the value and
    standard deviation of those that came out negative and are fixed at 0, and the covariance that these would add if
    they were free.
    """
    table, rollouts = problem.model.parameters, 0 if first is None else int(first.rollouts)

    def search(other: InnovationsProblem) -> Estimate:
        nonlocal rollouts
        estimate = jax.block_until_ready(estimator(other))
        rollouts += int(estimate.rollouts)
        return estimate

    def holding(values: dict[str, float]) -> InnovationsProblem:
        return problem.hold({name: np.asarray(value) for name, value in values.items()}).starting_from(found.parameters)

    if first is None:
        progress("compiling, and fitting parameters and disturbances")
        first = search(problem)
    problem = problem.passing(_parts(first).passed)
    found, fixed, negative = first, {}, {}
    freed = np.zeros(np.shape(first.covariance))
    if has_answer(found):
        rows = _with_values(table, found)
        negative = {row.name: (x, std) for row, x, std in rows if row.nonnegative and x < -_NEGATIVE * std}
    if negative:
        progress("fitting again without what came out negative")
        places = [problem.unknowns.names.index(name) for name in negative]
        covariance = np.asarray(found.covariance)
        freed = covariance[:, places] @ np.linalg.pinv(covariance[np.ix_(places, places)]) @ covariance[places]
        problem = holding(dict.fromkeys(negative, 0.0))
        found = search(problem)
    plain = {
        row.name: row.plain
        for row, value, std in _with_values(table, found)
        if row.plain is not None and std > 0 and abs(value - row.plain) < _SURELY * std
    }
    if has_answer(found) and plain:
        progress("fitting again without what the flights hardly show")
        simpler = holding(plain)
        other = search(simpler)
        rise = float(other.cost) + bracket_cost(problem.problem.unknowns, plain) - float(found.cost)
        if has_answer(other) and rise < _CLEARLY:
            problem, found, fixed = simpler, other, fixed | dict.fromkeys(plain, _PLAIN_NOTE)
    return problem, found, rollouts, fixed, negative, freed


def bracket_cost(unknowns: Unknowns, values: Mapping[str, float]) -> float:
    """The cost that brackets, as Gaussian priors, add at these values. An unknown that is fixed there has none."""
    places = [unknowns.names.index(name) for name in values]
    off = np.array(list(values.values())) - np.asarray(unknowns.center)[places]
    return float(np.square(off / np.asarray(unknowns.half_width)[places]).sum()) / 2


def _with_values(table: tuple[Parameter, ...], found: Estimate) -> Iterator[tuple[Parameter, float, float]]:
    """Each parameter with its value and its standard deviation; the noise levels that follow are left out."""
    return zip(table, np.asarray(found.parameters).tolist(), _std(found).tolist(), strict=False)


def _parts(found: Estimate) -> Parts:
    if found.parts is None:
        raise ValueError("`estimator` must return the `parts` of the likelihood.")
    return found.parts


def _std(found: Estimate) -> np.ndarray:
    return np.sqrt(np.maximum(np.diagonal(np.asarray(found.covariance)), 0.0))


def _widening(
    problem: InnovationsProblem, found: Estimate, fitted: np.ndarray, recording: np.ndarray
) -> Float[np.ndarray, " fitted"]:
    """The factor by which the intervals of the parameters in the places `fitted` widen. `recording`: of each sample."""
    index, owned = map(np.asarray, problem.cut[:2])
    middle = np.array([int(np.median(row[own])) if own.any() else 0 for row, own in zip(index, owned, strict=True)])
    parts = _parts(found)
    # In a segment of padding nothing was measured.
    used = np.asarray(parts.information).any(axis=(1, 2))
    number = recording[np.minimum(middle, recording.size - 1)][used]
    gradient = np.asarray(parts.gradient)[used][:, fitted]
    information = np.asarray(parts.information)[used][:, fitted[:, None], fitted]
    prior = np.diag(1 / np.square(np.asarray(problem.problem.unknowns.half_width)[fitted]))
    ways = [disagreement(gradient, information, prior, part) for part in parts_of(number.size, number)]
    return np.max([np.ones(fitted.size), *ways], axis=0)


def _disturbances(problem: InnovationsProblem, found: Estimate, noise: LogNoise) -> dict[str, Disturbance]:
    strength, time_constant, sensor = (np.exp(leaf) for leaf in noise)
    products = np.asarray(_parts(found).products).sum(axis=0)
    correlation = products[:, 1:] / np.maximum(products[:, :1], 1.0)
    largest = np.take_along_axis(correlation, np.abs(correlation).argmax(axis=1)[:, None], axis=1)[:, 0]
    return {
        name: Disturbance(
            strength=float(strength[i]),
            unit="rad/s^2" if i < 3 else "m/s^2",
            time_constant=float(time_constant[i]),
            sensor=float(sensor[i]),
            correlation=float(largest[i]),
        )
        for i, name in enumerate(problem.channels)
    }
