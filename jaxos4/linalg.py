"""Factors and inverses of small positive semidefinite matrices, in plain operations that vectorise over lanes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def joint_factor(information: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """For each window A, with A A^T the inverse of the covariance of its unknowns when those of all are unknown.

    The first `count` unknowns are shared by all windows, the others are each window's own. A window's own come first in
    a Cholesky factorisation, in which the Schur complements of all windows are summed: block elimination, in time
    linear in the windows, and nothing is subtracted that single precision would lose. The last `count` columns of A
    hold the factor of what is shared.
    """
    size = information.shape[-1]
    own = size - count
    order, back = jnp.roll(jnp.arange(size), -count), jnp.roll(jnp.arange(size), count)
    shared = information[:, :count, :count].sum(axis=0)
    diagonal = jax.vmap(jnp.diagonal)(information).at[:, :count].set(jnp.diagonal(shared))
    scale = _scale(diagonal)[:, order]
    unit = information[:, order][:, :, order] / (scale[:, :, None] * scale[:, None, :])
    rest, first = jax.vmap(lambda matrix: _eliminate(matrix, own))(unit)
    _, last = _eliminate(rest[:, own:, own:].sum(axis=0), count, floor=size)
    last = jnp.broadcast_to(jnp.pad(last, ((own, 0), (0, 0))), (information.shape[0], size, count))
    return (scale[:, :, None] * jnp.concatenate([first, last], axis=-1))[:, back]


def covariances(information: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """For each window the covariance of its unknowns, of which the first `count` are shared by all windows.

    A direction without information gets a variance that is huge, not negative or infinite.
    """
    basis = inverse_transpose(joint_factor(information, count), count)
    return (basis[:, :, None, :] * basis[:, None, :, :]).sum(axis=-1)


def covariance_of_shared(information: Float[Array, "windows n n"], count: int) -> Float[Array, "count count"]:
    """The covariance of the first `count` unknowns, which all windows share, when the others are unknown too."""
    inverse = invert_factor(joint_factor(information, count)[0, :count, -count:])
    return (inverse[:, :, None] * inverse[:, None, :]).sum(axis=0)


def inverse_transpose(factor: Float[Array, "windows n n"], count: int) -> Float[Array, "windows n n"]:
    """A^-T of each factor A that `joint_factor` made: its columns are directions of unit information."""
    size = factor.shape[-1]
    order, back = jnp.roll(jnp.arange(size), -count), jnp.roll(jnp.arange(size), count)
    return jnp.swapaxes(jax.vmap(invert_factor)(factor[:, order]), 1, 2)[:, back]


def invert(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a symmetric positive semidefinite matrix, whatever its units and with a floor on its pivots.

    A direction without information gets a variance that is huge, not negative or infinite.
    """
    return covariance_of_shared(information[None], information.shape[0])


def cholesky(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular L with L L^T = `information`, where a pivot that is lost in rounding is taken as rounding.

    In plain operations, as `invert_factor` is: they vectorise over a batch of small matrices, while LAPACK's batched
    kernels inside a loop can wait for one another for ever on a CPU (seen with jaxlib 0.10 and 512 lanes).
    """
    scale = _scale(jnp.diagonal(information))
    _, factor = _eliminate(information / (scale[:, None] * scale[None, :]), information.shape[0])
    return scale[:, None] * factor


def _scale(diagonal: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """What makes a diagonal one of ones, where it is not 0."""
    return jnp.where(diagonal > 0, jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)


def _eliminate(
    matrix: Float[Array, "n n"], columns: int, *, floor: int | None = None
) -> tuple[Float[Array, "n n"], Float[Array, "n columns"]]:
    """The first columns of the Cholesky factor of a matrix with a unit diagonal, and what they leave to the others.

    `floor`: of the pivots, in rounding errors; the size of the matrix by default.
    """
    size = matrix.shape[0]
    least = jnp.finfo(matrix.dtype).eps * (floor or size)

    def eliminate_column(k, carry):
        rest, factor = carry
        pivot = jnp.sqrt(jnp.maximum(rest[k, k], least))
        column = jnp.where(jnp.arange(size) > k, rest[:, k] / pivot, 0.0).at[k].set(pivot)
        return rest - column[:, None] * column[None, :], factor.at[:, k].set(column)

    nothing = jnp.zeros((size, columns), matrix.dtype)
    return jax.lax.fori_loop(0, columns, eliminate_column, (matrix, nothing)) if columns else (matrix, nothing)


def invert_factor(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a lower triangular matrix, by forward substitution."""
    identity = jnp.eye(factor.shape[0], dtype=factor.dtype)

    def solve_row(i, inverse):
        return inverse.at[i].set((identity[i] - (factor[i][:, None] * inverse).sum(axis=0)) / factor[i, i])

    return jax.lax.fori_loop(0, factor.shape[0], solve_row, jnp.zeros_like(factor))
