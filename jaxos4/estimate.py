"""What every estimator returns, and what makes it one."""

import abc
import functools
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._custom_types import Parameters, Scalar
from .bracket import NO_PRIOR, Bracket
from .linalg import invert
from .results import RESULTS
from .shooting import ShootingProblem

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar  # what type checkers understand
else:
    from equinox import AbstractClassVar

# How many half-widths around its bracket's center an answer may lie.
REACH = 4.0
# Towards an initial state with the parameters known: the trajectory is nearly linear in it.
_START_STEPS = 4


class Calibration(eqx.Module):
    """How many standard deviations an interval needs to hold the truth as often as its level says.

    - `levels`: rising, between 0 and 1.
    - `factors`: for each level and parameter, the half-width in standard deviations.
    - `simultaneous`: for each level, the factor with which all parameters' intervals hold at once.
    """

    levels: Float[Array, " levels"]
    factors: Float[Array, "levels parameters"]
    simultaneous: Float[Array, " levels"]


class Estimate(eqx.Module):
    """Parameters with their uncertainty, and how they were found.

    - `parameters`: the estimate; where `result` says that there is none, the bracket's center, or 0 without one.
    - `covariance`: of `parameters`. Shooting takes it from the Fisher information at the estimate and the problem's
      `sigma`, a network from its errors on simulated flights.
    - `initial_state`: the estimated, or known, state at the first sample, in cascade order; of several windows, one
      after the other.
    - `cost`: 1/2 |W (y - x)|^2 there, of the channels that the estimator looks at; infinite without an estimate.
    - `rollouts`: simulated flights that it took, whatever their channels: one for a shot with its slope, one for each
      unknown of a Fisher information.
    - `sweeps`: iterations over all directions, summed over the stages.
    - `result`: how it ended.
    - `calibration`: of the intervals, where they were calibrated on simulated flights; `None`: Gaussian.
    - `seed`: the bracket that the search began from, where another estimator gave one.
    - `history`: of a recursive estimator, the parameters after each sample.
    - `brackets`: of a search that records them, from where to where each sweep looked in each parameter; NaN where
      there were fewer sweeps.
    """

    parameters: Parameters
    covariance: Float[Array, "parameters parameters"]
    initial_state: Float[Array, " starts"]
    cost: Scalar
    rollouts: Int[Array, ""]
    sweeps: Int[Array, ""]
    result: RESULTS
    calibration: Calibration | None = None
    seed: Bracket | None = None
    history: Float[Array, "samples parameters"] | None = None
    brackets: Float[Array, "sweeps 2 parameters"] | None = None

    @property
    def std(self) -> Float[Array, "*batch parameters"]:
        """Standard deviation of each parameter, of one estimate or of a batch of them."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def half_width(self, level: float, *, simultaneous: bool = False) -> Float[Array, "*batch parameters"]:
        """Half the width of an interval around each parameter that holds the truth in a share `level` of all flights.

        **Arguments:**

        - `level`: between 0 and 1; calibrated intervals reach from 50 to 99.9 %, and beyond grow no further.
        - `simultaneous`: all parameters at once, instead of each for itself.

        **Raises:** `ValueError` for another level.
        """
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1, got {level}.")
        if self.calibration is None:
            each = 1 - (1 - level) / self.parameters.shape[-1] if simultaneous else level
            return _deviations(jnp.asarray(each, dtype=float)) * self.std
        knots, quantile = _deviations(self.calibration.levels), _deviations(jnp.asarray(level, dtype=float))
        at = functools.partial(jnp.interp, quantile)
        if simultaneous:
            return (
                jnp.vectorize(at, signature="(l),(l)->()")(knots, self.calibration.simultaneous)[..., None] * self.std
            )
        each_parameter = jax.vmap(at, in_axes=(None, 1))
        return jnp.vectorize(each_parameter, signature="(l),(l,p)->(p)")(knots, self.calibration.factors) * self.std


def _deviations(level: Float[Array, "*levels"]) -> Float[Array, "*levels"]:
    """How many standard deviations to either side hold a share `level` of a Gaussian."""
    return jax.scipy.special.ndtri((1 + level) / 2)


def conclude(
    bracket: Bracket,
    *,
    parameters: Parameters,
    covariance: Float[Array, "parameters parameters"],
    initial_state: Float[Array, " starts"],
    cost: Scalar,
    rollouts: Int[Array, ""] | int,
    sweeps: Int[Array, ""] | int,
    sound: Bool[Array, ""],
    done: Bool[Array, ""],
    reach: Scalar | float = REACH,
    prior: float = NO_PRIOR,
    history: Float[Array, "samples parameters"] | None = None,
) -> Estimate:
    """What an algorithm found, as an estimate: its result told, and nothing that is not a number passed on.

    **Arguments:**

    - `sound`: whether the trajectory stayed sound to its end.
    - `done`: whether the search ended by itself.
    - `reach`: how many half-widths around the bracket's center an answer may lie.
    - `prior`: how the estimator uses the bracket, see `Bracket.identifies`.
    """
    valid, center = bracket.valid, jnp.where(bracket.valid, bracket.center, 0.0)
    std, half_width = jnp.sqrt(jnp.diagonal(covariance)), jnp.where(valid, bracket.half_width, 1.0)
    limit = (reach - 1e-2) * half_width
    finite = jnp.isfinite(parameters).all() & jnp.isfinite(std).all() & jnp.isfinite(covariance).all()
    sound = sound & jnp.isfinite(cost) & finite
    result = RESULTS.where(done, RESULTS.successful, RESULTS.max_sweeps)
    result = RESULTS.where((jnp.abs(parameters - center) > limit).any(), RESULTS.at_bound, result)
    result = RESULTS.where((std > prior * half_width).any(), RESULTS.unidentifiable, result)
    result = RESULTS.where(sound, result, RESULTS.nonfinite_trajectory)
    result = RESULTS.where(valid, result, RESULTS.bracket_invalid)
    told = sound & valid
    return Estimate(
        parameters=jnp.where(told, parameters, center),
        covariance=jnp.where(told, covariance, jnp.inf),
        initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
        cost=jnp.where(told, cost, jnp.inf),
        rollouts=jnp.asarray(rollouts, dtype=int),
        sweeps=jnp.asarray(sweeps, dtype=int),
        result=result,
        history=None if history is None else jnp.where(told, history, center),
    )


def fit_start(
    problem: ShootingProblem, parameters: Parameters
) -> tuple[Float[Array, " starts"], Scalar, Bool[Array, ""], int]:
    """The initial state that explains the flight best with these parameters, for algorithms that do not look for one.

    A few Gauss-Newton steps from the first measurements where it is free, held by how far off those may be. Returns it
    with the cost there, whether the trajectory is sound, and how many rollouts it took.
    """
    first, off = problem.first_state()
    count, free = parameters.shape[0], problem.free_size

    def improve(start: Float[Array, " starts"], _) -> tuple[Float[Array, " starts"], None]:
        _, gradient, information = problem.curvatures(parameters, start)
        known = 1 / jnp.square(problem.split(off))
        own = jax.vmap(invert)(information[:, count:, count:] + jax.vmap(jnp.diag)(known))
        slope = gradient[:, count:] + known * problem.split(start - first)
        return start - (own * slope[:, None, :]).sum(axis=-1).ravel(), None

    start = jax.lax.scan(improve, first, length=_START_STEPS)[0] if free else first
    cost, sound = problem.shots(parameters, start)
    return start, cost, sound, 1 + (_START_STEPS * (count + free) if free else 0)


def check_one_window(problem: ShootingProblem) -> None:
    """Raises `ValueError` for a problem that a filter cannot walk through: windows, or sensors with their own terms."""
    if problem.windows > 1:
        raise ValueError(f"`problem.windows` must be 1 for this estimator, got {problem.windows}: it shoots none.")
    if problem.model.forcing_parameters or not problem.model.observes_states:
        raise ValueError("`problem.model` must be one without rotor lag, delay, thrust curve or sensor terms: shoot.")


def check_bracket(problem: ShootingProblem, bracket: Bracket) -> None:
    """Raises `ValueError` for a bracket of another length than the model's parameters."""
    names = problem.model.parameter_names
    if bracket.lower.shape != (len(names),):
        raise ValueError(f"`bracket` must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")


class AbstractEstimator(eqx.Module):
    """An algorithm that identifies parameters; its fields are its settings.

    What an estimator can do is written on its class:

    - `looks_at`: the most channels that it compares: `"rates"`, `"attitude"` or `"all"`.
    - `shoots`: whether it minimises the problem's cost. If so, it takes windows, and its errors follow from the noise.
    - `prior`: how it uses the bracket, one of the constants in `jaxos4.bracket`.
    - `needs_network`: whether it is made from a trained network.
    """

    looks_at: AbstractClassVar[str]
    shoots: AbstractClassVar[bool]
    prior: AbstractClassVar[float]
    needs_network: AbstractClassVar[bool]

    @abc.abstractmethod
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. Batches are made by `eqx.filter_vmap`; a failing lane leaves the others alone."""
