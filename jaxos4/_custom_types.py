"""Shapes that public signatures share, and the converters and checks of fields."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, SupportsFloat, get_type_hints

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray, jaxtyped

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
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class Arrays(msgspec.Struct, frozen=True, eq=False):
    """Arrays that a file holds by name. Raises `ValueError` unless they have the shapes of their annotations."""

    def __post_init__(self):
        with jaxtyped("context"):  # a length has one name in all of them
            for name, kind in get_type_hints(type(self)).items():
                if not isinstance(getattr(self, name), kind):
                    raise ValueError(f"`{name}` has another shape than the arrays beside it")


def finite_or_none(value: SupportsFloat) -> float | None:
    """A number, or `None` if it is not finite."""
    return float(value) if math.isfinite(float(value)) else None


def as_list(array: np.ndarray) -> list[Any]:
    """An array as lists, for `enc_hook` of msgspec; `None` for what is not finite."""
    values = array.astype(object)
    values[~np.isfinite(array)] = None
    return values.tolist()


def as_array(kind: Any, values: Any) -> np.ndarray:
    """The array of a field of `Arrays` from lists of numbers. Raises `ValueError`.

    A missing number is NaN. An array without rows has the number of axes of the field, with the lengths that are known.
    """
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError("is not an array of numbers") from None
    if "int64" in kind.dtypes:
        whole = np.where(np.abs(array) < 1 << 40, array, -1).astype(int)
        if (whole != array).any():
            raise ValueError("is not an array of whole numbers")
        array = whole
    _, *others = kind.dim_str.split()
    lengths = [int(axis) if axis.isdigit() else 0 for axis in others]
    return array.reshape(0, *lengths) if array.shape == (0,) else array


def as_float(x: ArrayLike) -> Array:
    """Convert to a strongly typed array of the default float type, so that equal shapes share one compiled program."""
    if isinstance(x, np.ndarray | np.generic | float | int):  # without the program that `jnp.asarray` compiles
        return _constant(x, float)
    return jnp.asarray(x, dtype=float)


def _constant(x: ArrayLike, kind: type) -> Array:
    with jax.ensure_compile_time_eval():  # its value is known, also while a function is traced
        return jax.device_put(np.asarray(x, dtype=jax.dtypes.canonicalize_dtype(kind)))


def as_constant(x: Any) -> Array | np.ndarray:
    """Keep a constant as a double in NumPy until it is used: at import, the user has chosen no precision yet."""
    return x if isinstance(x, jax.Array) else np.asarray(x, dtype=np.float64)


def setting(
    name: str,
    axes: Sequence[str] = (),
    *,
    low: float = 0.0,
    high: float = np.inf,
    positive: bool = False,
    finite: bool = True,
    optional: bool = False,
) -> Callable[[ArrayLike | Sequence[float] | None], Array]:
    """A field's converter: accepts one number, or one for each of `axes`, in a range unless traced.

    An `optional` setting can be `None`, which is stored as NaN.
    """

    def convert(value: ArrayLike | Sequence[float] | None) -> Array:
        value = np.nan if value is None else value
        array = as_float(np.asarray(value, dtype=float) if isinstance(value, Sequence) else value)
        if array.shape not in ((), (len(axes),) if axes else ()):
            several = f" or {len(axes)} ({', '.join(axes)})" if axes else "; use `vmap` for a batch"
            raise ValueError(f"`{name}` must be one number{several}, got shape {array.shape}.")
        if not isinstance(array, Tracer):
            numbers = np.asarray(array)
            allowed = (numbers >= low) & (numbers <= high) & ((numbers > 0) | (not positive))
            allowed &= np.isfinite(numbers) | (not finite)
            if not np.all(allowed | (np.isnan(numbers) & optional)):
                limits = ["positive"] * positive + ["finite"] * finite
                limits += [f"at least {low:g}"] * (low > -np.inf and not positive)
                limits += [f"at most {high:g}"] * (high < np.inf)
                raise ValueError(f"`{name}` must be {' and '.join(limits)}, got {numbers.tolist()}.")
        return jnp.broadcast_to(array, (len(axes),)) if axes else array

    return convert


def integer(name: str, least: int, *, static: bool = False) -> Callable[[Any], Any]:
    """A field's converter: accepts an integer from `least` on, or a traced one. Unless static, it becomes an array."""

    def convert(value: Any) -> Any:
        if isinstance(value, jax.Array | np.integer) and jnp.issubdtype(value.dtype, jnp.integer) and value.shape == ():
            if isinstance(value, Tracer):
                return value
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        if value > (most := 2**31 - 1):  # of the integers in single precision
            raise ValueError(f"`{name}` must be at most {most}, got {value}.")
        return value if static else _constant(value, int)

    return convert
