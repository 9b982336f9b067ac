"""Factors and inverses of small symmetric positive semidefinite matrices: information and covariance matrices.

Plain operations in one loop vectorise over a batch, and LAPACK's batched kernels in a loop can deadlock on a CPU (seen
with jaxlib 0.10). A direction without information gets a huge variance, neither infinite nor negative.

**Windows.** Each has an information matrix (n, n), in the `count` parameters that all windows share, and then in its
own initial state. The time is linear in the number of windows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

PerWindow = Float[Array, "windows n"]


class JointFactor(NamedTuple):
    """A factor L of the information L L^T of each window, and its `basis` L^-T: directions of unit information."""

    factor: Float[Array, "windows n n"]
    basis: Float[Array, "windows n n"]


def joint_factor(information: Float[Array, "windows n n"], count: int) -> JointFactor:
    """A factor of the joint information of each window: L L^T is the inverse of its covariance among all windows.

    The last `count` columns of L are for the shared unknowns. Each window's own unknowns are eliminated first, and the
    Schur complements summed: no subtraction loses digits in single precision.
    """
    windows, size, _ = information.shape
    own, places = size - count, np.arange(size)
    order = np.roll(places, -count)  # each window's own unknowns first
    shared = (places[:, None] >= own) & (places >= own)
    diagonal = jnp.diagonal(information, axis1=1, axis2=2)
    diagonal = jnp.where(places < count, diagonal.sum(axis=0), diagonal)
    scale = jnp.where(diagonal > 0, jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)
    unit = (information / (scale[:, :, None] * scale[:, None, :]))[:, order[:, None], order]
    identity = jnp.broadcast_to(jnp.eye(size, dtype=unit.dtype), unit.shape)
    floor = size * jnp.finfo(unit.dtype).eps  # the smallest squared pivot: rounding errors

    def eliminate(k, carry):
        """One step of the Cholesky factorisation, with the same step on the rows of the identity beside the matrix."""
        remaining, inverse = carry
        if windows > 1:
            remaining = jnp.where(shared & (k == own), remaining.sum(axis=0), remaining)
        row, beside = remaining[:, k], inverse[:, k]
        pivot = jnp.sqrt(jnp.maximum(row[:, k], floor))[:, None]
        row, beside = jnp.where(places == k, pivot, row / pivot), beside / pivot
        below = jnp.where(places > k, row, 0.0)[:, :, None]
        here = (places == k)[:, None]
        remaining = jnp.where(here, row[:, None], remaining - below * row[:, None])
        return remaining, jnp.where(here, beside[:, None], inverse - below * beside[:, None])

    upper, inverse = jax.lax.fori_loop(0, size, eliminate, (unit, identity))
    back = np.roll(places, count)
    factor = scale[:, :, None] * jnp.swapaxes(jnp.triu(upper), 1, 2)[:, back]
    return JointFactor(factor, jnp.swapaxes(inverse, 1, 2)[:, back] / scale[:, :, None])


def slopes_along(
    basis: Float[Array, "windows unknowns n"], gradient: Float[Array, "windows unknowns"], count: int
) -> PerWindow:
    """The slope along each column of `basis`: summed over the windows along the last `count` columns."""
    slopes, own = jnp.einsum("wud,wu->wd", basis, gradient), gradient.shape[1] - count
    return slopes.at[:, own:].set(slopes[:, own:].sum(axis=0))


def movable(
    unknowns: PerWindow, gradient: PerWindow, limits: tuple[PerWindow, PerWindow], count: int
) -> Bool[Array, "windows n"]:
    """The unknowns that a search may move: not those at one of their limits, beyond which the cost falls."""
    total = gradient.at[:, :count].set(gradient[:, :count].sum(axis=0))
    return ~(((unknowns <= limits[0]) & (total > 0)) | ((unknowns >= limits[1]) & (total < 0)))


def limited(
    step: PerWindow, basis: Float[Array, "windows n n"], room: tuple[PerWindow, PerWindow], count: int
) -> PerWindow:
    """A step, low on a quadratic, within the `room` below and above each of the `count` shared unknowns.

    The unknown that exceeds its room by the largest factor goes to its limit and stays there, and all others go to the
    minimum that remains, until none exceeds its room. So this is not always the lowest point within the limits, and it
    may, rarely, lie above the start.

    `step`: to the minimum without limits. `basis`: see `joint_factor`.
    """
    shared = basis[:, :, basis.shape[2] - count :]
    # The covariance of all unknowns with the shared ones. A matrix product would not become part of a native loop.
    covariance = (shared[:, :, None] * shared[0, :count]).sum(axis=3)
    (low, high), place = (limit[0, :count] for limit in room), np.arange(count)

    def exceeds(step: PerWindow, at_limit: Bool[Array, " count"]) -> Bool[Array, " count"]:
        own = step[0, :count]
        return ((own < low) | (own > high)) & ~at_limit

    def go_to_limit(carry: tuple) -> tuple:
        step, covariance, at_limit = carry
        own, outside = step[0, :count], exceeds(step, at_limit)
        limit = jnp.clip(own, low, high)
        excess = jnp.where(outside, jnp.abs(own) / jnp.maximum(jnp.abs(limit), jnp.finfo(own.dtype).tiny), 0.0)
        i = jnp.where(outside & (excess >= excess.max()), place, count).min()
        here, row = place == i, np.arange(covariance.shape[1])[:, None] == i
        column = jnp.where(here, covariance, 0.0).sum(axis=2)
        variance, off = jnp.where(here, column[0, :count], 0.0).sum(), jnp.where(here, limit - own, 0.0).sum()
        slope = column / jnp.where(variance > 0, variance, 1.0)
        covariance = jnp.where(here | row, 0.0, covariance - slope[:, :, None] * column[0, :count])
        step = step + slope * off
        return step.at[:, :count].set(jnp.where(here, limit, step[:, :count])), covariance, at_limit | here

    first = step, covariance, jnp.zeros(count, dtype=bool)
    return jax.lax.while_loop(lambda carry: exceeds(carry[0], carry[2]).any(), go_to_limit, first)[0]


def room_to_limits(
    unknowns: PerWindow, basis: Float[Array, "windows n n"], limits: tuple[PerWindow, PerWindow]
) -> tuple[PerWindow, PerWindow]:
    """How far each window can go against and along each direction until an unknown reaches its limit."""
    moves = basis != 0
    to_lower, to_upper = ((limit - unknowns)[:, :, None] / jnp.where(moves, basis, 1.0) for limit in limits)
    above = jnp.where(moves, jnp.maximum(to_lower, to_upper), jnp.inf).min(axis=1)
    below = jnp.where(moves, -jnp.minimum(to_lower, to_upper), jnp.inf).min(axis=1)
    return jnp.maximum(below, 0.0), jnp.maximum(above, 0.0)


def covariance_of_shared(information: Float[Array, "windows n n"], count: int) -> Float[Array, "count count"]:
    """The covariance of the `count` shared unknowns, when the unknowns of all windows are estimated together."""
    return gram(joint_factor(information, count).basis[0, :count, -count:])


def invert(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a symmetric positive semidefinite matrix, whatever the units of its rows."""
    return gram(unit_directions(information))


