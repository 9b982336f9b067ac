"""Shapes that public signatures share, and the converters of fields."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

Scalar = Float[Array, ""]
Count = Int[Array, ""]
Parameters = Float[Array, " parameters"]
Covariance = Float[Array, "parameters parameters"]
InitialStates = Float[Array, " starts"]
InitialState = Float[Array, " size"]
StateVector = Float[Array, "12"]
States = Float[Array, "samples 12"]
RotorSpeeds = Float[Array, "samples 4"]
Key = PRNGKeyArray
Numeric = Array | np.ndarray

LARGEST = 2**31 - 1  # of the integers in single precision


def as_float(x: ArrayLike) -> Array:
    """Convert to a strongly typed array of the default float type, so that equal shapes share one compiled program."""
    if isinstance(x, np.ndarray | np.generic | float | int):  # without the program that `jnp.asarray` compiles
        return _constant(x, float)
    return jnp.asarray(x, dtype=float)


def as_int(x: Any) -> Any:
    """Convert a setting that is an integer to an array, so that other values share the compiled program.

    Anything else stays as it is, also an integer beyond `LARGEST`.
    """
    if isinstance(x, bool) or not isinstance(x, int | np.integer) or abs(int(x)) > LARGEST:
        return x
    return _constant(x, int)


def _constant(x: ArrayLike, kind: type) -> Array:
    with jax.ensure_compile_time_eval():  # its value is known, also while a function is traced
        return jax.device_put(np.asarray(x, dtype=jax.dtypes.canonicalize_dtype(kind)))


def as_constant(x: Any) -> Array | np.ndarray:
    """Keep a physical constant as a NumPy array in double precision, until a computation uses it.

    JAX would round a module's constants at import, before the user has chosen a precision.
    """
    return x if isinstance(x, jax.Array) else np.asarray(x, dtype=np.float64)
