"""Factors and inverses of small symmetric positive semidefinite matrices: information and covariance matrices.

All functions use plain operations in loops. They vectorise over a batch of small matrices, while LAPACK's batched
kernels inside a loop can deadlock on a CPU (seen with jaxlib 0.10 and 512 lanes). A direction without information gets
a variance that is huge, but neither infinite nor negative.

**Windows.** Each window of a flight has an information matrix (n, n). Its first `count` unknowns are the parameters,
which all windows share; the others are the initial state of that window. The time is linear in the number of windows.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def joint_factor(information: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """A factor A of the joint information of each window: A A^T is the inverse of its covariance.

    The covariance is that of the window's unknowns when those of all windows are estimated together. The last `count`
    columns of A hold the factor for the shared unknowns. Each window's own unknowns are eliminated first, and the
    remaining Schur complements are summed: no subtraction loses digits in single precision.
    """
    size, own = information.shape[-1], information.shape[-1] - count
    own_first, shared_first = _orders(size, count)
    shared = information[:, :count, :count].sum(axis=0)
    diagonal = jax.vmap(jnp.diagonal)(information).at[:, :count].set(jnp.diagonal(shared))
    scale = _scale(diagonal)[:, own_first]
    unit = information[:, own_first][:, :, own_first] / (scale[:, :, None] * scale[:, None, :])
    remaining, first = jax.vmap(lambda matrix: _eliminate(matrix, own))(unit)
    _, last = _eliminate(remaining[:, own:, own:].sum(axis=0), count, floor=size)
    last = jnp.broadcast_to(jnp.pad(last, ((own, 0), (0, 0))), (information.shape[0], size, count))
    return (scale[:, :, None] * jnp.concatenate([first, last], axis=-1))[:, shared_first]


def inverse_transpose(factor: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """A^-T of each factor A from `joint_factor`. Its columns are directions of unit information."""
    own_first, shared_first = _orders(factor.shape[-1], count)
    return jnp.swapaxes(jax.vmap(invert_factor)(factor[:, own_first]), 1, 2)[:, shared_first]


def covariances(information: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """The covariance of each window's unknowns, when the unknowns of all windows are estimated together."""
    basis = inverse_transpose(joint_factor(information, count), count)
    return (basis[:, :, None, :] * basis[:, None, :, :]).sum(axis=-1)


def covariance_of_shared(information: Float[Array, "windows n n"], count: int) -> Float[Array, "count count"]:
    """The covariance of the `count` shared unknowns, when the unknowns of all windows are estimated together."""
    inverse = invert_factor(joint_factor(information, count)[0, :count, -count:])
    return (inverse[:, :, None] * inverse[:, None, :]).sum(axis=0)


def invert(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a symmetric positive semidefinite matrix, whatever the units of its rows."""
    return covariance_of_shared(information[None], information.shape[0])


def cholesky(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular L with L L^T = `information`. Pivots have a floor at the size of rounding errors."""
    scale = _scale(jnp.diagonal(information))
    _, factor = _eliminate(information / (scale[:, None] * scale[None, :]), information.shape[0])
    return scale[:, None] * factor


def invert_factor(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a lower triangular matrix, by forward substitution."""
    identity = jnp.eye(factor.shape[0], dtype=factor.dtype)

    def solve_row(i, inverse):
        return inverse.at[i].set((identity[i] - (factor[i][:, None] * inverse).sum(axis=0)) / factor[i, i])

    return jax.lax.fori_loop(0, factor.shape[0], solve_row, jnp.zeros_like(factor))


def _orders(size: int, count: int) -> tuple[Array, Array]:
    """Indices that put each window's own unknowns first, and indices that put the shared ones first again."""
    return jnp.roll(jnp.arange(size), -count), jnp.roll(jnp.arange(size), count)


def _scale(diagonal: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """The roots of a diagonal, by which a matrix is scaled to a unit diagonal; 1 for an entry of 0."""
    return jnp.where(diagonal > 0, jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)


def _eliminate(
    matrix: Float[Array, "n n"], columns: int, *, floor: int | None = None
) -> tuple[Float[Array, "n n"], Float[Array, "n columns"]]:
    """The first `columns` steps of a Cholesky factorisation of a matrix with a unit diagonal.

    Returns the Schur complement and the columns of the factor. `floor`: the smallest squared pivot, in rounding errors;
    the size of the matrix by default.
    """
    size = matrix.shape[0]
    least = jnp.finfo(matrix.dtype).eps * (floor or size)

    def eliminate_column(k, carry):
        remaining, factor = carry
        pivot = jnp.sqrt(jnp.maximum(remaining[k, k], least))
        column = jnp.where(jnp.arange(size) > k, remaining[:, k] / pivot, 0.0).at[k].set(pivot)
        return remaining - column[:, None] * column[None, :], factor.at[:, k].set(column)

    start = jnp.zeros((size, columns), matrix.dtype)
    return jax.lax.fori_loop(0, columns, eliminate_column, (matrix, start)) if columns else (matrix, start)
