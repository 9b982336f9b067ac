"""Fisher information of a flight in the parameters, and the Cramer-Rao bound."""

import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import Covariance, InitialStates, Parameters, as_float
from ..linalg import covariance_of_shared, gram, joint_factor
from ..shooting import ShootingProblem


@eqx.filter_jit
def fisher_information(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """J^T W^2 J in the parameters, with the Jacobian J at `parameters` and the weights W = 1 / sigma.

    A free initial state is unknown too and is eliminated (Schur complement). `initial_state` is where J is computed, by
    default the measured one.
    """
    count = parameters.shape[0]
    factor = joint_factor(_information(problem, parameters, initial_state), count).factor[0, :count, -count:]
    return gram(factor)


@eqx.filter_jit
def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """The smallest covariance that an unbiased estimate can have: the inverse of `fisher_information`.

    A parameter that is not excited has a huge variance, but not an infinite one.
    """
    return covariance_of_shared(_information(problem, parameters, initial_state), parameters.shape[0])


def _information(problem, parameters, initial_state) -> Float[Array, "windows unknowns unknowns"]:
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    return problem.curvatures(as_float(parameters), start).information
