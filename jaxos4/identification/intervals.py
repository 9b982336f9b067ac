"""Corrects a vehicle's intervals for a wrong model, and for a cost that is not quadratic.

The covariance of a search assumes that the model is right and the cost quadratic. Standard deviations are therefore
multiplied by two factors, which are at least 1:

- **jackknife**: if parts of the flights give different answers, the model lacks an effect, or the vehicle changed.
- **profile**: under a controller, strength and time constant of the disturbance can compensate for a wrong alpha, so
  the cost is flat above an alpha that came out too small. The profile needs no covariance: a 95 % interval ends where
  the cost, minimised over all other unknowns, has risen by 1.96^2/2. Only the upper ends for poorly known moments of
  inertia are computed, because the upper side is longer.

A likelihood can have several maxima. If the cost at an end is lower than at the optimum, the search restarts there.
"""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._custom_types import as_float
from ..airframe import AXES, INVERSES
from ..bracket import GAUSSIAN_PRIOR, is_identifiable
from ..estimate import AbstractEstimator
from ..estimators import FilterError
from ..results import NINETY_FIVE, has_answer, result_names
from .answers import VehicleAnswer
from .data import Progress, silent
from .results import Constant, FixedParameter
from .search import LOWER, Optimum, deviations, disturbances_of, search
from .verdict import Move

PRIOR_NOTE = "not identifiable from these flights; the uncertainty is included in the other intervals"
_NOMINAL_NOTE = "at the usual value, which these flights do not contradict"


MAX_PARTS = 20  # most parts of the flights that are compared
MIN_PARTS = 4  # fewer cannot show a disagreement
CHANCE = 0.05  # probability that parts seem to disagree although the model is right
WELL_KNOWN = 0.1  # relative standard deviation; if it is smaller, the cost is nearly quadratic in the interval
MAX_FITS = 3  # for one end of an interval
CLOSE = 0.1  # fits end if the root of twice the rise of the cost is this close to 1.96
MIN_SLOPE = 0.1  # of this root per standard deviation; it is 1 if the cost is quadratic
PROFILE_TOLERANCE = 0.04  # of a fit, which takes one or two steps; this error of the cost moves an end by 1 %
MAX_MINIMA = 3  # most minima whose ends are computed
_CLEAR = 1e-5  # smallest pivot of the Cholesky factor (of scaled unknowns) that counts as regular


def corrected(optimum: Optimum, profile: Mapping[str, float] = {}) -> VehicleAnswer:
    """The answer of a search, with corrected intervals and without the parameters that are not identifiable.

    A parameter is not identifiable if the flights are less informative about it than its bracket.

    `profile`: the factors of the profile, by parameter.
    """
    names, units, values = optimum.parameter_unknowns.names, optimum.parameter_unknowns.units, optimum.values
    problem, logs = optimum.data.problem, optimum.data.log
    notes, jackknife, longer = dict.fromkeys(optimum.nominal, _NOMINAL_NOTE), np.ones(values.size), np.ones(values.size)
    if has_answer(optimum.estimate.result):
        free = np.flatnonzero(~np.isin(names, [*optimum.nominal, *optimum.negative]))
        jackknife[free] = _widening(optimum, free, logs)
        longer[: len(names)] = [profile.get(name, 1.0) for name in names]
        std = (jackknife * longer)[: len(names)] * optimum.std
        known = np.asarray(is_identifiable(std, np.asarray(optimum.parameter_unknowns.half_width), GAUSSIAN_PRIOR))
        notes = {name: PRIOR_NOTE for name, is_known in zip(names, known, strict=True) if not is_known} | notes

    def of_free(factor: Float[np.ndarray, " unknowns"]) -> dict[str, float]:
        return {name: float(x) for name, x in zip(names, factor, strict=False) if x > 1 and name not in notes}

    covariance = as_float(optimum.covariance * np.outer(jackknife * longer, jackknife * longer))
    sigma = np.array(problem.sigma)
    sigma[problem.columns] = np.exp(optimum.noise.sensor)
    sigma = as_float(np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0))
    return VehicleAnswer(
        problem=eqx.tree_at(lambda p: p.sigma, problem, sigma),
        estimate=eqx.tree_at(lambda e: e.covariance, optimum.estimate, covariance),
        bound=optimum.std,
        rollouts=optimum.rollouts,
        optimum=optimum,
        negative=optimum.negative,
        fixed={x: FixedParameter(float(values[i]), units[i], notes[x]) for i, x in enumerate(names) if x in notes},
        disturbances=disturbances_of(optimum),
        widened=of_free(jackknife),
        profiled=of_free(longer),
    )


