"""A search in stages: the body rates of a short part of the flight first, then more.

Rates do not depend on attitude and position, so they are fitted first. Errors grow with time, which gives the cost of a
long flight other minima, so the first stages are short.
"""

import functools
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..models.state import CHANNELS
from .abstract import LocalModel, Stages, WindowUnknowns
from .scans import Length, Rows, each_window

if TYPE_CHECKING:
    from .problem import ShootingProblem

# Rounding errors add up over a flight, to about this many times the rounding of one measurement.
ROUNDING = 64.0


def stages_of(problem: "ShootingProblem", shares: tuple[float, ...]) -> Stages:
    """The stages of a problem; the last fits the whole flight.

    `shares`: the body rates are first fitted to these shares of the flight. If there are several windows, only a share
    of 1 counts, because windows are short enough. All stages compare specific force.
    """
    wanted = (share for share in shares if share == 1 or problem.windows == 1)
    rates = tuple(("rates", share) for share in wanted if (problem.channels, share) != ("rates", 1))
    stages, count = (*rates, (problem.channels, 1.0)), problem.unknowns.count
    names = tuple(dict.fromkeys(name for name, _ in stages))
    place = jnp.asarray([names.index(name) for name, _ in stages])
    sizes = np.array([CHANNELS[name] for name, _ in stages])
    measured, sigma = problem.measured(), problem.sigma[problem.columns]
    samples, columns = measured.shape[0], np.arange(measured.shape[1])
    fitted = (columns < sizes[:, None]) | (columns >= problem.size)
    lengths = jnp.ceil(
        np.array([share for _, share in stages]) * (samples if problem.length is None else problem.length)
    ).astype(int)
    within = (jnp.arange(samples) < lengths[:, None]).astype(float)
    known, eps = within @ (~jnp.isnan(measured)).astype(float), jnp.finfo(sigma.dtype).eps
    squares = (within @ jnp.square(jnp.nan_to_num(measured))) / jnp.maximum(known, 1)
    largest = jnp.where(fitted, jnp.sqrt(squares) / sigma, 0.0).max(axis=1)
    free = jnp.broadcast_to(problem.unknowns.free, (len(stages), count))
    searched = jnp.concatenate([free, np.arange(problem.free_size) < sizes[:, None]], axis=1)
    forced, first = problem.forced_rows(), problem.split(problem.first_state()[0])
    parts = [functools.partial(_model_of_part, problem, problem.restrict(channels)) for channels in names]
    are_whole = all(share == 1 for _, share in stages)

    def local_model(stage: Int[Array, ""], before: WindowUnknowns, unknowns: WindowUnknowns) -> LocalModel:
        del before
        length = problem.length if are_whole else lengths[stage]
        own = unknowns[:, count:] if problem.free_size else first
        data = forced(unknowns[0, :count]), unknowns[:, :count], own, length
        # The stage is the same in all lanes of a batch.
        model = parts[0](*data) if len(parts) == 1 else jax.lax.switch(place[stage], parts, *data)
        return model.restricted(searched[stage])

    return Stages(
        unknowns=problem.unknowns,
        off=problem.initial_guess.off,
        number=len(stages),
        first=0,
        whole=len(stages) - 1,
        local_model=local_model,
        searched=searched,
        measurements=jnp.where(fitted, known, 0.0).sum(axis=1),
        smallest_step=jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * largest),
    )


def _model_of_part(
    problem: "ShootingProblem", part: "ShootingProblem", rows: Rows, parameters: Array, own: Array, length: Length
) -> LocalModel:
    """The local model of the whole problem's `rows`, on the channels of `part` but in all unknowns."""
    part = eqx.tree_at(lambda p: p.length, part, length, is_leaf=lambda leaf: leaf is None)
    compared = rows._replace(measured=rows.measured[: part.size] + rows.measured[problem.size :])
    model = each_window(part.model_of_window, compared, parameters, own[:, : part.size])
    none, more = (0, 0), (0, problem.free_size - part.free_size)
    gradient, information = jnp.pad(model.gradient, (none, more)), jnp.pad(model.information, (none, more, more))
    return model._replace(gradient=gradient, information=information)