def unit_directions(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A matrix B whose columns are directions of unit information: B B^T is the inverse, and B is upper triangular."""
    return joint_factor(information[None], information.shape[0]).basis[0]


def inverses(information: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """The inverses of symmetric positive semidefinite matrices, whatever the units of their rows. NumPy."""
    scale, values, vectors = unit_eigen(information)
    unit = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return unit / scale[..., :, None] / scale[..., None, :]


def unit_eigen(
    matrix: Float[np.ndarray, "*batch n n"],
) -> tuple[Float[np.ndarray, "*batch n"], Float[np.ndarray, "*batch n"], Float[np.ndarray, "*batch n n"]]:
    """The scale that makes the diagonal 1, and eigenvalues and eigenvectors of the scaled matrix.

    An eigenvalue below the rounding errors counts as large as these.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where((diagonal > 0) & np.isfinite(diagonal), diagonal, 1.0))
    unit = matrix / scale[..., :, None] / scale[..., None, :]
    values, vectors = np.linalg.eigh(np.where(np.isfinite(unit), unit, 0.0))
    return scale, np.maximum(values, values.shape[-1] * np.finfo(float).eps), vectors


def covariance_root(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A matrix B with B B^T = covariance, which may be singular, whatever the units of its rows."""
    std = np.sqrt(np.diagonal(covariance))
    scale = np.where(std > 0, std, 1.0)
    spread, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * axes * np.sqrt(np.maximum(spread, 0.0))


def gram(matrix: Float[Array, "*batch n m"]) -> Float[Array, "*batch n n"]:
    """M M^T of each matrix M, in plain operations."""
    return (matrix[..., :, None, :] * matrix[..., None, :, :]).sum(axis=-1)
