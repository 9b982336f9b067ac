"""Profile likelihood: how much worse the best fit gets where one parameter is held away from its estimate."""

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
        model = HeldParameters(problem.model, held=(index,), values=value[None])
        others = Bracket(model.without(bracket.lower), model.without(bracket.upper))
        return estimator(eqx.tree_at(lambda p: p.model, problem, model), others)

    return eqx.filter_vmap(at)(values)
