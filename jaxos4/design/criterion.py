"""How much a flight tells: one number of its information."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..linalg import gram, joint_factor

CRITERIA = ("D", "A", "worst")
# The largest bound is replaced by this norm of the bounds, which has derivatives.
_NORM = 16


def bounds_of(information: Float[Array, "unknowns unknowns"], count: int) -> tuple[Float[Array, "count count"], Scalar]:
    """The smallest covariance of the first `count` unknowns, and the logarithm of its determinant.

    The other unknowns are nuisances. They are estimated too, and eliminated by the Schur complement.
    """
    factor, basis = joint_factor(information[None], count)
    determinant = -2 * jnp.log(jnp.diagonal(factor[0, :count, -count:])).sum()
    return gram(basis[0, :count, -count:]), determinant


def criterion_of(
    information: Float[Array, "unknowns unknowns"], half_width: Float[Array, " count"], criterion: str
) -> Scalar:
    """The logarithm of a mean relative bound of the first unknowns. An input is better if it is smaller.

    A bound is a standard deviation as a share of the `half_width` of its parameter's bracket.

    - `"D"`: the volume of the confidence ellipsoid, as the edge of a cube of that volume.
    - `"A"`: the root of the mean of the squared bounds.
    - `"worst"`: the largest bound.
    """
    count = half_width.shape[0]
    covariance, determinant = bounds_of(information, count)
    if criterion == "D":
        return (determinant / 2 - jnp.log(half_width).sum()) / count
    squares = jnp.diagonal(covariance) / jnp.square(half_width)
    if criterion == "A":
        return jnp.log(squares.mean()) / 2
    largest = squares.max()
    return jnp.log(largest) / 2 + jnp.log(((squares / largest) ** (_NORM / 2)).sum()) / _NORM
