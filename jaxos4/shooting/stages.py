"""The stages of a shooting problem: the rates of a short part of the flight first, then more.

Rates do not depend on attitude and position, so they are fitted first. Errors grow with time, so the cost of a long
flight has other minima, into one of which `CorrectedOS4` falls in a fifth of all cases: the first stages are short.
"""

import functools
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._custom_types import Scalar
from .abstract import Stages, WindowUnknowns
from .scans import Curvature, Rows, each_window

if TYPE_CHECKING:
    from .problem import ShootingProblem

# The rates are first fitted to these shares of a flight that is not cut into windows.
_SHARES = (0.1, 0.3)
# Rounding errors add up over a flight, to about this many times the rounding of one measurement.
ROUNDING = 64.0


def shooting_stages(problem: "ShootingProblem", *, cascade: bool) -> Stages:
    """The stages of a problem; without `cascade` the whole problem alone."""
    plan = _plan(problem, cascade=cascade)
    names, count = tuple(dict.fromkeys(channels for channels, _ in plan)), problem.unknowns.count
    parts = tuple(problem.restrict(channels) for channels in names)
    place = np.array([names.index(channels) for channels, _ in plan])
    fitted = np.array([np.isin(problem.columns, part.columns) for part in parts])[place]
    own = np.arange(problem.free_size) < np.array([part.free_size for part in parts])[place, None]
    searched = jnp.concatenate([jnp.broadcast_to(problem.unknowns.free, (len(plan), count)), own], axis=1)

    measured, eps = problem.measured(), jnp.finfo(problem.sigma.dtype).eps
    samples = measured.shape[0] if problem.length is None else problem.length
    lengths = jnp.ceil(np.array([share for _, share in plan]) * samples).astype(int)
    # Number and mean square of the measurements in each stage and column.
    within = (jnp.arange(measured.shape[0]) < lengths[:, None]).astype(float)
    known = within @ (~jnp.isnan(measured)).astype(float)
    squares = (within @ jnp.square(jnp.nan_to_num(measured))) / jnp.maximum(known, 1)
    largest = jnp.where(fitted, jnp.sqrt(squares) / problem.sigma[problem.columns], 0.0).max(axis=1)
    measurements = jnp.where(fitted, known, 0.0).sum(axis=1)
    forced, starts = problem.forced_rows(), problem.split(problem.first_state()[0])

    def on(part: "ShootingProblem", rows: Rows, length: Int[Array, ""] | None, unknowns: WindowUnknowns) -> Curvature:
        """The curvature on the channels of `part`, in all unknowns."""
        part = eqx.tree_at(lambda p: p.length, part, length, is_leaf=lambda leaf: leaf is None)
        compared = rows._replace(measured=rows.measured[: part.size] + rows.measured[problem.size :])
        own = unknowns[:, count : count + part.size] if part.free_size else starts[:, : part.size]
        shot, gradient, information, _ = each_window(part.curvature, compared, unknowns[:, :count], own)
        none, more = (0, 0), (0, unknowns.shape[1] - gradient.shape[1])
        return Curvature(shot, jnp.pad(gradient, (none, more)), jnp.pad(information, (none, more, more)))

    def evaluate(stage: Int[Array, ""], unknowns: WindowUnknowns) -> Curvature:
        rows = forced(unknowns[0, :count])
        length, free = lengths[stage] if problem.windows == 1 else None, searched[stage]
        branches = [functools.partial(on, part, rows, length) for part in parts]
        # The stage is the same in all lanes of a batch.
        chosen = branches[0](unknowns) if len(parts) == 1 else jax.lax.switch(place_of[stage], branches, unknowns)
        shot, gradient, information, _ = chosen
        return Curvature(shot, jnp.where(free, gradient, 0.0), jnp.where(free & free[:, None], information, 0.0))

    def misfit(stage: Int[Array, ""], cost: Scalar) -> Scalar:
        return jnp.sqrt(2 * cost / jnp.maximum(measurements[stage], 1))

    place_of = jnp.asarray(place)
    smallest_step = jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * largest)
    return Stages(len(plan), evaluate, searched, misfit, smallest_step)


def _plan(problem: "ShootingProblem", *, cascade: bool) -> tuple[tuple[str, float], ...]:
    """The channels of each stage, and the share of the flight that it fits."""
    everything = ((problem.channels, 1.0),)
    if not cascade:
        return everything
    shares = (*_SHARES, 1.0) if problem.windows == 1 else (1.0,)  # a window is short enough as it is
    rates = tuple(("rates", share) for share in shares)
    return rates if problem.channels == "rates" else rates + everything
