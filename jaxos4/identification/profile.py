"""Standard deviations of poorly known moments of inertia, by the profile of the likelihood.

Under a controller, an alpha can be exchanged for strength and time constant of the disturbance. So the cost is not
quadratic: it is flat above an alpha that came out too small, and its covariance is too small. The profile needs no
covariance: a 95 % interval ends where the least cost is higher by 1.96^2/2, with all other unknowns fitted again.

A likelihood can have several maxima. If the cost is lower at an end than at the estimate, the search starts there
again.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._custom_types import as_float
from ..estimate import Estimate
from ..estimators import FilterError
from ..results import NINETY_FIVE, result_names
from ..shooting import InnovationsProblem
from .answers import INVERSE
from .fit import PRIOR_NOTE, Fit, bracket_cost, fit_case, not_identifiable
from .prepare import Case, Progress
from .results import HeldParameter

# If the standard deviation of such an alpha is at most this share of it, the cost is nearly quadratic in its interval.
_WELL_KNOWN = 0.1
# The most fits that look for the end of an interval. They end once the root of twice the rise of the cost is this close
# to 1.96. It grows by 1 in each standard deviation if the cost is quadratic, and by the last number at least.
_FITS, _CLOSE, _LEAST_SLOPE = 3, 0.1, 0.1
# Levenberg-Marquardt needs one or two steps from the start that it is given. A cost that is too large by as much as its
# tolerance moves the end of an interval by 1 %.
_TOLERANCE = 0.04
# An end whose cost is lower by more than this shows that the estimate is not at the minimum. The most minima whose ends
# are looked at.
_LOWER, _MINIMA = 0.1, 3


def with_profile(fit: Fit, case: Case, *, progress: Progress) -> Fit:
    """The fit of a vehicle, in which standard deviations of poorly known inertias are at least those by the profile.

    Only the upper end is looked for, because the upper side is longer. The jackknife multiplies a standard deviation
    too: it allows for a wrong model, and the profile for a cost that is not quadratic.

    **Returns:** the fit at the lowest minimum that was found; not `is_lowest` if the cost is lower at one of its ends.
    """
    whole = case.problem
    if not isinstance(whole, InnovationsProblem):
        raise ValueError("`case.problem` must be an `InnovationsProblem`.")
    for left in reversed(range(_MINIMA)):
        if fit.searched is None or str(result_names(fit.estimate.result)) != "successful":
            return fit
        (problem, found), factors, lower = fit.searched, {}, None
        poor = np.flatnonzero(fit.bound > _WELL_KNOWN * np.abs(np.asarray(fit.estimate.parameters)[: fit.bound.size]))
        for place in sorted({*INVERSE.values()} & {*fit.free} & {*poor.tolist()}):
            progress("computing intervals")
            reach, lower, rollouts = upper_end(problem, found, place)
            fit = fit._replace(rollouts=fit.rollouts + rollouts)
            if lower is not None:
                break
            factors[place] = max(reach / NINETY_FIVE, 1.0)
        if lower is None:
            return _widened(fit, problem, factors)
        if not left:
            break
        progress("fitting again where the cost is lower")
        same = whole.passing(problem.passed)  # costs compare in the same likelihood only
        first = jax.block_until_ready(case.estimator(same.starting_from(lower)))
        other = fit_case(case._replace(problem=same), first=first, progress=progress)
        is_lower = other.answered and _cost(other, whole) < _cost(fit, whole)
        fit = (other if is_lower else fit)._replace(rollouts=fit.rollouts + other.rollouts)
        if not is_lower:
            break
    return fit._replace(is_lowest=False)


def _cost(fit: Fit, whole: InnovationsProblem) -> float:
    """The cost, with that of the brackets of fixed parameters."""
    if fit.searched is None:
        raise ValueError("`fit` must be one of innovations.")
    problem, found = fit.searched
    own = problem.problem.unknowns
    held = {own.names[i]: float(own.center[i]) for i in np.flatnonzero(~np.asarray(own.free))}
    return float(found.cost) + bracket_cost(whole.problem.unknowns, held)


def _widened(fit: Fit, problem: InnovationsProblem, factors: dict[int, float]) -> Fit:
    """The fit with larger standard deviations. `factors`: by the place of the parameter."""
    own, values = problem.problem.unknowns, np.asarray(fit.estimate.parameters)
    factor = np.ones(values.size)
    for place, each in factors.items():
        factor[place] = each
    covariance = np.asarray(fit.estimate.covariance) * np.outer(factor, factor)
    lost = not_identifiable(problem, np.sqrt(np.diagonal(covariance))[: own.count])
    held = fit.held | {
        name: HeldParameter(float(values[i]), own.units[i], PRIOR_NOTE)
        for i, name in enumerate(own.names)
        if name in lost and name not in fit.held
    }
    return fit._replace(
        estimate=eqx.tree_at(lambda e: e.covariance, fit.estimate, as_float(covariance)),
        held=held,
        widened={name: x for name, x in fit.widened.items() if name not in held},
        profiled={own.names[i]: x for i, x in factors.items() if x > 1 and own.names[i] not in held},
    )


def upper_end(
    problem: InnovationsProblem, found: Estimate, place: int
) -> tuple[float, Float[np.ndarray, " unknowns"] | None, int]:
    """Where the interval of one parameter ends by the profile.

    **Returns:** the end in standard deviations above the estimate; unknowns at which the cost is lower than at the
    estimate, or `None`; the rollouts. If no fit at an end succeeds, the end is that of the covariance. If a later fit
    fails, the end is extrapolated from the fits before it.
    """
    search, own, covariance = FilterError(tolerance=_TOLERANCE), problem.problem.unknowns, np.asarray(found.covariance)
    # How the minimum moves with this parameter, in steps of its standard deviation.
    along = covariance[:, place] / np.sqrt(covariance[place, place])
    unknowns, at, root, reach, rollouts = np.asarray(found.parameters), 0.0, 0.0, NINETY_FIVE, 0
    for _ in range(_FITS):
        unknowns, before, at = unknowns + (reach - at) * along, at, reach
        held = {own.names[place]: float(unknowns[place])}
        other = jax.block_until_ready(search(problem.hold(held).starting_from(unknowns)))
        rollouts += int(other.rollouts)
        if str(result_names(other.result)) != "successful":
            break
        rise = float(other.cost) + bracket_cost(own, held) - float(found.cost)
        unknowns, last, root = np.asarray(other.parameters), root, np.sqrt(max(2 * rise, 0.0))
        if rise < -_LOWER:
            return NINETY_FIVE, unknowns, rollouts
        reach = at + (NINETY_FIVE - root) / max((root - last) / (at - before), _LEAST_SLOPE)
        reach = float(np.clip(reach, at / 2, 2 * at))
        if abs(root - NINETY_FIVE) < _CLOSE:
            break
    return reach, None, rollouts
