"""Predictions of measurements that were not fitted."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..analysis.disturbance import disturbances
from ..analysis.prediction import HORIZONS, Predictions, Skill, predictions, skill, starts
from ..bracket import Bracket
from ..errors import InputError
from ..estimators import EquationError
from ..flight import Flight
from ..models.held import hold
from ..models.vehicle import FlightModel
from ..shooting import ShootingProblem
from ..shooting.filtering import Noise
from .results import PredictionSkill, RateSkill, finite_or_none
from .vehicle import VehicleFit

# Memory of the regression for comparison: the best on real flights.
_MEMORY = 0.9


class HeldOut(NamedTuple):
    """Measurements that are not fitted.

    - `flight`: with these measurements.
    - `seconds`: how long they last [s].
    - `name`: of the recording.
    - `fitted_vehicle`: whether they are a part of the fitted recordings, which have their own offsets.
    """

    flight: Flight
    seconds: float
    name: str
    fitted_vehicle: bool


def check_starts(held_out: HeldOut) -> None:
    """Raise `InputError` if no part is long enough to be predicted."""
    try:
        starts(held_out.flight)
    except ValueError:
        remedy = "give `holdout` 0 or `validate`" if held_out.fitted_vehicle else "give another flight"
        raise InputError(
            f"{held_out.name}: nothing is long enough to be predicted {max(HORIZONS):g} s ahead; {remedy}."
        ) from None


def predict_held_out(
    fit: VehicleFit, model: FlightModel, held_out: HeldOut, noise: Noise | None = None
) -> tuple[Predictions, PredictionSkill]:
    """Predict the rates of measurements that were not fitted, by the fit and by a regression with the same terms.

    - `model`: with all parameters, held or not.
    - `noise`: of filter error, which predicts the disturbance too, from the measurements before each start.
    """

    def scored(parameters: Array, noise: Noise | None) -> tuple[Predictions, Skill]:
        if held_out.fitted_vehicle:
            problem = eqx.tree_at(lambda p: p.flight, fit.problem, held_out.flight)
            whole = eqx.tree_at(lambda p: p.flight, fit.problem, _joined(fit.problem.flight, held_out.flight))
        else:
            problem, parameters = _on_another_flight(fit, model, parameters, held_out.flight)
            whole = problem
        known = None if noise is None else disturbances(whole, parameters, noise)
        predicted = predictions(problem, parameters, disturbance=known)
        return predicted, skill(predicted)

    predicted, own = scored(fit.estimate.parameters, noise)
    _, regressed = scored(_regression(fit.problem, fit.estimate.parameters), None)
    tables = (own.skill, own.std, own.rmse, own.persistence, regressed.skill)
    rates = {
        rate: RateSkill(*([finite_or_none(x) for x in table[:, i]] for table in tables)) for i, rate in enumerate("pqr")
    }
    return predicted, PredictionSkill(predicted.horizons.tolist(), own.starts, **rates)


def _joined(fitted: Flight, tested: Flight) -> Flight:
    """All measurements: those that were fitted and those that were not."""
    states = np.where(np.isnan(np.asarray(tested.states)), fitted.states, tested.states)
    return eqx.tree_at(lambda f: f.states, tested, jnp.asarray(states))


def _on_another_flight(
    fit: VehicleFit, model: FlightModel, parameters: Array, flight: Flight
) -> tuple[ShootingProblem, Array]:
    """The problem of another flight, and its parameters: the mean where each recording has its own."""
    values = fit._replace(estimate=eqx.tree_at(lambda e: e.parameters, fit.estimate, parameters)).values
    stretches = 1 if flight.stretch is None else int(flight.stretch.max()) + 1
    other = FlightModel(
        model.airframe, terms=model.terms, recordings=(0,) * stretches, battery_voltage=model.battery_voltage
    )
    recordings = range(1, max(model.recordings) + 2)
    means = [
        values[name] if name in values else float(np.mean([values[f"{name}_{i}"] for i in recordings]))
        for name in other.parameter_names
    ]
    problem = ShootingProblem(other, flight, sigma=fit.problem.sigma, channels="rates", method="rk4")
    return problem, jnp.asarray(means)


@eqx.filter_jit
def _regression(problem: ShootingProblem, parameters: Array) -> Array:
    """The parameters by regression, except lag, delay and thrust curve, which regression cannot estimate."""
    names, regression = problem.model.parameter_names, EquationError(memory=_MEMORY)
    known = {names[i]: parameters[i] for i in problem.model.forcing_parameters}
    if not known:
        return regression.solution(problem, Bracket.default(problem.model))
    linear = hold(problem.model, known)
    problem = eqx.tree_at(lambda p: p.model, problem, linear)
    return linear.complete(regression.solution(problem, Bracket.default(linear)))
