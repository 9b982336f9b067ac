"""Profile likelihood: how much worse the best fit gets when one parameter is held away from its estimate."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar, as_float
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..models.held import HeldParameters
from ..shooting import ShootingProblem


class Profile(NamedTuple):
    """One parameter held at a series of values, and all others fitted for each value.

    - `values`: of the held parameter.
    - `whole`: the best fit, with no parameter held.
    - `deviance`: twice the difference of the costs with and without the parameter held. Values with a deviance below
      3.84 form the 95 % likelihood interval. A negative deviance shows that the search of `whole` had not converged;
      an infinite one, that one of the two fits has no answer.
    - `estimates`: of the other parameters, a batch with one estimate for each value.
    """

    values: Float[Array, " values"]
    whole: Estimate
    deviance: Float[Array, " values"]
    estimates: Estimate


def profile_likelihood(
    estimator: AbstractEstimator, problem: ShootingProblem, bracket: Bracket, name: str, values: Float[Array, " values"]
) -> Profile:
    """Fits one flight with one of its parameters held at each of `values`, all in one batch.

    **Arguments:**

    - `estimator`: one that shoots, such as `IBSS` or `OutputError`; its problem has one parameter fewer.
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
        model = HeldParameters(problem.model, held=(index,), values=value[None])
        others = Bracket(model.without(bracket.lower), model.without(bracket.upper))
        return estimator(eqx.tree_at(lambda p: p.model, problem, model), others)

    return eqx.filter_vmap(at)(values)
