"""Profile likelihood: how much worse the best fit gets when one parameter is held away from its estimate."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import as_float
from .._xla import quick_jit
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..shooting import ShootingProblem


class Profile(NamedTuple):
    """One parameter held at a series of values, and all others fitted for each value.

    - `values`: of the held parameter.
    - `whole`: the best fit, with no parameter held.
    - `deviance`: twice the difference of the costs with and without the parameter held. Values with a deviance below
      3.84 form the 95 % likelihood interval. A negative deviance shows that the search of `whole` had not converged;
      an infinite one, that one of the two fits has no answer.
    - `estimates`: a batch with one estimate for each value, in which the parameter is held.
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

    - `estimator`: one that shoots, such as `IBSS` or `OutputError`.
    - `name`: of the parameter, as in `problem.model.parameter_names`.

    **Raises:** `ValueError` for an unknown name, or values that are not one-dimensional.
    """
    names = problem.model.parameter_names
    if name not in names:
        raise ValueError(f"`name` must be one of {', '.join(names)}, got {name!r}.")
    values = as_float(values)
    if values.ndim != 1:
        raise ValueError(f"`values` must be one-dimensional, got shape {values.shape}.")
    problem = problem.within(bracket)
    whole = estimator(problem)
    held = _held(estimator, problem, name, values)
    deviance = jnp.where(jnp.isfinite(whole.cost), 2 * (held.cost - whole.cost), jnp.inf)
    return Profile(values, whole, deviance, held)


@quick_jit
def _held(estimator: AbstractEstimator, problem: ShootingProblem, name: str, values: Array) -> Estimate:
    return eqx.filter_vmap(lambda value: estimator(problem.hold({name: value})))(values)
