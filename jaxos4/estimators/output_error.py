"""Output error: nonlinear least squares of the simulated against the measured trajectory, by Levenberg-Marquardt.

This is the prediction-error method for a model without process noise; for white measurement noise it is maximum
likelihood. The minimiser is optimistix's.

References: Ljung, System Identification, ch. 7; Jategaonkar, Flight Vehicle System Identification, ch. 4.
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
from ..linalg import covariance_of_shared, unit_directions
from ..models.state import CHANNELS
from ..shooting import ShootingProblem

Unknowns = Float[Array, " unknowns"]


class OutputError(AbstractEstimator):
    """Levenberg-Marquardt on the weighted residuals, from the bracket's center.

    The rates are fitted first, then the attitude with them, then all channels: from a wide bracket, a direct fit of all
    channels can end in another minimum. The Jacobian is dense: it grows with the square of the number of windows.

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

        The estimate's `rollouts` count each trial and each of its tangents; `sweeps` are the steps of all stages.

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
            # The damping treats all unknowns alike in these units.
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
        """The least-squares solution, in units of `scale`."""
        count = len(problem.model.parameter_names)

        def residuals(scaled: Unknowns, _) -> Float[Array, " residuals"]:
            u = scaled * scale
            return problem.residuals(u[:count], u[count:] if problem.free_size else None)

        solver = optx.LevenbergMarquardt(self.tolerance, self.tolerance, linear_solver=NormalCholesky())
        return optx.least_squares(residuals, solver, unknowns / scale, max_steps=self.max_steps, throw=False)


class NormalCholesky(lx.AbstractLinearSolver):
    """Least squares by the normal equations, in plain operations: LAPACK's batched kernels can deadlock in a loop.

    The damping of Levenberg-Marquardt keeps the equations regular.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict) -> tuple:
        """The matrix M, and B with B B^T the inverse of M^T M."""
        matrix = operator.as_matrix()
        return matrix, unit_directions(jnp.einsum("ij,ik->jk", matrix, matrix))

    def compute(self, state: tuple, vector, options: dict):
        """Solves for one right-hand side."""
        matrix, basis = state
        flat = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(vector)])
        solution = basis @ (basis.T @ (matrix.T @ flat))
        return solution, lx.RESULTS.successful, {}

    def transpose(self, state, options):
        """Not needed: nothing is differentiated through the solution."""
        raise NotImplementedError("NormalCholesky solves forward only.")

    def conj(self, state, options):
        """Itself: residuals are real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Damping makes the columns independent."""
        return True
