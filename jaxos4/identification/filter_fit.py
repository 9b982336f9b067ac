"""The fit of a real vehicle by filter error, which treats what the model lacks as a disturbance."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._custom_types import as_float
from ..bracket import GAUSSIAN_PRIOR, Bracket, is_identifiable
from ..estimate import REACH, Estimate
from ..estimators import FilterError, FilterFit
from ..estimators.filter_error import lanes_of
from ..flight import CHANNEL_NAMES
from ..results import RESULTS
from ..shooting import ShootingProblem
from ..shooting.filtering import Noise
from .jackknife import disagreement, parts_of
from .results import Disturbance
from .vehicle import Held, VehicleFit, holding, negative_damping

# A flight has at least so many lanes, whose disagreement shows errors of the model, unless they would be too short.
_FEWEST_LANES, _SHORTEST_LANE = 8, 80
# A filter has settled after this time [s].
_SETTLED = 0.512
_PRIOR_NOTE = "not identifiable from these flights; the other intervals allow for its bracket, as a standard deviation"


class Filtered(NamedTuple):
    """A fit by filter error.

    - `fit`: the fit itself.
    - `disturbances`: by channel. `noise`: the same as logarithms.
    - `widened`: by which factor an interval was widened, by parameter.
    """

    fit: VehicleFit
    disturbances: dict[str, Disturbance]
    widened: dict[str, float]
    noise: Noise


def fit_by_filter(
    problem: ShootingProblem,
    bracket: Bracket,
    *,
    estimator: FilterError,
    recording: np.ndarray,
    progress: Callable[[str], None] = lambda stage: None,
) -> Filtered:
    """Fit a `FlightModel` to flights by filter error.

    The bracket is a prior of all parameters. A parameter about which the flights say less than the bracket has no
    estimate. Intervals widen if parts of the flights disagree.

    **Arguments:** `recording`: the number of the recording of each sample. Others as of `fit_vehicle`.
    """
    model, names = problem.model, problem.model.parameter_names
    samples = problem.flight.time.shape[0]
    lane = min(estimator.lane, max(samples // _FEWEST_LANES, _SHORTEST_LANE))
    settling = min(estimator.settling, max(round(_SETTLED / float(problem.flight.dt)), 1))
    estimator = dataclasses.replace(estimator, lane=lane, settling=settling)
    progress("compiling, and fitting parameters and disturbances")
    found = jax.block_until_ready(estimator.fit(problem, bracket))
    steps, negative = int(found.steps), negative_damping(names, *_mean_and_std(found))
    at_zero = np.array([name in negative for name in names])
    if negative:
        progress("fitting again without negative damping")
        bracket = Bracket.around(np.where(at_zero, 0.0, np.asarray(bracket.center)), np.asarray(bracket.half_width))
        found = jax.block_until_ready(estimator.fit(problem, bracket, held=at_zero, start=found))
        steps += int(found.steps)
    progress("computing errors")
    (values, std), covariance = _mean_and_std(found), np.asarray(found.covariance)
    half_width = np.asarray(bracket.half_width)
    sound = bool(np.isfinite(values).all() and np.isfinite(std).all() and np.asarray(found.innovations.sound).all())
    factor = np.ones(values.size)
    if sound:
        # The middle of the samples of each lane that count.
        index = lanes_of(samples, lane, settling)
        middle = index[:, (settling + index.shape[1]) // 2 if index.shape[0] > 1 else 0]
        factor[~at_zero] = _widening(found, half_width, ~at_zero, recording[np.minimum(middle, samples - 1)])
    identifiable = np.asarray(is_identifiable(factor * std, half_width, GAUSSIAN_PRIOR))
    if not sound or not identifiable.any():
        identifiable[:] = True
    held: Held = {name: (float(values[i]), _PRIOR_NOTE) for i, name in enumerate(names) if not identifiable[i]}
    held |= negative
    identifiable &= ~at_zero
    free = np.flatnonzero(identifiable)
    known = holding(_with_noise(problem, found), model, held)
    spread = np.diag(factor) @ covariance @ np.diag(factor)
    estimate = Estimate(
        parameters=as_float(np.where(np.isfinite(values), values, np.asarray(bracket.center))[free]),
        covariance=as_float(spread[np.ix_(free, free)] if sound else np.full((free.size, free.size), np.inf)),
        initial_state=as_float(np.nan_to_num(problem.recorded()[0, :3])),
        cost=jnp.asarray(found.innovations.cost.sum()),
        rollouts=jnp.asarray(steps * (1 + values.size)),
        sweeps=found.steps,
        result=_result(found, bracket, free, sound),
    )
    fit = VehicleFit(known, estimate, held, std[free], 0.0, int(estimate.rollouts))
    widened = {names[i]: float(factor[i]) for i in free if factor[i] > 1}
    return Filtered(fit, _disturbances(problem, found), widened, found.noise)


def _mean_and_std(found: FilterFit) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(found.parameters), np.sqrt(np.maximum(np.diagonal(np.asarray(found.covariance)), 0.0))


def _result(found: FilterFit, bracket: Bracket, free: np.ndarray, sound: bool) -> RESULTS:
    if not sound:
        return RESULTS.nonfinite_trajectory
    distance = np.abs(np.asarray(found.parameters) - np.asarray(bracket.center)) / np.asarray(bracket.half_width)
    if (distance[free] > REACH - 1e-2).any():
        return RESULTS.at_bound
    return RESULTS.successful if bool(found.done) else RESULTS.max_sweeps


def _widening(found: FilterFit, half_width: np.ndarray, fitted: np.ndarray, recording: np.ndarray) -> np.ndarray:
    """The factor by which the interval of each fitted parameter widens. `recording`: of each lane."""
    some, innovations = np.flatnonzero(fitted), found.innovations
    gradient = np.moveaxis(np.asarray(innovations.gradient).sum(axis=0)[some], -1, 0)
    information = np.moveaxis(np.asarray(innovations.information).sum(axis=0)[np.ix_(some, some)], -1, 0)
    prior = np.diag(1 / np.square(half_width[some]))
    ways = [disagreement(gradient, information, prior, part) for part in parts_of(recording.size, recording)]
    return np.max([np.ones(some.size), *ways], axis=0)


def _with_noise(problem: ShootingProblem, found: FilterFit) -> ShootingProblem:
    """The problem with the sensors' noise that was found."""
    sigma = np.array(problem.sigma)
    sigma[problem.columns] = np.exp(np.asarray(found.noise.sensor))
    return eqx.tree_at(lambda p: p.sigma, problem, as_float(np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0)))


def _disturbances(problem: ShootingProblem, found: FilterFit) -> dict[str, Disturbance]:
    strength, time_constant, sensor = (np.exp(np.asarray(leaf)) for leaf in found.noise)
    products = np.asarray(found.innovations.products).sum(axis=-1)
    correlation = products[:, 1:] / np.maximum(products[:, :1], 1.0)
    largest = np.take_along_axis(correlation, np.abs(correlation).argmax(axis=1)[:, None], axis=1)[:, 0]
    return {
        CHANNEL_NAMES[column]: Disturbance(
            strength=float(strength[i]),
            unit="rad/s^2" if i < 3 else "m/s^2",
            time_constant=float(time_constant[i]),
            sensor=float(sensor[i]),
            correlation=float(largest[i]),
        )
        for i, column in enumerate(problem.columns)
    }
