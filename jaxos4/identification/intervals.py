"""Intervals of a vehicle's parameters where the covariance of a search is not enough.

The covariance takes the cost for quadratic and the model for right. A profile of the likelihood does not need the
first, a jackknife does not need the second.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ..bracket import GAUSSIAN_PRIOR, is_identifiable
from ..estimate import AbstractEstimator, Estimate
from ..results import NINETY_FIVE
from ..shooting import InnovationsProblem, Parts, Unknowns
from .results import has_answer

INVERSE = {"Ix": 2, "Iy": 5, "Iz": 7}
"""The place of the alpha that is torque over this moment of inertia."""
# If the standard deviation of such an alpha is at most this share of it, the cost is nearly quadratic in its interval.
_WELL_KNOWN = 0.1
# The most fits at each end of an interval. They end once the root of twice the rise of the cost is this close to 1.96.
# In each standard deviation, the root grows by 1 if the cost is quadratic. The last number is the least growth.
_FITS, _CLOSE, _LEAST_SLOPE = 3, 0.1, 0.1
# The most parts of a flight that are compared, and the fewest that can show a disagreement.
_MOST, _FEWEST = 20, 4
# The chance that parts of a flight that the model explains are taken to disagree.
_CHANCE = 0.05


class Errors(NamedTuple):
    """How uncertain the unknowns are, compared with the covariance of the search.

    - `scale`: the factor of each standard deviation.
    - `widened`: the part of it because parts of the flights disagree.
    - `intervals`: 95 % intervals that need not be as far to both sides, by place.
    - `rollouts`: of the searches for them.
    """

    scale: Float[np.ndarray, " unknowns"]
    widened: Float[np.ndarray, " unknowns"]
    intervals: dict[int, tuple[float, float]]
    rollouts: int


def errors_of(
    estimator: AbstractEstimator,
    problem: InnovationsProblem,
    found: Estimate,
    fitted: Int[np.ndarray, " fitted"],
    recording: np.ndarray,
    *,
    profile: bool,
) -> Errors:
    """The errors of an answer. `fitted`: the places of its parameters. `recording`: the number of each sample's."""
    values, own = np.asarray(found.parameters), problem.problem.unknowns
    std = np.sqrt(np.maximum(np.diagonal(np.asarray(found.covariance)), 0.0))
    widened, rollouts = np.ones(values.size), 0
    widened[fitted] = widening(problem, found, fitted, recording)

    def search(other: InnovationsProblem) -> Estimate:
        nonlocal rollouts
        estimate = jax.block_until_ready(estimator(other))
        rollouts += int(estimate.rollouts)
        return estimate

    known = np.asarray(is_identifiable((widened * std)[: own.count], np.asarray(own.half_width), GAUSSIAN_PRIOR))
    poorly = [i for i in poorly_known(values, std) if i in fitted and known[i]] if profile else []
    scale, intervals = widened.copy(), profiled(search, problem, found, poorly)
    for i, (low, high) in intervals.items():
        half, value = (high - low) / (2 * NINETY_FIVE), float(values[i])
        stretch = max(widened[i] * std[i] / half, 1.0) if widened[i] > 1 else 1.0
        scale[i] = max(stretch * half / std[i], 1.0)
        intervals[i] = value + stretch * (low - value), value + stretch * (high - value)
    return Errors(scale, widened, intervals, rollouts)


def poorly_known(values: Float[np.ndarray, " unknowns"], std: Float[np.ndarray, " some"]) -> list[int]:
    """The places of the alphas of inertias about which the cost is not nearly quadratic within their intervals."""
    return [i for i in INVERSE.values() if std[i] > _WELL_KNOWN * abs(values[i])]


def bracket_cost(unknowns: Unknowns, values: Mapping[str, float]) -> float:
    """The cost that brackets, as Gaussian priors, add at these values. An unknown that is held there has none."""
    places = [unknowns.names.index(name) for name in values]
    off = np.array(list(values.values())) - np.asarray(unknowns.center)[places]
    return float(np.square(off / np.asarray(unknowns.half_width)[places]).sum()) / 2


def profiled(
    search: Callable[[InnovationsProblem], Estimate], problem: InnovationsProblem, found: Estimate, places: list[int]
) -> dict[int, tuple[float, float]]:
    """The 95 % intervals of parameters by the profile of the likelihood: at their ends, the cost is 1.96^2 / 2 higher.

    All other unknowns are fitted again at each end. A controller answers the disturbance. So an alpha can be exchanged
    for strength and time constant of the disturbance, and the less the smaller it is: where it came out too small, its
    standard deviation is too small.

    **Arguments:** `found`: the minimum. `places`: of these parameters.

    **Returns:** an interval for each of the places, but for those where a fit has no answer.

    Reference: Venzon and Moolgavkar 1988, Applied Statistics 37(1).
    """
    ends = {i: [_end(search, problem, found, i, side) for side in (-1, 1)] for i in places}
    return {i: (low, high) for i, (low, high) in ends.items() if low < high}


