"""A bracket: for each parameter the interval in which it is expected."""

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from ._custom_types import Numeric, Parameters, as_float
from .models.abstract import AbstractModel

# The largest standard deviation of an identifiable parameter, in half-widths, by how the bracket is used.
NO_PRIOR = 1.0  # a region to search: the flight must contain more information than the bracket
GAUSSIAN_PRIOR = 0.5**0.5  # a prior with a standard deviation of 1: the flight must tell at least as much
UNIFORM_PRIOR = 0.5  # a prior with a standard deviation of 0.577
PROPER_PRIOR = float("inf")  # a prior of the likelihood itself, which has an answer for every parameter


def is_identifiable(
    std: Float[ArrayLike, "*parameters"], half_width: Float[ArrayLike, "*parameters"], largest_std: float = NO_PRIOR
) -> Bool[Numeric, "*parameters"]:
    """The rule: a parameter is identifiable if its standard deviation is at most `largest_std`.

    `largest_std`: in half-widths of its bracket, by how the estimator used it: `NO_PRIOR`, `GAUSSIAN_PRIOR`,
    `UNIFORM_PRIOR` or `PROPER_PRIOR`.
    """
    return std <= largest_std * half_width  # type: ignore[return-value]


class Bracket(eqx.Module):
    """An interval from `lower` to `upper` for each parameter, in the parameter's unit."""

    lower: Parameters = eqx.field(converter=as_float)
    upper: Parameters = eqx.field(converter=as_float)

    def __check_init__(self):
        if self.lower.shape != self.upper.shape or self.lower.ndim != 1:
            raise ValueError(
                "`lower` and `upper` must be one-dimensional and of one shape, "
                f"got {self.lower.shape} and {self.upper.shape}."
            )

    @classmethod
    def around(cls, center: Float[ArrayLike, " parameters"], half_width: Float[ArrayLike, " parameters"]) -> "Bracket":
        """The bracket from `center - half_width` to `center + half_width`."""
        middle, reach = _numpy_if_known(as_float(center), as_float(half_width))
        with np.errstate(all="ignore"):  # infinite ends, as JAX has them
            return cls(middle - reach, middle + reach)

    @classmethod
    def default(cls, model: AbstractModel) -> "Bracket":
        """The bracket around `model.alpha`, with the model's half-widths."""
        return _default(model)

    @property
    def center(self) -> Parameters:
        """The middle of each interval."""
        lower, upper = _numpy_if_known(self.lower, self.upper)
        with np.errstate(all="ignore"):
            return as_float((lower + upper) / 2)

    @property
    def half_width(self) -> Parameters:
        """Half the length of each interval."""
        lower, upper = _numpy_if_known(self.lower, self.upper)
        with np.errstate(all="ignore"):
            return as_float((upper - lower) / 2)


def _numpy_if_known(a: Array, b: Array) -> tuple[Numeric, Numeric]:
    """Both arrays, as NumPy if their values are known: arithmetic then needs no compiled program."""
    return (a, b) if isinstance(a, Tracer) or isinstance(b, Tracer) else (np.asarray(a), np.asarray(b))


@eqx.filter_jit  # one compiled program instead of one for each operation
def _default(model: AbstractModel) -> Bracket:
    return Bracket.around(model.alpha, model.half_width)
