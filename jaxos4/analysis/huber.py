"""Huber's loss: measurements far off the fit count for no more than a few standard deviations."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Parameters, Scalar
from ..flight import STATE_NAMES
from ..shooting import ShootingProblem

# Where residuals are cut, in standard deviations: of Gaussian noise the estimate keeps 95 % of its efficiency.
CUT = 1.345
# The median of the magnitude of Gaussian noise is this many standard deviations.
_MEDIAN = 0.6745


class Winsorised(NamedTuple):
    """A problem whose outliers are moved to where they count no more than Huber's loss lets them.

    - `problem`: to be fitted by least squares; the noise levels are those of the residuals' medians.
    - `share`: of the measurements that were left as they are.
    - `residuals`: in the noise levels told, none beyond the cut; 0 where nothing was measured.
    """

    problem: ShootingProblem
    share: Scalar
    residuals: Float[Array, "samples columns"]


@eqx.filter_jit
def winsorised(problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"]) -> Winsorised:
    """Measurements whose residual at a fit is beyond 1.345 standard deviations, moved to there.

    Fitted by least squares and repeated, this is Huber's estimate by his method of modified residuals (Huber, Robust
    Statistics, section 7.8). The noise of each channel is told by the median of its residuals, which outliers move
    little; a channel that was not measured keeps its own.
    """
    measured, sigma = problem.measured(), problem.sigma[problem.columns]
    errors = problem.residuals(parameters, initial_state).reshape(measured.shape) * sigma
    there = ~jnp.isnan(measured)
    medians = jnp.nanmedian(jnp.where(there, jnp.abs(errors), jnp.nan), axis=0)
    scale = jnp.where(there.sum(axis=0) > 1, medians / _MEDIAN, sigma)
    scale = jnp.where((scale > 0) & jnp.isfinite(scale), scale, sigma)
    cut = jnp.clip(errors, -CUT * scale, CUT * scale)
    share = (there & (cut == errors)).sum() / jnp.maximum(there.sum(), 1)
    channels = problem.flight.channels.at[:, problem.columns].add(cut - errors)
    states, force = channels[:, : len(STATE_NAMES)], channels[:, len(STATE_NAMES) :]
    has_force = problem.flight.specific_force is not None
    return Winsorised(
        eqx.tree_at(
            lambda p: (p.flight.states, p.sigma) + ((p.flight.specific_force,) if has_force else ()),
            problem,
            (states, problem.sigma.at[problem.columns].set(scale)) + ((force,) if has_force else ()),
        ),
        share,
        jnp.where(there, cut / scale, 0.0),
    )
