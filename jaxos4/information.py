"""What a flight can tell: Fisher information and the Cramer-Rao bound."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import Parameters
from .shooting import ShootingProblem


@eqx.filter_jit
def fisher_information(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " size"] | None = None
) -> Float[Array, "parameters parameters"]:
    """J^T W^2 J in the parameters, at `parameters`.

    Where the initial state is free it is eliminated (a Schur complement): what is left is what the flight tells about
    the parameters without knowing where it began.
    """
    start = problem.first_state()[0] if initial_state is None else initial_state
    information = problem.curvature(problem.rows(), parameters, start).information
    return eliminate(information, parameters.shape[0])


def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " size"] | None = None
) -> Float[Array, "parameters parameters"]:
    """The least covariance that an unbiased estimate can have: the inverse of `fisher_information`.

    Parameters that the flight does not tell have a variance that is huge, not infinite.
    """
    return invert(fisher_information(problem, parameters, initial_state))


def eliminate(information: Float[Array, "n n"], count: int) -> Float[Array, "count count"]:
    """The information in the first `count` unknowns when the others are unknown too."""
    if information.shape[0] == count:
        return information
    kept, cross, rest = information[:count, :count], information[:count, count:], information[count:, count:]
    return kept - cross @ invert(rest) @ cross.T


def invert(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a symmetric positive semidefinite matrix, whatever its units and with a floor on its eigenvalues.

    The matrix is first scaled to a unit diagonal; an eigenvalue below its rounding error is taken as that error, so
    that a direction without information gets a huge variance instead of a negative or infinite one.
    """
    diagonal = jnp.diagonal(information)
    scale = jnp.where(diagonal > 0, jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)
    values, vectors = jnp.linalg.eigh(information / (scale[:, None] * scale[None, :]))
    floor = jnp.finfo(information.dtype).eps * information.shape[0]
    return (vectors / jnp.maximum(values, floor)) @ vectors.T / (scale[:, None] * scale[None, :])
