"""`AbstractEstimator`, and the `Estimate` that every estimator returns."""

import abc
import functools
from collections.abc import Callable
from statistics import NormalDist
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._custom_types import Parameters, Scalar
from .batching import in_blocks
from .bracket import NO_PRIOR, Bracket
from .linalg import invert
from .results import RESULTS
from .shooting import AbstractProblem, Parts, ShootingProblem

REACH = 4.0  # how many half-widths an answer may lie away from the center of its bracket
# Gauss-Newton steps to an initial state, with the parameters known: the trajectory is nearly linear in that state.
_START_STEPS = 4


class Calibration(eqx.Module):
    """Half-widths, in standard deviations, of intervals that contain the truth in the share of flights of their level.

    - `levels`: between 0 and 1, rising.
    - `factors`: for each level and parameter. `simultaneous`: of intervals that hold all parameters at once.
    """

    levels: Float[Array, " levels"]
    factors: Float[Array, "levels parameters"]
    simultaneous: Float[Array, " levels"]


_count = functools.partial(jnp.asarray, dtype=int)


class Estimate(eqx.Module):
    """Parameters with their uncertainty, and how they were found.

    - `parameters`: all unknowns that the problem's windows share; a fixed one has a variance of 0. Without an estimate
      (see `result`): the bracket's center, or 0 if the bracket is invalid. The bracket of a network is its own.
    - `covariance`: the covariance of `parameters`, by the Fisher information of the problem, or by a network's errors
      on simulated flights. Infinite without an estimate.
    - `initial_state`: the estimated, or known, state at the first sample of each window, in cascade order.
    - `cost`: the problem's cost at the estimate, for its channels (a network: for its own): 1/2 |W (y - x)|^2, or the
      negative log-likelihood of innovations. Infinite without an estimate.
    - `rollouts`: simulated flights: one for a shot, and one for each of its derivatives; IBSS counts the derivatives
      only. `sweeps`: number of iterations, summed over the stages.
    - `result`: how the search ended.
    - `calibration`: the calibration of the intervals on simulated flights; `None`: Gaussian intervals.
    - `seed`: the bracket that the search began from, if another estimator gave one.
    - `history`: the parameters after each sample, from a recursive estimator.
    - `parts`: the likelihood of each part of the flight, from a problem whose parts are compared.
    """

    parameters: Parameters
    covariance: Float[Array, "parameters parameters"]
    initial_state: Float[Array, " starts"]
    cost: Scalar
    rollouts: Int[Array, ""] = eqx.field(converter=_count)
    sweeps: Int[Array, ""] = eqx.field(converter=_count)
    result: RESULTS
    calibration: Calibration | None = None
    seed: Bracket | None = None
    history: Float[Array, "samples parameters"] | None = None
    parts: Parts | None = None

    @property
    def std(self) -> Float[Array, "*batch parameters"]:
        """Standard deviation of each parameter, for one estimate or a batch."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def half_width(self, level: float, *, simultaneous: bool = False) -> Float[Array, "*batch parameters"]:
        """Half-width of an interval around each parameter that holds the truth in a share `level` of all flights.

        `level`: between 0 and 1, else `ValueError`. Calibrated intervals do not change outside of 0.5 to 0.999.
        `simultaneous`: whether the intervals hold all parameters at once; by default each holds its own.
        """
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1, got {level}.")
        if self.calibration is None:
            each = 1 - (1 - level) / self.parameters.shape[-1] if simultaneous else level
            return _deviations(each) * self.std
        knots, quantile = jax.scipy.special.ndtri((1 + self.calibration.levels) / 2), _deviations(level)
        factors = self.calibration.simultaneous[..., None] if simultaneous else self.calibration.factors
        each_parameter = jax.vmap(functools.partial(jnp.interp, quantile), in_axes=(None, 1))
        return jnp.vectorize(each_parameter, signature="(l),(l,p)->(p)")(knots, factors) * self.std


def _deviations(level: float) -> float:
    """Half-width, in standard deviations, of the interval that holds a share `level` of a Gaussian."""
    return NormalDist().inv_cdf((1 + level) / 2)  # that of JAX is slow to import and to trace


def as_estimate(
    problem: AbstractProblem,
    *,
    parameters: Parameters,
    covariance: Float[Array, "parameters parameters"],
    initial_state: Float[Array, " starts"],
    cost: Scalar,
    feasible: Bool[Array, ""],
    done: Bool[Array, ""],
    reach: Scalar | float = REACH,
    largest_std: float | None = None,
    history: Float[Array, "samples parameters"] | None = None,
    **more: Any,
) -> Estimate:
    """The answer of an algorithm as an `Estimate`, with its result code. All its parameters are finite.

    - `feasible`: whether the trajectory did not fail before its end. `done`: whether the search ended by itself.
    - `reach`: how many half-widths an answer may lie away from the bracket's center.
    - `largest_std`: of an identifiable parameter, in half-widths, see `jaxos4.bracket`; by default that of the cost.
    - The others are fields of an `Estimate`.
    """
    unknowns = problem.unknowns
    own = unknowns.parameter_count
    valid, free = unknowns.valid, unknowns.free
    center, half_width = jnp.where(valid, unknowns.center, 0.0), jnp.where(valid, unknowns.half_width, 1.0)
    covariance = jnp.where(free & free[:, None], covariance, 0.0)
    std = jnp.sqrt(jnp.diagonal(covariance))
    far = (jnp.abs(parameters - center) > (reach - 1e-2) * half_width) & free
    identifiable = unknowns.identifiable(std, largest_std)
    finite = jnp.isfinite(parameters).all() & jnp.isfinite(std).all() & jnp.isfinite(covariance).all()
    feasible = feasible & jnp.isfinite(cost) & finite
    result = RESULTS.where(far[:own].any(), RESULTS.at_bound, RESULTS.successful)
    result = RESULTS.where(done, result, RESULTS.max_sweeps)
    result = RESULTS.where(~identifiable[:own].all(), RESULTS.unidentifiable, result)
    result = RESULTS.where(feasible, result, RESULTS.nonfinite_trajectory)
    result = RESULTS.where(valid, result, RESULTS.bracket_invalid)
    answered = feasible & valid
    return Estimate(
        parameters=jnp.where(answered, parameters, center),
        covariance=jnp.where(answered, covariance, jnp.inf),
        initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
        cost=jnp.where(answered, cost, jnp.inf),
        result=result,
        history=None if history is None else jnp.where(answered, history, center),
        **more,
    )


def fit_start(
    problem: ShootingProblem, parameters: Parameters
) -> tuple[Float[Array, " starts"], Scalar, Bool[Array, ""], int]:
    """The initial state that explains the flight best with these parameters, for algorithms that do not search for it.

    A free one takes a few Gauss-Newton steps from the first measurements, whose errors are the prior.

    **Returns:** initial state, cost, whether the trajectory is feasible, and number of rollouts.
    """
    start, off = problem.first_state()
    count, free = parameters.shape[0], problem.free_size

    def improve(start: Float[Array, " starts"], _) -> tuple[Float[Array, " starts"], None]:
        model = local_model(problem.join(parameters, start))
        covariance = jax.vmap(invert)(model.information[:, count:, count:] + jax.vmap(jnp.diag)(known))
        slope = model.gradient[:, count:] + known * problem.split(start - first)
        return start - (covariance * slope[:, None, :]).sum(axis=-1).ravel(), None

    if free:
        first, known, local_model = start, 1 / jnp.square(problem.split(off)), problem.local_model
        start, _ = jax.lax.scan(improve, first, length=_START_STEPS)
    cost, feasible = problem.shots(parameters, start)
    return start, cost, feasible, 1 + (_START_STEPS * (count + free) if free else 0)


class AbstractEstimator(eqx.Module):
    """An algorithm that identifies parameters; its fields are its settings.

    Class variables say what an estimator can do:

    - `looks_at`: the largest choice of a state's channels that it compares: `"rates"`, `"attitude"` or `"all"`.
    - `shoots`: whether it minimises the cost of a simulation of a `ShootingProblem`. If so, it can use windows, and
      `identify` replaces its covariance by the one that follows from the noise.
    - `largest_std`: the largest standard deviation of an identifiable parameter, in half-widths of its bracket:
      `NO_PRIOR`, `GAUSSIAN_PRIOR` or `UNIFORM_PRIOR` of `jaxos4.bracket`.
    - `needs_network`: whether it needs a trained network, in a field `network`.
    - `in_closed_loop`: whether it searches a likelihood of innovations too, and so serves a vehicle that a controller
      flies. Its `Estimate` then has `parts`.
    - `in_comparison`: whether `jaxos4 compare` runs it; false if it takes longer than all others together.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = False
    largest_std: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False
    in_closed_loop: ClassVar[bool] = False
    in_comparison: ClassVar[bool] = True

    @abc.abstractmethod
    def __call__(self, problem: Any, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight, in the problem's own bracket or in another.

        `problem`: a `ShootingProblem`, or any other `AbstractProblem`. For a batch use `eqx.filter_vmap`: a lane that
        fails does not change the others.
        """


def recursively(
    identify: Callable[[ShootingProblem], Estimate], problem: ShootingProblem, bracket: Bracket | None
) -> Estimate:
    """The estimate by an algorithm that goes through a flight sample by sample, see `in_one_program`.

    **Raises:** `ValueError` for a wrong bracket, and for windows, rotor or sensor terms, which it cannot handle.
    """
    if problem.windows > 1:
        remedy = f"got {problem.windows}: use an estimator that shoots"
        raise ValueError(f"`problem.windows` must be 1 for this estimator, {remedy}.")
    if problem.model.forcing_parameters or not problem.model.observes_states:
        raise ValueError(
            "`problem.model` must have no rotor lag, delay, thrust curve or sensor terms for this estimator: "
            "use an estimator that shoots."
        )
    return in_one_program(identify, problem, bracket)


@eqx.filter_jit
def in_one_program(
    identify: Callable[[ShootingProblem], Estimate], problem: ShootingProblem, bracket: Bracket | None
) -> Estimate:
    """The estimate of one flight in a bracket, or of a batch in blocks."""
    return in_blocks(identify, problem.within(bracket))
