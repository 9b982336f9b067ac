"""The directions along which a sweep bisects: the columns of a `basis`.

The whitened directions are those of `linalg.joint_factor`: the cost is nearly separable along them.

The unknowns of a window are the parameters, which all windows share, then its own initial state. Directions are in the
opposite order: those of the initial state come first, so that a step along a parameter carries the initial states to
where they fit best.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...linalg import JointFactor


def unknown_of_each(size: int, count: int) -> Int[np.ndarray, " size"]:
    """The unknown to which each direction belongs. The first `count` unknowns are the parameters."""
    return np.roll(np.arange(size), -count)


def coordinate_directions(information: Float[Array, "windows n n"], count: int) -> JointFactor:
    """The unknowns themselves as directions, each scaled to unit information: the diagonal of A, and of A^-T."""
    size = information.shape[-1]
    diagonal = jnp.diagonal(information, axis1=1, axis2=2)
    scale = jnp.sqrt(jnp.where(np.arange(size) < count, diagonal.sum(axis=0), diagonal))[:, :, None]
    columns = jnp.eye(size)[:, unknown_of_each(size, count)]
    return JointFactor(scale * columns, columns / scale)
