"""Fisher information of a flight in the parameters, and the Cramer-Rao bound."""

import functools

import jax
from jaxtyping import Array, Float

from .._custom_types import Covariance, InitialStates, Parameters, as_float
from .._xla import quick_jit
from ..linalg import covariance_of_shared, gram, joint_factor
from ..shooting import ShootingProblem


def fisher_information(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """J^T W^2 J in the parameters, with the Jacobian J at `parameters` and the weights W = 1 / sigma.

    A free initial state is unknown too and is eliminated (Schur complement). `initial_state` is where J is computed, by
    default the measured one.
    """
    return _information_of_shared(_information(problem, parameters, initial_state), parameters.shape[0])


def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """The smallest covariance that an unbiased estimate can have: the inverse of `fisher_information`.

    A parameter that is not excited has a huge variance, but not an infinite one.
    """
    return _covariance_of_shared(_information(problem, parameters, initial_state), parameters.shape[0])


# A program of its own: information and bound share it, and the simulation is what takes long to compile.
@quick_jit
def _information(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None
) -> Float[Array, "windows unknowns unknowns"]:
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    return problem.curvatures(as_float(parameters), start).information


@functools.partial(jax.jit, static_argnums=1)
def _information_of_shared(information: Float[Array, "windows unknowns unknowns"], count: int) -> Covariance:
    return gram(joint_factor(information, count).factor[0, :count, -count:])


_covariance_of_shared = jax.jit(covariance_of_shared, static_argnums=1)
