"""The fit of a real vehicle: what its flights can tell is estimated, what they cannot is held and named.

Parameters that hardly show make a search wander and the others uncertain. First those that every flight tells are
fitted, with the secondary ones held at what the airframe implies. The noise that this leaves says which of the others
can be told; those are freed, and everything is fitted again, outliers cut, with errors that allow for coloured
residuals.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._custom_types import Parameters
from .bracket import Bracket
from .dynamics import AbstractModel
from .estimators import IBSS, AbstractEstimator, Estimate
from .held import hold
from .information import cramer_rao_bound, robust_covariance
from .results import result_names
from .robust import winsorised
from .shooting import ShootingProblem

# What turns the flow of the air, the gyroscope and the rotors' spin into small torques: told by few flights.
SECONDARY = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7", "rotor_reaction")
_DAMPING = ("roll_damping", "pitch_damping", "yaw_damping")
# Noise levels that change by less than this share from one fit to the next are found.
_OFF = 0.2
_PASSES = 4
# Outliers are cut until no parameter moves by more than this many of its standard deviations.
_STILL = 0.1
# A damping below zero by more than so many standard deviations is none.
_NEGATIVE = 2.0
# Correlation of neighbouring residuals, beyond which the count of independent ones means nothing.
_MOST_COLOUR = 0.98
NO_ANSWER = ("nonfinite_trajectory", "bracket_invalid", "network_mismatch")


class VehicleFit(NamedTuple):
    """What flights tell of a vehicle.

    - `problem`: with the noise found; its model is the whole one, less what is held.
    - `estimate`: of what is left, with a covariance that allows for coloured residuals and cut outliers.
    - `held`: each parameter that is held: its value, and why.
    - `bound`: standard deviations of the Cramer-Rao bound at the noise found, as if that were white.
    - `cut`: the share of the measurements that Huber's loss cut.
    - `rollouts`: of all fits together.
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
        return str(result_names(self.estimate.result)) not in NO_ANSWER


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
    - `estimator`: of the last stage, one that shoots; IBSS by default. What is told is found by IBSS.
    - `huber`: whether outliers are cut.
    - `progress`: told of each stage.

    **Raises:** `ValueError` for a bracket of another length than the model's parameters.
    """
    whole, names = problem.model, problem.model.parameter_names
    if bracket.lower.shape != (len(names),):
        raise ValueError(f"`bracket` must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")
    centers = dict(zip(names, np.asarray(bracket.center).tolist(), strict=True))
    held = {name: (centers[name], "") for name in SECONDARY if name in names}
    progress("fitting what every flight tells")
    first = _fit_noise(IBSS(), _holding(problem, whole, held), _left(bracket, whole, held))
    if not first.answered:
        return _unanswered(first, held)

    progress("asking what else can be told")
    values = np.array([centers[name] for name in names])
    free = np.array([i for i, name in enumerate(names) if name not in held])
    values[free] = np.asarray(first.estimate.parameters)
    held = _untold(eqx.tree_at(lambda p: p.model, first.problem, whole), values, first, bracket)

    progress("fitting all that can be told")
    method = IBSS() if estimator is None else estimator
    start = eqx.tree_at(lambda p: p.sigma, problem, first.problem.sigma)
    last = _fit_noise(method, _holding(start, whole, held), _left(bracket, whole, held))
    rollouts = first.rollouts + last.rollouts
    if not last.answered:
        return _unanswered(last._replace(rollouts=rollouts), held)

    share = 1.0
    used, found = last.problem, last.estimate
    if huber:
        progress("cutting outliers")
        for _ in range(_PASSES):
            cut = winsorised(last.problem, found.parameters, found.initial_state)
            again = method(cut.problem, _left(bracket, whole, held))
            rollouts += int(again.rollouts)
            if str(result_names(again.result)) in NO_ANSWER:
                break
            moved = float((jnp.abs(again.parameters - found.parameters) / again.std).max())
            used, found, share = cut.problem, again, float(cut.share)
            if moved < _STILL:
                break
    progress("computing errors")
    bound = jnp.sqrt(jnp.diagonal(cramer_rao_bound(used, found.parameters, found.initial_state)))
    covariance = robust_covariance(used, found.parameters, found.initial_state) / share**2
    # Colour that averages out does not make an error smaller than white noise would.
    covariance = jnp.where(jnp.isfinite(covariance).all(), covariance, found.covariance)
    found = eqx.tree_at(lambda e: e.covariance, found, covariance)
    return VehicleFit(used, found, held, bound, 1 - share, rollouts)


class _Fit(NamedTuple):
    problem: ShootingProblem
    estimate: Estimate
    rollouts: int

    @property
    def answered(self) -> bool:
        return str(result_names(self.estimate.result)) not in NO_ANSWER


def _fit_noise(method, problem: ShootingProblem, bracket: Bracket) -> _Fit:
    """A fit, repeated with the noise levels that its residuals tell until these stand."""
    found = jax.block_until_ready(method(problem, bracket))
    fit = _Fit(problem, found, int(found.rollouts))
    for _ in range(_PASSES):
        if not fit.answered:
            return fit
        found, used = fit.estimate, fit.problem
        problem = used.reweighted(used.residuals(found.parameters, found.initial_state))
        if bool(jnp.all(jnp.abs(problem.sigma / used.sigma - 1) < _OFF)):
            return fit._replace(problem=problem)
        found = jax.block_until_ready(method(problem, bracket))
        fit = _Fit(problem, found, fit.rollouts + int(found.rollouts))
    return fit


def _holding(problem: ShootingProblem, whole: AbstractModel, held: dict[str, tuple[float, str]]) -> ShootingProblem:
    model = hold(whole, {name: value for name, (value, _) in held.items()}) if held else whole
    return eqx.tree_at(lambda p: p.model, problem, model)


def _left(bracket: Bracket, whole: AbstractModel, held: dict[str, tuple[float, str]]) -> Bracket:
    free = np.array([i for i, name in enumerate(whole.parameter_names) if name not in held])
    return Bracket(bracket.lower[free], bracket.upper[free])


def _untold(
    problem: ShootingProblem, values: np.ndarray, first: _Fit, bracket: Bracket
) -> dict[str, tuple[float, str]]:
    """What these flights cannot tell at the noise found, and damping that came out negative.

    A parameter is told where its standard deviation is below half the width of its bracket. That of the Cramer-Rao
    bound is for white noise: it grows by the root of (1 + rho) / (1 - rho), the worst channel's, where neighbouring
    residuals correlate by rho.
    """
    names, start = problem.model.parameter_names, first.estimate.initial_state
    residuals = np.asarray(first.problem.residuals(first.estimate.parameters, start))
    growth = _growth(residuals.reshape(-1, problem.columns.size))
    std = growth * np.sqrt(np.diagonal(np.asarray(cramer_rao_bound(problem, jnp.asarray(values), start))))
    center, half_width = np.asarray(bracket.center), np.asarray(bracket.half_width)
    held = {}
    for i, name in enumerate(names):
        if not std[i] <= half_width[i]:
            held[name] = (float(center[i]), "not told by these flights")
        elif name in _DAMPING and values[i] < -_NEGATIVE * std[i]:
            held[name] = (0.0, "came out negative, which no air does")
    # Something is left to estimate, whatever the flights tell.
    return held if len(held) < len(names) else {name: held[name] for name in SECONDARY if name in held}


def _growth(residuals: np.ndarray) -> float:
    """By how much errors exceed those of white noise, as if residuals were a first-order process."""
    power = np.square(residuals).sum(axis=0)
    neighbours = (residuals[1:] * residuals[:-1]).sum(axis=0)
    rho = np.clip(neighbours / np.where(power > 0, power, 1.0), 0.0, _MOST_COLOUR)
    return float(np.sqrt(((1 + rho) / (1 - rho)).max()))


def _unanswered(fit: _Fit, held: dict[str, tuple[float, str]]) -> VehicleFit:
    return VehicleFit(fit.problem, fit.estimate, held, fit.estimate.std, 0.0, fit.rollouts)


def whole_parameters(fit: VehicleFit, model: AbstractModel) -> Parameters:
    """A value for each parameter of the whole model: estimated, or held."""
    found = dict(zip(fit.problem.model.parameter_names, np.asarray(fit.estimate.parameters).tolist(), strict=True))
    return jnp.asarray([found[name] if name in found else fit.held[name][0] for name in model.parameter_names])
