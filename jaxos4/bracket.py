"""Where the parameters are looked for: an interval for each."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ._custom_types import Parameters, as_float
from .models.abstract import AbstractModel

# How an estimator uses a bracket: the largest standard deviation of an identifiable parameter, in half-widths.
# Only where to search: the flight must tell more than the bracket did.
NO_PRIOR = 1.0
# As a Gaussian prior of one half-width: the flight must tell at least as much as the prior.
GAUSSIAN_PRIOR = 0.5**0.5
# As a uniform prior, whose standard deviation is 0.577 half-widths.
UNIFORM_PRIOR = 0.5


class Bracket(eqx.Module):
    """An interval for each parameter, in the parameter's unit."""

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
        center, half_width = as_float(center), as_float(half_width)
        return cls(center - half_width, center + half_width)

    @classmethod
    def default(cls, model: AbstractModel) -> "Bracket":
        """The model's own half-widths around the parameters that its airframe implies."""
        return _default(model)

    @property
    def center(self) -> Parameters:
        """The middle of each interval."""
        return (self.lower + self.upper) / 2

    @property
    def half_width(self) -> Parameters:
        """Half the length of each interval."""
        return (self.upper - self.lower) / 2

    @property
    def valid(self) -> Bool[Array, ""]:
        """Whether every interval is finite and has its lower end below its upper one."""
        width = self.upper - self.lower
        return ((width > 0) & (width < float("inf"))).all()

    def identifies(self, std: Float[ArrayLike, " parameters"], prior: float = NO_PRIOR) -> Bool[Array, " parameters"]:
        """Whether each parameter is identifiable: its standard deviation is finite and small against the bracket.

        **Arguments:**

        - `std`: of each parameter, in its unit.
        - `prior`: how the estimator used the bracket: `NO_PRIOR`, `GAUSSIAN_PRIOR` or `UNIFORM_PRIOR`.
        """
        return as_float(std) <= prior * self.half_width

    @property
    def usable(self) -> "Bracket":
        """Itself where it is valid, else 0 +- 1: what a computation that must stay finite goes on with."""
        return Bracket.around(jnp.where(self.valid, self.center, 0.0), jnp.where(self.valid, self.half_width, 1.0))


@eqx.filter_jit  # one program, where its operations by themselves would each be one
def _default(model: AbstractModel) -> Bracket:
    return Bracket.around(model.alpha, model.half_width)
