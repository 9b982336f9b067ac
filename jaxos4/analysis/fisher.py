"""What a flight can tell: Fisher information and the Cramer-Rao bound."""

import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import Parameters, as_float
from ..linalg import covariance_of_shared, joint_factor
from ..shooting import ShootingProblem


@eqx.filter_jit
def fisher_information(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"] | None = None
) -> Float[Array, "parameters parameters"]:
    """J^T W^2 J in the parameters, at `parameters`.

    Where the initial state is free it is eliminated (a Schur complement): what is left is what the flight tells about
    the parameters without knowing where it began.
    """
    count = parameters.shape[0]
    factor = joint_factor(_information(problem, parameters, initial_state), count)[0, :count, -count:]
    return (factor[:, None, :] * factor[None, :, :]).sum(axis=-1)


@eqx.filter_jit
def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"] | None = None
) -> Float[Array, "parameters parameters"]:
    """The least covariance that an unbiased estimate can have: the inverse of `fisher_information`.

    Parameters that the flight does not tell have a variance that is huge, not infinite.
    """
    return covariance_of_shared(_information(problem, parameters, initial_state), parameters.shape[0])


def _information(problem, parameters, initial_state) -> Float[Array, "windows unknowns unknowns"]:
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    return problem.curvatures(as_float(parameters), start).information