def at_lowest(answer: VehicleAnswer, estimator: AbstractEstimator, *, progress: Progress = silent) -> VehicleAnswer:
    """Profiles the likelihood, starts again at any lower minimum, and widens the intervals accordingly.

    A search that did not converge has no profile. `answer`: from `corrected`, found by this `estimator`.
    """
    optimum, data = answer.optimum, answer.optimum.data
    for left in reversed(range(MAX_MINIMA)):
        if not optimum.converged:
            return answer
        factors, lower = {}, None
        poor = optimum.std > WELL_KNOWN * np.abs(optimum.values[: optimum.parameter_unknowns.count])
        for place in sorted({*INVERSES} & {*answer.free} & {*np.flatnonzero(poor).tolist()}):
            progress("computing intervals")
            end, fit = upper_end(optimum, place)
            optimum = optimum._replace(rollouts=fit.rollouts)
            if fit.converged and optimum.cost - fit.cost > LOWER:
                lower = fit.values
                break
            factors[optimum.parameter_unknowns.names[place]] = max(end / NINETY_FIVE, 1.0)
        if lower is None:
            return corrected(optimum, factors)
        if not left:
            break
        progress("fitting again where the cost is lower")
        counted = optimum.likelihood.noise_feedthrough
        same = data.likelihood.with_noise_feedthrough(counted)  # costs are comparable only within one likelihood
        other = search(estimator, dataclasses.replace(data, likelihood=same), start=lower, progress=progress)
        rollouts = optimum.rollouts + other.rollouts
        is_lower = has_answer(other.estimate.result) and other.cost < optimum.cost
        if not is_lower:
            optimum = optimum._replace(rollouts=rollouts)
            break
        optimum = other._replace(restarts=optimum.restarts + 1, rollouts=rollouts)
        answer = corrected(optimum)
    return corrected(optimum._replace(is_lowest=False))


def upper_end(optimum: Optimum, place: int) -> tuple[float, Optimum]:
    """The upper end of one parameter's interval by its profile likelihood.

    If the first fit fails, the end follows from the covariance. If a later fit fails, the end is extrapolated from the
    fits before it. The search for the end stops where the cost is lower than at the optimum.

    **Returns:** the end in standard deviations above the optimum, and the last fit at an end.
    """
    solver, covariance = FilterError(tolerance=PROFILE_TOLERANCE), np.asarray(optimum.estimate.covariance)
    # How all unknowns move if this parameter moves by one standard deviation.
    along = covariance[:, place] / np.sqrt(covariance[place, place])
    unknowns, at, root, end, other = optimum.values, 0.0, 0.0, NINETY_FIVE, optimum
    for _ in range(MAX_FITS):
        unknowns, before, at = unknowns + (end - at) * along, at, end
        fixed = {optimum.parameter_unknowns.names[place]: float(unknowns[place])}
        other = optimum._replace(rollouts=other.rollouts).restricted(solver, fixed, unknowns)
        rise, unknowns, last = other.cost - optimum.cost, other.values, root
        if not other.converged or rise < -LOWER:
            break
        root = np.sqrt(max(2 * rise, 0.0))
        end = at + (NINETY_FIVE - root) / max((root - last) / (at - before), MIN_SLOPE)
        end = float(np.clip(end, at / 2, 2 * at))
        if abs(root - NINETY_FIVE) < CLOSE:
            break
    return end, other


def consequences(
    answer: VehicleAnswer, constants: Mapping[str, Constant], name: str, value: float
) -> dict[str, Move | None]:
    """The change of each quantity if a parameter is fixed at a value and all others are fitted again.

    The covariance does not show it: under a controller the cost is flat, and an inertia moves two to three times as
    far. Nothing moves if the search did not estimate this parameter. `None`: the fit failed.
    """
    model, optimum = answer.problem.model, answer.optimum
    own, values = optimum.likelihood.problem.unknowns, optimum.values
    if not np.asarray(own.free)[own.names.index(name)]:
        return {}
    other = optimum.restricted(FilterError(tolerance=PROFILE_TOLERANCE), {name: value})
    others = {each: names for each, names in model.quantities.items() if name not in names}
    if str(result_names(other.estimate.result)) not in ("successful", "at_bound"):
        return dict.fromkeys((*constants, *others))
    moved, std = other.values, deviations(answer.estimate.covariance)
    factor = np.prod(moved[answer.gains] / values[answer.gains])
    moves: dict[str, Move | None] = {}
    for axis in AXES:
        if (row := constants.get(axis.inertia)) is not None:
            share = abs(factor * values[axis.place] / moved[axis.place] - 1)
            moves[axis.inertia] = Move(float(share), float(share * row.estimate / row.std))
    for quantity, names in others.items():
        places = [i for i in map(own.names.index, names) if std[i] > 0]
        if places:
            change, width = np.abs(moved - values)[places], np.asarray(own.half_width)[places]
            moves[quantity] = Move(float((change / width).max()), float((change / std[places]).max()))
    return moves


