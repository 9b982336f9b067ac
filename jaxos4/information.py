"""What a flight can tell: Fisher information and the Cramer-Rao bound."""

import equinox as eqx
import jax
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
    """The inverse of a symmetric positive semidefinite matrix, whatever its units and with a floor on its pivots.

    A direction without information gets a variance that is huge, not negative or infinite.
    """
    inverse_factor = invert_factor(cholesky(information))
    return (inverse_factor[:, :, None] * inverse_factor[:, None, :]).sum(axis=0)


def cholesky(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular L with L L^T = `information`, where a pivot that is lost in rounding is taken as rounding.

    In plain operations, as `invert_factor` is: they vectorise over a batch of small matrices, while LAPACK's batched
    kernels inside a loop can wait for one another for ever on a CPU (seen with jaxlib 0.10 and 512 lanes).
    """
    count = information.shape[0]
    diagonal = jnp.diagonal(information)
    scale = jnp.where(diagonal > 0, jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)
    floor = jnp.finfo(information.dtype).eps * count

    def eliminate_column(k, carry):
        rest, factor = carry
        pivot = jnp.sqrt(jnp.maximum(rest[k, k], floor))
        column = jnp.where(jnp.arange(count) > k, rest[:, k] / pivot, 0.0).at[k].set(pivot)
        return rest - column[:, None] * column[None, :], factor.at[:, k].set(column)

    unit_diagonal = information / (scale[:, None] * scale[None, :])
    _, factor = jax.lax.fori_loop(0, count, eliminate_column, (unit_diagonal, jnp.zeros_like(information)))
    return scale[:, None] * factor


def invert_factor(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a lower triangular matrix, by forward substitution."""
    identity = jnp.eye(factor.shape[0], dtype=factor.dtype)

    def solve_row(i, inverse):
        return inverse.at[i].set((identity[i] - (factor[i][:, None] * inverse).sum(axis=0)) / factor[i, i])

    return jax.lax.fori_loop(0, factor.shape[0], solve_row, jnp.zeros_like(factor))
