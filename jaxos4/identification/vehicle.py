"""The staged fit of a real vehicle: identifiable parameters are estimated, the others are held and named.

If the flights hardly excite a parameter, a search for it is unreliable and makes the other estimates uncertain.
Therefore:

1. The parameters that every flight excites are fitted; the secondary ones are held at what the airframe implies.
2. The noise levels of this fit decide which of all parameters are identifiable.
3. The identifiable parameters are fitted together. Outliers are cut. Standard errors allow for coloured residuals.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters
from ..analysis.fisher import cramer_rao_bound
from ..analysis.sandwich import robust_covariance
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate, check_bracket
from ..estimators import IBSS
from ..models.abstract import AbstractModel
from ..models.held import HeldParameters, hold
from ..shooting import ShootingProblem
from .noise_levels import Refined, refine
from .results import has_answer

# Value and reason of each parameter that is held.
Held = dict[str, tuple[float, str]]
Search = Callable[[ShootingProblem, Bracket], Estimate] | AbstractEstimator

# Parameters that few flights excite: gyroscopic and aerodynamic torques are small, and an offset of the accelerometer
# looks like a thrust curve.
SECONDARY = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7", "rotor_reaction", "az_bias")
_DAMPING = ("roll_damping", "pitch_damping", "yaw_damping")
# The most passes over noise levels and outliers, and the tolerance of a search in between [standard deviations].
_PASSES = 12
_TOLERANCE = 0.1
# A damping this many standard deviations below 0 is held at 0.
_NEGATIVE = 2.0


class VehicleFit(NamedTuple):
    """The fit of a vehicle.

    - `problem`: with the noise levels that were found, and outliers cut; its model has the free parameters.
    - `estimate`: of the free parameters, with a covariance that allows for coloured residuals and cut outliers.
    - `held`: value and reason of each parameter that is held.
    - `bound`: standard deviations of the Cramer-Rao bound, as if the noise were white.
    - `cut`: the share of the measurements that Huber's loss cut.
    - `rollouts`: of all searches together.
    """

    problem: ShootingProblem
    estimate: Estimate
    held: Held
    bound: Float[Array, " parameters"]
    cut: float
    rollouts: int

    @property
    def answered(self) -> bool:
        """Whether there is an estimate at all."""
        return has_answer(self.estimate)

    @property
    def values(self) -> dict[str, float]:
        """A value for each parameter of the model, estimated or held."""
        estimated = np.asarray(self.estimate.parameters).tolist()
        values = dict(zip(self.problem.model.parameter_names, estimated, strict=True))
        return values | {name: value for name, (value, _) in self.held.items()}


def fit_vehicle(
    problem: ShootingProblem,
    bracket: Bracket,
    *,
    estimator: Search | None = None,
    huber: bool = True,
    progress: Callable[[str], None] = lambda stage: None,
) -> VehicleFit:
    """Fit a `FlightModel` to flights in windows, in the stages of this module's docstring.

    **Arguments:**

    - `problem`: its sigma is the first guess of the noise levels.
    - `bracket`: of all parameters of the model. Held parameters have the value at the bracket's centre.
    - `estimator`: of the last stage, one that shoots; IBSS by default. All other searches are by IBSS.
    - `huber`: whether outliers are cut.
    - `progress`: called with the name of each stage.

    **Raises:** `ValueError` if the bracket and the model differ in the number of parameters.
    """
    check_bracket(problem, bracket)
    model, values = problem.model, np.array(bracket.center)
    held: Held = {name: (float(values[i]), "") for i, name in enumerate(model.parameter_names) if name in SECONDARY}
    progress("fitting the parameters that every flight excites")
    free = free_bracket(bracket, model, held)
    first = _refined(_holding(problem, model, held), free, free.center, huber=False)
    if not has_answer(first.estimate):
        return VehicleFit(first.problem, first.estimate, held, first.estimate.std, 0.0, first.rollouts)

    progress("choosing the identifiable parameters")
    values[_free(model, held)] = np.asarray(first.estimate.parameters)
    held = _not_identifiable(eqx.tree_at(lambda p: p.model, first.problem, model), values, first, bracket)

    progress("fitting the identifiable parameters")
    start = eqx.tree_at(lambda p: p.sigma, problem, first.problem.sigma)
    free = free_bracket(bracket, model, held)
    last = _refined(_holding(start, model, held), free, jnp.asarray(values[_free(model, held)]), huber=huber)
    rollouts = first.rollouts + last.rollouts
    if not has_answer(last.estimate):
        return VehicleFit(last.problem, last.estimate, held, last.estimate.std, 0.0, rollouts)

    def ibss(weighted: ShootingProblem, bracket: Bracket) -> Estimate:
        return IBSS()(weighted, bracket, start=last.estimate.parameters, spread=last.estimate.covariance)

    rough = VehicleFit(last.problem, last.estimate, held, last.estimate.std, 1 - last.kept, rollouts)
    return refit(rough, estimator or ibss, bracket, progress=progress)


def refit(
    fit: VehicleFit,
    estimator: Search,
    bracket: Bracket,
    *,
    held: Held | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> VehicleFit:
    """Repeat the last search of a fit: same noise levels, same cut outliers. Other arguments as of `fit_vehicle`.

    - `held`: value and reason of the parameters to hold; those of the fit by default.
    """
    model = fit.problem.model.model if isinstance(fit.problem.model, HeldParameters) else fit.problem.model
    held = fit.held if held is None else held
    problem = _holding(fit.problem, model, held)
    estimate = estimator(problem, free_bracket(bracket, model, held))
    rollouts = fit.rollouts + int(estimate.rollouts)
    if not has_answer(estimate):
        return VehicleFit(problem, estimate, held, estimate.std, 0.0, rollouts)
    progress("computing errors")
    covariance = robust_covariance(problem, estimate.parameters, estimate.initial_state)
    # Flights too short to show the noise's colour: the noise counts as white.
    usable = jnp.isfinite(covariance).all() & (jnp.diagonal(covariance) > 0).all()
    covariance = jnp.where(usable, covariance, estimate.covariance) / (1 - fit.cut) ** 2
    bound, estimate = estimate.std, eqx.tree_at(lambda e: e.covariance, estimate, covariance)
    return VehicleFit(problem, estimate, held, bound, fit.cut, rollouts)


def _refined(problem: ShootingProblem, bracket: Bracket, start: Parameters, *, huber: bool) -> Refined:
    """A rough fit, repeated until noise levels, outliers and parameters settle."""

    def search(weighted: ShootingProblem, previous: Estimate | None, colour: float) -> Estimate:
        if previous is None:
            spread = jnp.diag(jnp.square(bracket.half_width / 2))
            return IBSS(tolerance=_TOLERANCE)(weighted, bracket, start=start, spread=spread)
        ibss, spread = IBSS(tolerance=_TOLERANCE * colour), colour**2 * previous.covariance
        return ibss(weighted, bracket, start=previous.parameters, spread=spread)

    return refine(problem, search, passes=_PASSES, start=start, huber=huber)


def _holding(problem: ShootingProblem, model: AbstractModel, held: Held) -> ShootingProblem:
    """The problem for `model` with the parameters in `held` known."""
    free = hold(model, {name: value for name, (value, _) in held.items()}) if held else model
    return eqx.tree_at(lambda p: p.model, problem, free)


def _free(model: AbstractModel, held: Held) -> np.ndarray:
    """The places of the parameters that are not held."""
    return np.array([i for i, name in enumerate(model.parameter_names) if name not in held])


def free_bracket(bracket: Bracket, model: AbstractModel, held: Held) -> Bracket:
    """The bracket of the parameters that are not held."""
    free = _free(model, held)
    return Bracket(bracket.lower[free], bracket.upper[free])


def _not_identifiable(problem: ShootingProblem, values: np.ndarray, first: Refined, bracket: Bracket) -> Held:
    """The parameters to hold: those that are not identifiable at these noise levels, and negative damping."""
    names, start = problem.model.parameter_names, first.estimate.initial_state
    # The noise is coloured, and the Cramer-Rao bound assumes that it is white.
    std = first.colour * np.sqrt(np.diagonal(np.asarray(cramer_rao_bound(problem, jnp.asarray(values), start))))
    center, identifiable = np.asarray(bracket.center), np.asarray(bracket.identifies(std))
    held = {}
    for i, name in enumerate(names):
        if not identifiable[i]:
            held[name] = (float(center[i]), "not identifiable from these flights")
        elif name in _DAMPING and values[i] < -_NEGATIVE * std[i]:
            held[name] = (0.0, "came out negative, which is impossible in air")
    # At least one parameter must be free.
    return held if len(held) < len(names) else {name: held[name] for name in SECONDARY if name in held}