def _widening(
    optimum: Optimum, free: Int[np.ndarray, " free"], recording: Int[np.ndarray, " samples"]
) -> Float[np.ndarray, " free"]:
    """The jackknife's factors for the unknowns with the indices `free`. `recording`: of each sample."""
    index, owned = map(np.asarray, optimum.likelihood.segmentation[:2])
    middle = np.array([int(np.median(row[own])) if own.any() else 0 for row, own in zip(index, owned, strict=True)])
    segments = optimum.by_segment
    # Padded segments hold no measurements.
    used = np.asarray(segments.information).any(axis=(1, 2))
    number = recording[np.minimum(middle, recording.size - 1)][used]
    gradient = np.asarray(segments.gradient)[used][:, free]
    information = np.asarray(segments.information)[used][:, free[:, None], free]
    prior = np.diag(1 / np.square(np.asarray(optimum.parameter_unknowns.half_width)[free]))
    ways = [disagreement(gradient, information, prior, part) for part in parts_of(number.size, number)]
    return np.max([np.ones(free.size), *ways], axis=0)


def parts_of(segments: int, recording: Int[np.ndarray, " segments"]) -> list[Int[np.ndarray, " segments"]]:
    """The ways to divide segments into parts: into blocks of neighbours, and into recordings if there are enough."""
    ways = [np.arange(segments) * min(segments, MAX_PARTS) // segments, recording]
    return [way for way in ways if np.unique(way).size >= MIN_PARTS]


def _solved(
    information: Float[np.ndarray, "unknowns unknowns"], slope: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, " unknowns"]:
    """The Gauss-Newton step, or the shortest one if the information (of scaled unknowns) is singular.

    The shortest step takes fifty times as long to compute: minutes for fifty logs.
    """
    try:
        clear = float(np.linalg.cholesky(information).diagonal().min()) > _CLEAR
    except np.linalg.LinAlgError:
        clear = False
    return np.linalg.solve(information, slope) if clear else np.linalg.lstsq(information, slope, rcond=1e-12)[0]


def disagreement(
    gradient: Float[np.ndarray, "segments unknowns"],
    information: Float[np.ndarray, "segments unknowns unknowns"],
    prior: Float[np.ndarray, "unknowns unknowns"],
    part: Int[np.ndarray, " segments"],
) -> Float[np.ndarray, " unknowns"]:
    """The disagreement of parts: the jackknife's standard error over the likelihood's; at least 1.

    The standard errors of a likelihood assume that the model is right. If it is not, parts of a flight give different
    answers. The jackknife leaves out one part at a time. One Gauss-Newton step gives the answer without that part,
    because the search has computed the gradient and the information of each part. The result is 1 if the disagreement
    could be chance: only one parameter in twenty exceeds this threshold by chance.

    **Arguments:**

    - `gradient`, `information`: of the negative log-likelihood of each segment, at the estimate from all segments.
    - `prior`: the information of the prior.
    - `part`: the part to which each segment belongs.

    Reference: Efron and Tibshirani 1993, An Introduction to the Bootstrap, ch. 11.
    """
    from scipy.special import chdtri  # slow to import

    numbers = np.unique(part)
    whole = information.sum(axis=0) + prior
    scale = np.sqrt(np.diagonal(whole))
    moved = []
    for number in numbers:
        left_out = part == number
        rest = (whole - information[left_out].sum(axis=0)) / np.outer(scale, scale)
        slope = gradient[left_out].sum(axis=0) / scale
        moved.append(_solved(rest, slope) / scale)
    moved = np.stack(moved)
    variance = (numbers.size - 1) / numbers.size * np.square(moved - moved.mean(axis=0)).sum(axis=0)
    likelihood = np.diagonal(np.linalg.inv(whole / np.outer(scale, scale))) / scale**2
    ratio = variance / likelihood
    freedom = numbers.size - 1
    return np.sqrt(np.where(ratio > chdtri(freedom, CHANCE) / freedom, np.maximum(ratio, 1.0), 1.0))
