"""The directions along which a sweep bisects."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...linalg import JointFactor, joint_factor


def whitened_directions(
    information: Float[Array, "windows n n"], count: int, forcing_parameters: tuple[int, ...]
) -> JointFactor:
    """A factor A of the information A A^T, and the directions: the columns of A^-T, along which the cost is separable.

    The first `count` unknowns are the parameters, which all windows share. The columns of the initial state come first,
    so that a step along a parameter carries the initial states to where they fit best. The columns of
    `forcing_parameters`, the parameters that the forcing depends on, come last: no other direction changes the forcing.
    """
    if not forcing_parameters:
        return joint_factor(information, count)
    others = np.delete(np.arange(information.shape[-1]), forcing_parameters)
    free = count - len(forcing_parameters)
    order = np.concatenate([others[:free], forcing_parameters, others[free:]])
    factor, basis = joint_factor(information[:, order[:, None], order], count)
    back = np.argsort(order)
    return JointFactor(factor[:, back], basis[:, back])


def coordinate_directions(information: Float[Array, "windows n n"], count: int) -> JointFactor:
    """The unknowns themselves as directions, each scaled to unit information: the diagonal of A, and of A^-T."""
    size = information.shape[-1]
    diagonal = jax.vmap(jnp.diagonal)(information)
    scale = jnp.sqrt(diagonal.at[:, :count].set(diagonal[:, :count].sum(axis=0)))
    columns = jnp.eye(size)[:, jnp.roll(jnp.arange(size), -count)]
    return JointFactor(scale[:, :, None] * columns, columns / scale[:, :, None])
