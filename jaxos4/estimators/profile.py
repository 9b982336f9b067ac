"""Profile likelihood: how much worse the best fit gets where one parameter is held away from its estimate."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters, RotorSpeeds, Scalar, as_float
from ..airframe import Airframe
from ..bracket import Bracket
from ..dynamics import AbstractModel, Attitude, Forcing, Rates
from ..shooting import ShootingProblem
from ._estimate import AbstractEstimator, Estimate


class Profile(NamedTuple):
    """One parameter held at a series of values, and all others fitted at each.

    - `values`: of the parameter.
    - `whole`: the best fit, with no parameter held.
    - `deviance`: twice the cost there above that of the whole model's best fit: where it is below 3.84, the value is in
      the 95 % likelihood interval. Negative where a held fit found less than the whole one: its search had not ended.
      Infinite where either of them has no answer.
    - `estimates`: of the other parameters, a batch with a result for each value.
    """

    values: Float[Array, " values"]
    whole: Estimate
    deviance: Float[Array, " values"]
    estimates: Estimate


def profile_likelihood(
    estimator: AbstractEstimator,
    problem: ShootingProblem,
    bracket: Bracket,
    name: str,
    values: Float[Array, " values"],
) -> Profile:
    """Fits one flight with one of its parameters held at each of `values`, all in one batch.

    **Arguments:**

    - `estimator`: one that shoots, such as `IBSS` or `OutputError`; it is called with one parameter fewer.
    - `name`: of the parameter, as in `problem.model.parameter_names`.

    **Raises:** `ValueError` for an unknown name, or values that are not one-dimensional.
    """
    names = problem.model.parameter_names
    if name not in names:
        raise ValueError(f"`name` must be one of {', '.join(names)}, got {name!r}.")
    values = as_float(values)
    if values.ndim != 1:
        raise ValueError(f"`values` must be one-dimensional, got shape {values.shape}.")
    whole = estimator(problem, bracket)
    held = _held(estimator, problem, bracket, names.index(name), values)
    deviance = jnp.where(jnp.isfinite(whole.cost), 2 * (held.cost - whole.cost), jnp.inf)
    return Profile(values, whole, deviance, held)


@eqx.filter_jit
def _held(
    estimator: AbstractEstimator,
    problem: ShootingProblem,
    bracket: Bracket,
    index: int,
    values: Float[Array, " values"],
) -> Estimate:
    def at(value: Scalar) -> Estimate:
        model = FixedParameter(problem.model, index, value)
        others = Bracket(model.without(bracket.lower), model.without(bracket.upper))
        return estimator(eqx.tree_at(lambda p: p.model, problem, model), others)

    return eqx.filter_vmap(at)(values)


class FixedParameter(AbstractModel):
    """A model with one of its parameters held at a value: what is left is estimated as ever.

    **Arguments:**

    - `model`: the whole model.
    - `index`: of the parameter.
    - `value`: where it is held.
    """

    model: AbstractModel
    index: int = eqx.field(static=True)
    value: Scalar

    def __init__(self, model: AbstractModel, index: int, value: Scalar):
        self.model, self.index, self.value = model, index, as_float(value)

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The inner model's."""
        return self.model.airframe

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The inner model's."""
        return self.model.gyroscopic_factor

    @property
    def is_linear(self) -> bool:
        """The inner model's."""
        return self.model.is_linear

    @property
    def alpha(self) -> Parameters:
        """The inner model's, without the one that is held."""
        return self.without(self.model.alpha)

    @property
    def half_width(self) -> Parameters:
        """The inner model's, without the one that is held."""
        return self.without(self.model.half_width)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The inner model's, without the one that is held."""
        return self.model.parameter_names[: self.index] + self.model.parameter_names[self.index + 1 :]

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """The inner model's, without the one that is held."""
        return self.model.parameter_units[: self.index] + self.model.parameter_units[self.index + 1 :]

    def without(self, values: Parameters) -> Float[Array, " others"]:
        """Of one value for each parameter of the inner model, those that are not held."""
        return values[np.delete(np.arange(values.shape[0]), self.index)]

    def forcing(self, omega: RotorSpeeds) -> Forcing:
        """The inner model's."""
        return self.model.forcing(omega)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The inner model's, with the value in its place."""
        given = tuple(parameters)
        return self.model.angular_acceleration(rates, forcing, (*given[: self.index], self.value, *given[self.index :]))

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """The inner model's."""
        return self.model.acceleration(attitude, forcing)
