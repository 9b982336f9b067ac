"""Output error: nonlinear least squares of the simulated against the measured trajectory, by Levenberg-Marquardt.

This is the prediction-error method for a model without process noise; for white measurement noise it is maximum
likelihood.

References: Ljung, System Identification, ch. 7; Jategaonkar, Flight Vehicle System Identification, ch. 4; Marquardt
1963, SIAM J. Appl. Math. 11(2), on the damping.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Scalar, as_float, as_int
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, check_bracket, check_dynamic_count, check_positive, conclude
from ..linalg import covariance_of_shared, joint_factor
from ..shooting import Curvature, ShootingProblem, Shot, in_blocks

Unknowns = Float[Array, "windows unknowns"]

_FIRST_DAMPING = 1.0  # in units of the bracket: it hardly changes the first step of a flight with information
_COARSE = 1e-3  # tolerance of the rates, if all channels follow
_DAMPING_FACTOR = 10.0  # how much more, or less, is damped after a step that failed, or succeeded


class _Search(NamedTuple):
    """The best unknowns so far with their curvature, the next trial, and its damping."""

    best: Unknowns
    curvature: Curvature
    trial: Unknowns
    damping: Scalar
    steps: Int[Array, ""]
    done: Bool[Array, ""]


class OutputError(AbstractEstimator):
    """Levenberg-Marquardt on the weighted residuals, from the bracket's center.

    The rates are fitted first, and then all channels with them: from a wide bracket, a direct fit of all channels can
    end in another minimum.

    **Arguments:**

    - `tolerance`: the search ends with a step that changes no unknown by more, in half-widths of the bracket. Cost and
      covariance are those before this step.
    - `max_steps`: for each stage.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    tolerance: Scalar = eqx.field(converter=as_float, default=1e-5)
    max_steps: Count = eqx.field(converter=as_int, default=100)

    def __check_init__(self):
        check_positive("tolerance", self.tolerance)
        check_dynamic_count("max_steps", self.max_steps, 1)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        The estimate's `rollouts` count each trial and each of its tangents; `sweeps` are the steps of all stages.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        check_bracket(problem, bracket)
        return in_blocks(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """One flight, or a block of flights."""
        usable, count = bracket.usable, len(problem.model.parameter_names)
        starts, off = (problem.split(x) for x in problem.first_state())
        parameters = jnp.broadcast_to(usable.center, (problem.windows, count))

        def fit(channels: str, parameters: Array, starts: Array) -> tuple[_Search, Array, Array, Array]:
            stage = problem.restrict(channels)
            free = stage.free_size
            # The damping treats all unknowns alike in these units.
            scale = jnp.concatenate([jnp.broadcast_to(usable.half_width, parameters.shape), off[:, :free]], axis=1)
            tolerance = self.tolerance if channels == problem.channels else jnp.maximum(self.tolerance, _COARSE)
            search = self._minimise(stage, jnp.concatenate([parameters, starts[:, :free]], axis=1), scale, tolerance)
            starts = starts.at[:, :free].set(search.best[:, count:])
            return search, search.best[:, :count], starts, (search.steps + 1) * (1 + count + problem.windows * free)

        search, parameters, starts, rollouts = fit("rates", parameters, starts)
        steps = search.steps
        if problem.channels != "rates":
            search, parameters, starts, more = fit(problem.channels, parameters, starts)
            steps, rollouts = steps + search.steps, rollouts + more
        return conclude(
            bracket,
            parameters=parameters[0],
            covariance=covariance_of_shared(search.curvature.information, count),
            initial_state=starts.ravel(),
            cost=search.curvature.shot.cost.sum(),
            rollouts=rollouts,
            sweeps=steps,
            sound=search.curvature.shot.sound.all(),
            done=search.done,
        )

    def _minimise(self, problem: ShootingProblem, start: Unknowns, scale: Unknowns, tolerance: Scalar) -> _Search:
        """The minimum of the cost. The first trial is the start itself, so that the curvature is compiled once.

        `tolerance`: the search ends with a step that changes no unknown by more, in units of `scale`.
        """
        count, windows = len(problem.model.parameter_names), problem.windows
        known = problem.first_state()[0]
        # The windows share the damping of a parameter, so that it counts once.
        unit = jnp.square(scale).at[:, :count].multiply(windows)

        def move(search: _Search) -> _Search:
            initial_state = search.trial[:, count:].ravel() if problem.free_size else known
            curvature = problem.curvatures(search.trial[0, :count], initial_state)
            first, before, now = search.steps < 0, _cost(search.curvature), _cost(curvature)
            better = first | (now < before)
            best, curvature = jax.tree.map(
                lambda a, b: jnp.where(better, a, b), (search.trial, curvature), (search.best, search.curvature)
            )
            factor = jnp.where(first, 1.0, jnp.where(better, 1 / _DAMPING_FACTOR, _DAMPING_FACTOR))
            damping = search.damping * factor
            step = _step(curvature, damping, unit, count)
            small = (jnp.abs(step) <= tolerance * scale).all()
            done = small | ~jnp.isfinite(step).all()
            trial = best + step
            return _Search(jnp.where(small, trial, best), curvature, trial, damping, search.steps + 1, done)

        size = start.shape[1]
        zero, square = jnp.zeros(windows, dtype=float), jnp.zeros((windows, size, size), dtype=float)
        nothing = Curvature(Shot(zero, zero > 0), jnp.zeros_like(start), square)
        damping, none, no = (
            jnp.full((), _FIRST_DAMPING, dtype=float),
            -jnp.ones((), dtype=int),
            jnp.zeros((), dtype=bool),
        )
        first = _Search(start, nothing, start, damping, none, no)
        return jax.lax.while_loop(lambda search: ~search.done & (search.steps < self.max_steps), move, first)


def _cost(curvature: Curvature) -> Scalar:
    """The cost of all windows; infinite for a trajectory that fails."""
    cost, sound = curvature.shot
    return jnp.where(sound.all() & jnp.isfinite(cost).all(), cost.sum(), jnp.inf)


def _step(curvature: Curvature, damping: Scalar, unit: Unknowns, count: int) -> Unknowns:
    """The damped Gauss-Newton step of each window's unknowns. Its first `count` unknowns are shared."""
    information = curvature.information + jax.vmap(jnp.diag)(damping / unit)
    basis = joint_factor(information, count).basis
    slopes = (basis * curvature.gradient[:, :, None]).sum(axis=1)
    shared = jnp.arange(slopes.shape[1]) >= slopes.shape[1] - count
    slopes = jnp.where(shared, slopes.sum(axis=0), slopes)
    return -(basis * slopes[:, None, :]).sum(axis=-1)