def _end(
    search: Callable[[InnovationsProblem], Estimate],
    problem: InnovationsProblem,
    found: Estimate,
    place: int,
    side: int,
) -> float:
    """One end of a parameter's interval, by secants; NaN if a fit has no answer."""
    covariance, own = np.asarray(found.covariance), problem.problem.unknowns
    # How the minimum moves with this parameter, in steps of its standard deviation.
    along = side * covariance[:, place] / np.sqrt(covariance[place, place])
    unknowns, at, root, reach = np.asarray(found.parameters), 0.0, 0.0, NINETY_FIVE
    for _ in range(_FITS):
        unknowns, before, at = unknowns + (reach - at) * along, at, reach
        held = {own.names[place]: float(unknowns[place])}
        other = search(problem.hold({name: np.asarray(x) for name, x in held.items()}).starting_from(unknowns))
        if not has_answer(other):
            return np.nan
        rise = float(other.cost) + bracket_cost(own, held) - float(found.cost)
        unknowns, last, root = np.asarray(other.parameters), root, np.sqrt(max(2 * rise, 0.0))
        slope = max((root - last) / (at - before), _LEAST_SLOPE)
        reach = float(np.clip(at + (NINETY_FIVE - root) / slope, at / 2, 2 * at))
        if abs(root - NINETY_FIVE) < _CLOSE:
            break
    return float(np.asarray(found.parameters)[place] + reach * along[place])


def parts_found(found: Estimate) -> Parts:
    """The parts of the likelihood; a search of innovations returns them."""
    if found.parts is None:
        raise ValueError("`estimator` must return the `parts` of the likelihood.")
    return found.parts


def widening(
    problem: InnovationsProblem, found: Estimate, fitted: np.ndarray, recording: np.ndarray
) -> Float[np.ndarray, " fitted"]:
    """The factor by which the intervals of the parameters in the places `fitted` widen. `recording`: of each sample."""
    index, owned, _ = map(np.asarray, problem.cut)
    middle = np.array([int(np.median(row[own])) if own.any() else 0 for row, own in zip(index, owned, strict=True)])
    parts = parts_found(found)
    # In a segment of padding nothing was measured.
    used = np.asarray(parts.information).any(axis=(1, 2))
    number = recording[np.minimum(middle, recording.size - 1)][used]
    gradient = np.asarray(parts.gradient)[used][:, fitted]
    information = np.asarray(parts.information)[used][:, fitted[:, None], fitted]
    prior = np.diag(1 / np.square(np.asarray(problem.problem.unknowns.half_width)[fitted]))
    ways = [disagreement(gradient, information, prior, part) for part in parts_of(number.size, number)]
    return np.max([np.ones(fitted.size), *ways], axis=0)


def parts_of(lanes: int, recording: Int[np.ndarray, " lanes"]) -> list[Int[np.ndarray, " lanes"]]:
    """The ways to divide lanes into parts: into blocks of neighbours, and into recordings if there are enough."""
    ways = [np.arange(lanes) * min(lanes, _MOST) // lanes]
    if np.unique(recording).size >= _FEWEST:
        ways.append(recording)
    return [way for way in ways if np.unique(way).size >= _FEWEST]


def disagreement(
    gradient: Float[np.ndarray, "lanes unknowns"],
    information: Float[np.ndarray, "lanes unknowns unknowns"],
    prior: Float[np.ndarray, "unknowns unknowns"],
    part: Int[np.ndarray, " lanes"],
) -> Float[np.ndarray, " unknowns"]:
    """By how much parts disagree: the jackknife's standard error over the likelihood's; at least 1.

    The standard errors of a likelihood assume that the model is right. If it is not, parts of a flight give different
    answers. The jackknife leaves out one part at a time; each answer follows from one Gauss-Newton step, because the
    search has computed the gradient and the information of each part. 1 if the disagreement could be chance: it happens
    by chance to one parameter in twenty.

    **Arguments:**

    - `gradient`, `information`: of the negative log-likelihood of each lane, at the estimate from all lanes.
    - `prior`: the information of the prior.
    - `part`: the number of the part of each lane.

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
        moved.append(np.linalg.lstsq(rest, slope, rcond=1e-12)[0] / scale)
    moved = np.stack(moved)
    variance = (numbers.size - 1) / numbers.size * np.square(moved - moved.mean(axis=0)).sum(axis=0)
    likelihood = np.diagonal(np.linalg.inv(whole / np.outer(scale, scale))) / scale**2
    ratio = variance / likelihood
    freedom = numbers.size - 1
    return np.sqrt(np.where(ratio > chdtri(freedom, _CHANCE) / freedom, np.maximum(ratio, 1.0), 1.0))
