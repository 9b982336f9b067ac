"""The fit of a real vehicle: what its flights can tell is estimated, what they cannot is held and named.

Parameters that hardly show make a search wander and the others uncertain. First those that every flight tells are
fitted, with the secondary ones held at what the airframe implies. The noise that this leaves says which of the others
can be told; those are freed, and everything is fitted again, outliers cut, with errors that allow for coloured
residuals.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters
from ..analysis.fisher import cramer_rao_bound
from ..analysis.huber import winsorised
from ..analysis.sandwich import robust_covariance
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..estimators import IBSS
from ..models.abstract import AbstractModel
from ..models.held import hold
from ..results import result_names
from ..shooting import ShootingProblem

# What turns the flow of the air, the gyroscope and the rotors' spin into small torques, and the accelerometer's zero,
# which looks like a thrust curve: told by few flights.
SECONDARY = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7", "rotor_reaction", "az_bias")
_DAMPING = ("roll_damping", "pitch_damping", "yaw_damping")
# Noise levels that change by less than this share from one search to the next are found.
_OFF = 0.2
# Outliers are cut until no parameter moves by more than this many of its standard deviations, those of coloured noise.
_STILL = 0.2
_PASSES = 12
# While these are sought, a search ends within so many of them.
_ROUGH = 0.1
# A damping below zero by more than so many standard deviations is none.
_NEGATIVE = 2.0
# Correlation of neighbouring residuals, beyond which the count of independent ones means nothing.
_MOST_COLOUR = 0.98
NO_ANSWER = ("nonfinite_trajectory", "bracket_invalid", "network_mismatch")


class VehicleFit(NamedTuple):
    """What flights tell of a vehicle.

    - `problem`: with the noise found, and outliers cut; its model is the whole one, less what is held.
    - `estimate`: of what is left, with a covariance that allows for coloured residuals and cut outliers.
    - `held`: each parameter that is held: its value, and why.
    - `bound`: standard deviations of the Cramer-Rao bound at the noise found, as if that were white.
    - `cut`: the share of the measurements that Huber's loss cut.
    - `rollouts`: of all searches together.
    """

    problem: ShootingProblem
    estimate: Estimate
    held: dict[str, tuple[float, str]]
    bound: Float[Array, " parameters"]
    cut: float
    rollouts: int

    @property
    def answered(self) -> bool:
        """Whether there is an estimate at all."""
        return _answered(self.estimate)


def fit_vehicle(
    problem: ShootingProblem,
    bracket: Bracket,
    *,
    estimator: Callable[[ShootingProblem, Bracket], Estimate] | AbstractEstimator | None = None,
    huber: bool = True,
    progress: Callable[[str], None] = lambda stage: None,
) -> VehicleFit:
    """Fits a `FlightModel` to flights cut into windows, in the stages that this module's docstring tells.

    **Arguments:**

    - `problem`: its sigma is where the search for the noise levels begins.
    - `bracket`: of all parameters of the model; what is held, is held at its center.
    - `estimator`: of the answer, one that shoots; IBSS by default. Noise levels, outliers, and what is told are found
      by IBSS.
    - `huber`: whether outliers are cut.
    - `progress`: told of each stage.

    **Raises:** `ValueError` for a bracket of another length than the model's parameters.
    """
    whole, names = problem.model, problem.model.parameter_names
    if bracket.lower.shape != (len(names),):
        raise ValueError(f"`bracket` must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")
    values = np.array(bracket.center)
    held = {name: (float(values[i]), "") for i, name in enumerate(names) if name in SECONDARY}
    progress("fitting what every flight tells")
    left = _left(bracket, whole, held)
    first = _settle(_holding(problem, whole, held), left, left.center, huber=False)
    if not first.answered:
        return _unanswered(first, held, first.rollouts)

    progress("asking what else can be told")
    values[_free(whole, held)] = np.asarray(first.estimate.parameters)
    held = _not_identifiable(eqx.tree_at(lambda p: p.model, first.problem, whole), values, first, bracket)

    progress("fitting all that can be told")
    start = eqx.tree_at(lambda p: p.sigma, problem, first.problem.sigma)
    left = _left(bracket, whole, held)
    last = _settle(_holding(start, whole, held), left, jnp.asarray(values[_free(whole, held)]), huber=huber)
    if not last.answered:
        return _unanswered(last, held, first.rollouts + last.rollouts)
    rough, used = last.estimate, last.problem
    if estimator is None:
        found = IBSS()(used, left, start=rough.parameters, spread=rough.covariance)
    else:
        found = estimator(used, left)
    rollouts = first.rollouts + last.rollouts + int(found.rollouts)
    if not _answered(found):
        return _unanswered(last._replace(estimate=found), held, rollouts)
    progress("computing errors")
    covariance = robust_covariance(used, found.parameters, found.initial_state)
    # Where flights are too short to tell their noise's colour it is taken as white.
    told = jnp.isfinite(covariance).all() & (jnp.diagonal(covariance) > 0).all()
    covariance = jnp.where(told, covariance, found.covariance) / last.share**2
    bound, found = found.std, eqx.tree_at(lambda e: e.covariance, found, covariance)
    return VehicleFit(used, found, held, bound, 1 - last.share, rollouts)


class _Fit(NamedTuple):
    problem: ShootingProblem
    estimate: Estimate
    rollouts: int
    growth: float
    share: float

    @property
    def answered(self) -> bool:
        return _answered(self.estimate)


def _answered(estimate: Estimate) -> bool:
    return str(result_names(estimate.result)) not in NO_ANSWER


def _settle(problem: ShootingProblem, bracket: Bracket, start: Parameters, *, huber: bool) -> _Fit:
    """A rough fit, repeated with the noise levels that its residuals tell, and outliers cut, until it stands still."""
    found = IBSS(tolerance=_ROUGH)(problem, bracket, start=start, spread=jnp.diag(jnp.square(bracket.half_width / 2)))
    used, rollouts, share, growth = problem, int(found.rollouts), 1.0, 1.0
    for _ in range(_PASSES):
        if not _answered(found):
            break
        if huber:
            told, left, residuals = winsorised(problem, found.parameters, found.initial_state)
            share = float(left)
        else:
            residuals = used.residuals(found.parameters, found.initial_state).reshape(-1, problem.columns.size)
            told = used.reweighted(residuals.ravel())
        growth = _growth(np.asarray(residuals))
        moved, changed = jnp.abs(found.parameters - start) / found.std, jnp.abs(told.sigma / used.sigma - 1)
        start, used = found.parameters, told
        if changed.max() < _OFF and (not huber or moved.max() < _STILL * growth):
            break
        search = IBSS(tolerance=_ROUGH * growth)
        found = search(used, bracket, start=start, spread=growth**2 * found.covariance)
        rollouts += int(found.rollouts)
    return _Fit(used, found, rollouts, growth, share)


def _free(whole: AbstractModel, held: dict[str, tuple[float, str]]) -> np.ndarray:
    return np.array([i for i, name in enumerate(whole.parameter_names) if name not in held])


def _holding(problem: ShootingProblem, whole: AbstractModel, held: dict[str, tuple[float, str]]) -> ShootingProblem:
    model = hold(whole, {name: value for name, (value, _) in held.items()}) if held else whole
    return eqx.tree_at(lambda p: p.model, problem, model)


def _left(bracket: Bracket, whole: AbstractModel, held: dict[str, tuple[float, str]]) -> Bracket:
    free = _free(whole, held)
    return Bracket(bracket.lower[free], bracket.upper[free])


def _not_identifiable(
    problem: ShootingProblem, values: np.ndarray, first: _Fit, bracket: Bracket
) -> dict[str, tuple[float, str]]:
    """What these flights cannot tell at the noise found, and damping that came out negative.

    A parameter is told where its standard deviation is below half the width of its bracket. That of the Cramer-Rao
    bound is for white noise, and grows with the residuals' colour.
    """
    names, start = problem.model.parameter_names, first.estimate.initial_state
    std = first.growth * np.sqrt(np.diagonal(np.asarray(cramer_rao_bound(problem, jnp.asarray(values), start))))
    center, half_width = np.asarray(bracket.center), np.asarray(bracket.half_width)
    held = {}
    for i, name in enumerate(names):
        if not std[i] <= half_width[i]:
            held[name] = (float(center[i]), "not identifiable from these flights")
        elif name in _DAMPING and values[i] < -_NEGATIVE * std[i]:
            held[name] = (0.0, "came out negative, which no air does")
    # Something is left to estimate, whatever the flights tell.
    return held if len(held) < len(names) else {name: held[name] for name in SECONDARY if name in held}


def _growth(residuals: np.ndarray) -> float:
    """By how much errors exceed those of white noise, as if residuals were a first-order process.

    The root of (1 + rho) / (1 - rho), the worst channel's, where neighbouring residuals correlate by rho.
    """
    products = residuals[1:] * residuals[:-1]
    # What was not measured is 0, and no neighbour.
    pairs = products != 0
    power = np.where(pairs, (np.square(residuals[1:]) + np.square(residuals[:-1])) / 2, 0.0).sum(axis=0)
    neighbours = products.sum(axis=0)
    rho = np.clip(neighbours / np.where(power > 0, power, 1.0), 0.0, _MOST_COLOUR)
    return float(np.sqrt(((1 + rho) / (1 - rho)).max()))


def _unanswered(fit: _Fit, held: dict[str, tuple[float, str]], rollouts: int) -> VehicleFit:
    return VehicleFit(fit.problem, fit.estimate, held, fit.estimate.std, 0.0, rollouts)
