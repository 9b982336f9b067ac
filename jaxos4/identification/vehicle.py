"""The staged fit of a real vehicle: identifiable parameters are estimated, the others are held and named.

If the flights hardly excite a parameter, a search for it is unreliable and makes the other estimates uncertain.
Therefore:

1. The parameters that every flight excites are fitted; the secondary ones are held at what the airframe implies.
2. The noise levels of this fit decide which of all parameters are identifiable.
3. The identifiable parameters are fitted together. Outliers are cut. Standard errors allow for coloured residuals.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from .._custom_types import as_float
from ..analysis.evaluation import Evaluation, evaluate
from ..analysis.sandwich import robust_covariance_of
from ..bracket import Bracket, is_identifiable
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
    bound: Float[np.ndarray, " free"]
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
    progress("compiling, and fitting the parameters that every flight excites")
    first = _refined(_Part(model, bracket, held), problem, values[_free(model, held)], huber=False)
    if not has_answer(first.estimate):
        return _no_fit(holding(first.problem, model, held), first.estimate, held, first.rollouts)

    progress("choosing the identifiable parameters")
    values[_free(model, held)] = np.asarray(first.estimate.parameters)
    held = _not_identifiable(first, values, bracket)

    progress("fitting the identifiable parameters")
    start, part = eqx.tree_at(lambda p: p.sigma, problem, first.problem.sigma), _Part(model, bracket, held)
    last = _refined(part, start, values[_free(model, held)], huber=huber)
    rollouts, known = first.rollouts + last.rollouts, holding(last.problem, model, held)
    if not has_answer(last.estimate):
        return _no_fit(known, last.estimate, held, rollouts)

    def ibss(weighted: ShootingProblem, bracket: Bracket) -> Estimate:
        del bracket
        whole = eqx.tree_at(lambda p: p.model, weighted, model)
        return part.search(IBSS(), whole, last.estimate.parameters, last.estimate.covariance)

    rough = VehicleFit(known, last.estimate, held, _std(last.estimate), 1 - last.kept, rollouts)
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
    problem = holding(fit.problem, model, held)
    estimate = estimator(problem, free_bracket(bracket, model, held))
    rollouts = fit.rollouts + int(estimate.rollouts)
    if not has_answer(estimate):
        return _no_fit(problem, estimate, held, rollouts)
    progress("computing errors")
    evaluation = _Part(model, bracket, held).evaluate(eqx.tree_at(lambda p: p.model, problem, model), estimate)
    covariance, bound = robust_covariance_of(evaluation), _std(estimate)
    # Flights too short to show the noise's colour: the noise counts as white.
    if not (np.isfinite(covariance).all() and (np.diagonal(covariance) > 0).all()):
        covariance = np.asarray(estimate.covariance)
    estimate = eqx.tree_at(lambda e: e.covariance, estimate, as_float(covariance / (1 - fit.cut) ** 2))
    return VehicleFit(problem, estimate, held, bound, fit.cut, rollouts)


class _Part(NamedTuple):
    """The parameters of a model that are fitted, and those that are held.

    The search, and the simulation at its answer, take the whole model. Which parameters are held is data to them, so
    that all stages share two compiled programs. `bracket`: of all parameters.
    """

    model: AbstractModel
    bracket: Bracket
    held: Held

    @property
    def free(self) -> np.ndarray:
        """The places of the fitted parameters."""
        return _free(self.model, self.held)

    def complete(self, parameters: Float[ArrayLike, " free"]) -> Float[np.ndarray, " parameters"]:
        """All parameters, from those that are fitted."""
        values = {name: value for name, (value, _) in self.held.items()}
        everything = np.array([values.get(name, 0.0) for name in self.model.parameter_names])
        everything[self.free] = parameters
        return everything

    def search(
        self,
        ibss: IBSS,
        problem: ShootingProblem,
        start: Float[ArrayLike, " free"],
        spread: Float[ArrayLike, "free free"],
    ) -> Estimate:
        """The fitted parameters. `problem`: of the whole model."""
        free, count = self.free, len(self.model.parameter_names)
        covariance, searched = np.zeros((count, count)), np.zeros(count, dtype=bool)
        covariance[np.ix_(free, free)], searched[free] = spread, True
        found = ibss(
            problem,
            self.bracket,
            start=as_float(self.complete(start)),
            spread=as_float(covariance),
            free=jax.device_put(searched),
        )
        some = as_float(np.asarray(found.parameters)[free]), as_float(np.asarray(found.covariance)[np.ix_(free, free)])
        return eqx.tree_at(lambda e: (e.parameters, e.covariance), found, some)

    def evaluate(self, problem: ShootingProblem, estimate: Estimate) -> Evaluation:
        """The flight simulated at an estimate. `problem`: of the whole model."""
        parameters = as_float(self.complete(estimate.parameters))
        return evaluate(problem, parameters, estimate.initial_state).of_parameters(self.free)


def _refined(part: _Part, problem: ShootingProblem, start: np.ndarray, *, huber: bool) -> Refined:
    """A rough fit, repeated until noise levels, outliers and parameters settle. `problem`: of the whole model."""
    half_width = np.asarray(part.bracket.half_width)[part.free]

    def search(weighted: ShootingProblem, previous: Estimate | None, colour: float) -> Estimate:
        if previous is None:
            return part.search(IBSS(tolerance=_TOLERANCE), weighted, start, np.diag(np.square(half_width / 2)))
        ibss, spread = IBSS(tolerance=_TOLERANCE * colour), colour**2 * np.asarray(previous.covariance)
        return part.search(ibss, weighted, previous.parameters, spread)

    return refine(problem, search, passes=_PASSES, evaluation=part.evaluate, start=start, huber=huber)


def _no_fit(problem: ShootingProblem, estimate: Estimate, held: Held, rollouts: int) -> VehicleFit:
    return VehicleFit(problem, estimate, held, _std(estimate), 0.0, rollouts)


def _std(estimate: Estimate) -> Float[np.ndarray, " free"]:
    return np.sqrt(np.diagonal(estimate.covariance))


def holding(problem: ShootingProblem, model: AbstractModel, held: Held) -> ShootingProblem:
    """The problem for `model` with the parameters in `held` known."""
    free = hold(model, {name: value for name, (value, _) in held.items()}) if held else model
    return eqx.tree_at(lambda p: p.model, problem, free)


def _free(model: AbstractModel, held: Held) -> np.ndarray:
    """The places of the parameters that are not held."""
    return np.array([i for i, name in enumerate(model.parameter_names) if name not in held])


def free_bracket(bracket: Bracket, model: AbstractModel, held: Held) -> Bracket:
    """The bracket of the parameters that are not held."""
    free = _free(model, held)
    return Bracket(np.asarray(bracket.lower)[free], np.asarray(bracket.upper)[free])


def negative_damping(names: Sequence[str], values: np.ndarray, std: np.ndarray) -> Held:
    """The dampings that came out negative, which are held at 0."""
    return {
        name: (0.0, "came out negative, which is impossible in air")
        for name, value, error in zip(names, values, std, strict=True)
        if name in _DAMPING and value < -_NEGATIVE * error
    }


def _not_identifiable(first: Refined, values: np.ndarray, bracket: Bracket) -> Held:
    """The parameters to hold: those that are not identifiable at these noise levels, and negative damping."""
    names = first.problem.model.parameter_names
    # The noise is coloured, and the Cramer-Rao bound assumes that it is white.
    bound = evaluate(first.problem, as_float(values), first.estimate.initial_state).covariance
    std, center = first.colour * np.sqrt(np.diagonal(bound)), np.asarray(bracket.center)
    identifiable = is_identifiable(std, np.asarray(bracket.half_width))
    negative = negative_damping(names, values, std)
    held = {
        name: (float(center[i]), "not identifiable from these flights")
        for i, name in enumerate(names)
        if not identifiable[i]
    }
    held = negative | held
    # At least one parameter must be free.
    return held if len(held) < len(names) else {name: held[name] for name in SECONDARY if name in held}
