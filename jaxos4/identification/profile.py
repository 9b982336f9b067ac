"""Standard deviations of poorly known moments of inertia, by the profile of the likelihood.

Under a controller, an alpha can be exchanged for strength and time constant of the disturbance. So the cost is not
quadratic: it is flat above an alpha that came out too small, and its covariance is too small. The profile needs no
covariance: a 95 % interval ends where the least cost is higher by 1.96^2/2, with all other unknowns fitted again.
"""

import equinox as eqx
import jax
import numpy as np

from .._custom_types import as_float
from ..estimate import Estimate
from ..estimators import FilterError
from ..results import NINETY_FIVE, result_names
from ..shooting import InnovationsProblem
from .answers import INVERSE
from .fit import PRIOR_NOTE, Fit, bracket_cost, not_identifiable
from .prepare import Progress
from .results import HeldParameter

# If the standard deviation of such an alpha is at most this share of it, the cost is nearly quadratic in its interval.
_WELL_KNOWN = 0.1
# The most fits that look for the end of an interval. They end once the root of twice the rise of the cost is this close
# to 1.96. It grows by 1 in each standard deviation if the cost is quadratic, and by the last number at least.
_FITS, _CLOSE, _LEAST_SLOPE = 3, 0.1, 0.1
# Newton's method needs one or two steps from the start that it is given. A cost that is too large by as much as its
# tolerance moves the end of an interval by 1 %.
_SEARCH = FilterError(tolerance=0.04)


def with_profile(fit: Fit, *, progress: Progress) -> Fit:
    """The fit of a vehicle, in which standard deviations of poorly known inertias are at least those by the profile.

    Only the upper end is looked for, because the upper side is longer.
    """
    if fit.searched is None or str(result_names(fit.estimate.result)) != "successful":
        return fit
    problem, found = fit.searched
    values, free, rollouts = np.asarray(found.parameters), fit.free, fit.rollouts
    factor = np.ones(values.size)
    for place in INVERSE.values():
        if place in free and fit.bound[place] > _WELL_KNOWN * abs(values[place]):
            progress("computing intervals")
            reach, more = upper_end(problem, found, place)
            factor[place], rollouts = max(reach / NINETY_FIVE, 1.0), rollouts + more
    covariance, own = np.asarray(fit.estimate.covariance) * np.outer(factor, factor), problem.problem.unknowns
    lost = not_identifiable(problem, np.sqrt(np.diagonal(covariance))[: own.count])
    held = fit.held | {
        name: HeldParameter(float(values[i]), own.units[i], PRIOR_NOTE)
        for i, name in enumerate(own.names)
        if name in lost and name not in fit.held
    }
    return fit._replace(
        estimate=eqx.tree_at(lambda e: e.covariance, fit.estimate, as_float(covariance)),
        rollouts=rollouts,
        held=held,
        widened={name: x for name, x in fit.widened.items() if name not in held},
    )


def upper_end(problem: InnovationsProblem, found: Estimate, place: int) -> tuple[float, int]:
    """Where the interval of one parameter ends by the profile, in standard deviations, and the rollouts."""
    own, covariance = problem.problem.unknowns, np.asarray(found.covariance)
    # How the minimum moves with this parameter, in steps of its standard deviation.
    along = covariance[:, place] / np.sqrt(covariance[place, place])
    unknowns, at, root, reach, rollouts = np.asarray(found.parameters), 0.0, 0.0, NINETY_FIVE, 0
    for _ in range(_FITS):
        unknowns, before, at = unknowns + (reach - at) * along, at, reach
        held = {own.names[place]: float(unknowns[place])}
        other = jax.block_until_ready(_SEARCH(problem.hold(held).starting_from(unknowns)))
        rollouts += int(other.rollouts)
        if str(result_names(other.result)) != "successful":
            break
        rise = float(other.cost) + bracket_cost(own, held) - float(found.cost)
        unknowns, last, root = np.asarray(other.parameters), root, np.sqrt(max(2 * rise, 0.0))
        reach = at + (NINETY_FIVE - root) / max((root - last) / (at - before), _LEAST_SLOPE)
        reach = float(np.clip(reach, at / 2, 2 * at))
        if abs(root - NINETY_FIVE) < _CLOSE:
            break
    return reach, rollouts
