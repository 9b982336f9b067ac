"""Huber's robust loss: limits the influence of outliers on a fit."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import InitialStates, Parameters, Scalar
from ..flight import STATE_NAMES
from ..shooting import ShootingProblem

# Residuals are limited to this many standard deviations. With Gaussian noise the estimate keeps 95 % efficiency.
CUT = 1.345
# The median magnitude of Gaussian noise, in standard deviations.
_MEDIAN = 0.6745


class Winsorised(NamedTuple):
    """A problem whose outliers were moved towards the fit.

    - `problem`: to be fitted by least squares. Its noise levels come from the medians of the residuals.
    - `share`: the fraction of the measurements that did not move.
    - `residuals`: the limited residuals, in the new noise levels; 0 for missing measurements.
    """

    problem: ShootingProblem
    share: Scalar
    residuals: Float[Array, "samples columns"]


@eqx.filter_jit
def winsorised(problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates) -> Winsorised:
    """Move each measurement whose residual exceeds 1.345 standard deviations to 1.345 standard deviations.

    Repeat this and a least-squares fit until the parameters no longer change. The result is Huber's estimate by the
    method of modified residuals (Huber, Robust Statistics, section 7.8).

    **Arguments:** `parameters` and `initial_state` of a fit.
    """
    observed, sigma = problem.measured(), problem.sigma[problem.columns]
    errors = problem.residuals(parameters, initial_state).reshape(observed.shape) * sigma
    measured = ~jnp.isnan(observed)
    medians = jnp.nanmedian(jnp.where(measured, jnp.abs(errors), jnp.nan), axis=0)
    scale = jnp.where(measured.sum(axis=0) > 1, medians / _MEDIAN, sigma)
    scale = jnp.where((scale > 0) & jnp.isfinite(scale), scale, sigma)
    cut = jnp.clip(errors, -CUT * scale, CUT * scale)
    share = (measured & (cut == errors)).sum() / jnp.maximum(measured.sum(), 1)
    channels = problem.flight.channels.at[:, problem.columns].add(cut - errors)
    states, force = channels[:, : len(STATE_NAMES)], channels[:, len(STATE_NAMES) :]
    moved = problem.sigma.at[problem.columns].set(scale), states
    moved = eqx.tree_at(lambda p: (p.sigma, p.flight.states), problem, moved)
    if problem.flight.specific_force is not None:
        moved = eqx.tree_at(lambda p: p.flight.specific_force, moved, force)
    return Winsorised(moved, share, jnp.where(measured, cut / scale, 0.0))
