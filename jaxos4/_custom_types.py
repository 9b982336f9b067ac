"""Shapes that recur in public signatures, and the two conversions that fields use."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

Scalar = Float[Array, ""]
Parameters = Float[Array, " parameters"]
StateVector = Float[Array, "12"]
States = Float[Array, "samples 12"]
RotorSpeeds = Float[Array, "samples 4"]
Key = PRNGKeyArray
Numeric = Array | np.ndarray


def as_float(x: ArrayLike) -> Array:
    """A strongly typed array of the default floating type, so that equal shapes share one trace."""
    return jnp.asarray(x, dtype=float)


def as_constant(x: Any) -> Array | np.ndarray:
    """A physical constant: kept in double precision by NumPy until a computation rounds it to its own precision.

    A module constant made at import would otherwise be rounded before the user had chosen a precision.
    """
    return x if isinstance(x, jax.Array) else np.asarray(x, dtype=np.float64)
