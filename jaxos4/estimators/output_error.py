"""Output error: nonlinear least squares of the simulated against the measured trajectory, by Levenberg-Marquardt.

The prediction-error method of system identification for a model without process noise, and with white measurement
noise maximum likelihood (Ljung, System Identification, chapter 7; Jategaonkar, Flight Vehicle System Identification,
chapter 4). The minimiser is optimistix's.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float

from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, check_bracket, conclude
from ..linalg import cholesky, covariance_of_shared, invert_factor
from ..models.state import CHANNELS
from ..shooting import ShootingProblem

Unknowns = Float[Array, " unknowns"]


class OutputError(AbstractEstimator):
    """Levenberg-Marquardt on the weighted residuals, from the bracket's center, down the cascade of channels.

    The rates are fitted first, then the attitude with them, then everything: from a wide bracket the residuals of all
    channels alone lead to other minima. Unknowns are scaled by the bracket's half-widths (an initial state by how far
    off it may be), so that the damping means the same for each.

    The Jacobian is dense: of a flight cut into windows it grows with the square of their number, where IBSS eliminates
    them one by one.

    **Arguments:**

    - `tolerance`: of the step, relative and absolute in scaled unknowns, and of the cost.
    - `max_steps`: for each stage.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    tolerance: float = eqx.field(static=True, default=1e-8)
    max_steps: int = eqx.field(static=True, default=100)

    def __check_init__(self):
        if not self.tolerance > 0:
            raise ValueError(f"`tolerance` must be positive, got {self.tolerance}.")
        if not isinstance(self.max_steps, int) or self.max_steps < 1:
            raise ValueError(f"`max_steps` must be an integer of at least 1, got {self.max_steps!r}.")

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        `rollouts` counts one for each trial and one for each of its tangents, `sweeps` the steps of all stages.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        check_bracket(problem, bracket)
        usable, count = bracket.usable, len(problem.model.parameter_names)
        starts, off = (problem.split(x) for x in problem.first_state())
        parameters = usable.center
        steps = rollouts = jnp.zeros((), dtype=int)
        done = jnp.ones((), dtype=bool)
        for channels, size in CHANNELS.items():
            if size > problem.size:
                continue
            stage = problem.restrict(channels)
            free = stage.free_size
            scale = jnp.concatenate([usable.half_width, off[:, :free].ravel()])
            solution = self._minimise(stage, jnp.concatenate([parameters, starts[:, :free].ravel()]), scale)
            found = solution.value * scale
            parameters, starts = found[:count], starts.at[:, :free].set(found[count:].reshape(problem.windows, free))
            taken = solution.stats["num_steps"]
            steps, rollouts = steps + taken, rollouts + taken * (1 + count + problem.windows * free)
            done = solution.result == optx.RESULTS.successful
        initial_state = starts.ravel()
        shots, _, information = problem.curvatures(parameters, initial_state)
        return conclude(
            bracket,
            parameters=parameters,
            covariance=covariance_of_shared(information, count),
            initial_state=initial_state,
            cost=shots.cost.sum(),
            rollouts=rollouts + count + problem.free_size,
            sweeps=steps,
            sound=shots.sound.all(),
            done=done,
        )

    def _minimise(self, problem: ShootingProblem, unknowns: Unknowns, scale: Unknowns) -> optx.Solution:
        """In scaled unknowns."""
        count = len(problem.model.parameter_names)

        def residuals(scaled: Unknowns, _) -> Float[Array, " residuals"]:
            u = scaled * scale
            return problem.residuals(u[:count], u[count:] if problem.free_size else None)

        solver = optx.LevenbergMarquardt(self.tolerance, self.tolerance, linear_solver=NormalCholesky())
        return optx.least_squares(residuals, solver, unknowns / scale, max_steps=self.max_steps, throw=False)


class NormalCholesky(lx.AbstractLinearSolver):
    """Least squares by the normal equations, in plain operations: LAPACK's batched kernels can wait for ever in a loop.

    See `information.cholesky`. Damping keeps the equations regular.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict) -> tuple:
        """The matrix, and its inverse Cholesky factor."""
        del options
        matrix = operator.as_matrix()
        return matrix, invert_factor(cholesky(jnp.einsum("ij,ik->jk", matrix, matrix)))

    def compute(self, state: tuple, vector, options: dict):
        """Solves for one right-hand side."""
        del options
        matrix, inverse = state
        flat = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(vector)])
        solution = inverse.T @ (inverse @ (matrix.T @ flat))
        return solution, lx.RESULTS.successful, {}

    def transpose(self, state, options):
        """Not needed: what is minimised is not differentiated through."""
        raise NotImplementedError("NormalCholesky solves forward only.")

    def conj(self, state, options):
        """Itself: residuals are real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Of the columns: damping makes sure of it."""
        return True
