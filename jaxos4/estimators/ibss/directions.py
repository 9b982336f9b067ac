"""The directions along which a sweep bisects."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...linalg import JointFactor, joint_factor


def sequence(size: int, count: int, forcing_parameters: tuple[int, ...]) -> Int[np.ndarray, " size"]:
    """The unknown to which each direction belongs.

    The first `count` unknowns are the parameters, which all windows share. The directions of the initial state come
    first, so that a step along a parameter carries the initial states to where they fit best. Those of
    `forcing_parameters`, the parameters that the forcing depends on, come last: no other direction changes the forcing.
    """
    others = np.delete(np.arange(count), forcing_parameters)
    return np.concatenate([np.arange(count, size), others, forcing_parameters]).astype(int)


def whitened_directions(
    information: Float[Array, "windows n n"], count: int, forcing_parameters: tuple[int, ...]
) -> JointFactor:
    """A factor A of the information A A^T, and the directions: the columns of A^-T, along which the cost is separable.

    The directions are in the order of `sequence`.
    """
    if not forcing_parameters:
        return joint_factor(information, count)
    size = information.shape[-1]
    order = np.roll(sequence(size, count, forcing_parameters), count)  # the parameters first
    factor, basis = joint_factor(information[:, order[:, None], order], count)
    back = np.argsort(order)
    return JointFactor(factor[:, back], basis[:, back])


def coordinate_directions(
    information: Float[Array, "windows n n"], count: int, forcing_parameters: tuple[int, ...]
) -> JointFactor:
    """The unknowns themselves as directions, each scaled to unit information: the diagonal of A, and of A^-T.

    The directions are in the order of `sequence`.
    """
    size = information.shape[-1]
    diagonal = jnp.diagonal(information, axis1=1, axis2=2)
    scale = jnp.sqrt(jnp.where(np.arange(size) < count, diagonal.sum(axis=0), diagonal))[:, :, None]
    columns = jnp.eye(size)[:, sequence(size, count, forcing_parameters)]
    return JointFactor(scale * columns, columns / scale)
