"""Look around: the cost's curvature where the search is, and how far the minimum seems to be."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._custom_types import Scalar
from ...shooting import Curvature, Rows
from .brackets import room
from .directions import coordinate_directions, whitened_directions
from .stage import Stage, misfit


class View(NamedTuple):
    """What the search sees from where it is.

    - `rows`: the flight's rows with the forcing of these parameters, and its derivatives.
    - `information`: of the flight and the prior together.
    - `factor`, `basis`: A with A A^T = information, and A^-T, whose columns are the directions.
    - `longest_step`: that the cost's quadratic model predicts within the limits [standard deviations].
    - `misfit`: root mean square of the weighted residuals.
    """

    unknowns: Float[Array, "windows unknowns"]
    rows: Rows
    curvature: Curvature
    information: Float[Array, "windows unknowns unknowns"]
    factor: Float[Array, "windows unknowns unknowns"]
    basis: Float[Array, "windows unknowns unknowns"]
    longest_step: Scalar
    misfit: Scalar


def look_around(stage: Stage, unknowns: Float[Array, "windows unknowns"], *, whitened: bool) -> View:
    """Simulates the flight with all its first derivatives, and predicts the steps to the minimum."""
    rows = stage.with_forcing(unknowns, tangents=True)
    curvature = stage.curvature(rows, unknowns)
    information = curvature.information + stage.prior
    directions = whitened_directions if whitened else coordinate_directions
    factor, basis = directions(information, stage.parameter_count, stage.problem.model.forcing_parameters)
    slopes = jnp.einsum("wud,wu->wd", basis, curvature.gradient)
    slopes = slopes.at[:, stage.problem.free_size :].set(slopes[:, stage.problem.free_size :].sum(axis=0))
    rooms = jax.vmap(lambda direction: room(unknowns, direction, stage.limits), -1, -1)(basis)
    longest_step = jnp.abs(jnp.clip(-slopes, -rooms[0], rooms[1])).max()
    noise = misfit(curvature.shot.cost.sum(), stage.measurements)
    return View(unknowns, rows, curvature, information, factor, basis, longest_step, noise)
