"""`Answer`: an estimate with intervals, and tables of its parameters and moments of inertia."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import msgspec
import numpy as np
from jaxtyping import Float

from .._custom_types import Parameters, finite_or_none
from ..airframe import AXES, INVERSES, YAW, Airframe
from ..analysis.diagnostics import Diagnostics
from ..analysis.evaluation import Evaluation
from ..analysis.inertia import fit_inertia
from ..bracket import is_identifiable
from ..estimate import Estimate
from ..models.abstract import PARAMETER_NAMES
from ..models.flight_model import FlightModel
from ..models.os4 import CorrectedOS4
from ..models.terms import follows_commands
from ..results import NINETY_FIVE, has_answer
from ..shooting import ShootingProblem
from .data import Data
from .results import Constant, Disturbance, FixedParameter, ParameterEstimate, RigidBody
from .search import Optimum

UNIT = "kg m^2"
NEGATIVE_NOTE = "negative, which is impossible; set to 0"


SCALE_ERROR = 0.01  # relative error of an accelerometer's scale, including the additional lift in forward flight
GUESSED_DRAG = 0.4  # relative standard deviation of a guess: nearly all published quadrotors are within it
# If the thrust differs from the airframe's by more than this share, the airframe's coefficients were not measured
# together, and their ratio may be wrong by as much.
OTHER_THRUST = 0.1
UNKNOWN = 1e3  # half-widths; standard deviation of an alpha that was not estimated
NOTED = 1.05  # smallest widening factor of an interval that is reported, with one decimal


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """An estimate of the parameters and of the sensors' noise: an `OS4Answer` or a `VehicleAnswer`.

    - `problem`: the flight and its model, with the estimated noise levels of the sensors.
    - `estimate`: the intervals follow from its covariance.
    - `bound`: the Cramer-Rao bound: standard deviations of the parameters if the model were right.
    - `rollouts`: simulated flights in all searches together.
    - `fixed`: the parameters that are not estimated.
    - `negative`: value and standard deviation of the parameters that came out negative and were set to 0.
    - `profiled`: the factor by which the profile widened an interval, by parameter.
    """

    problem: ShootingProblem
    estimate: Estimate
    bound: Float[np.ndarray, " parameters"]
    rollouts: int
    fixed: Mapping[str, FixedParameter] = dataclasses.field(default_factory=dict, kw_only=True)
    negative: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict, kw_only=True)
    profiled: Mapping[str, float] = dataclasses.field(default_factory=dict, kw_only=True)

    @property
    def answered(self) -> bool:
        """Whether there is an estimate at all."""
        return has_answer(self.estimate.result)

    @property
    def parameters(self) -> Float[np.ndarray, " parameters"]:
        """The estimated parameters of the model. The estimate may have further unknowns, such as noise levels."""
        return np.asarray(self.estimate.parameters)[: self.problem.unknowns.count]

    @property
    def free(self) -> list[int]:
        """The indices of the parameters that are estimated."""
        return [i for i, name in enumerate(self.problem.model.parameter_names) if name not in self.fixed]

    @property
    def gains(self) -> list[int]:
        """The indices of the parameters that scale all torques."""
        return [i for i, parameter in enumerate(self.problem.model.parameters) if parameter.scales_torque]

    @property
    def thrust(self) -> float:
        """All torques at the same motor signal, over the airframe's; 1 if no parameter scales them."""
        return float(np.prod(self.parameters[self.gains]))


@dataclasses.dataclass(frozen=True, eq=False)
class OS4Answer(Answer):
    """The answer for one flight of an OS4.

    - `evaluation`, `diagnostics`: the flight simulated at the estimate, and its residuals; `None` without an answer.
    """

    evaluation: Evaluation | None = None
    diagnostics: Diagnostics | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class VehicleAnswer(Answer):
    """The answer for a vehicle.

    - `optimum`: where the search ended.
    - `disturbances`: by channel.
    - `widened`: the factor by which the jackknife widened an interval, by parameter.
    """

    optimum: Optimum
    disturbances: Mapping[str, Disturbance]
    widened: Mapping[str, float]


def shared_fields(data: Data, answer: Answer, estimator: str) -> dict[str, Any]:
    """The fields that the results of an OS4 and of a vehicle share. `estimator`: the estimator's name."""
    free = answer.free
    covariance = np.asarray(answer.estimate.covariance)[np.ix_(free, free)]
    return {
        "estimator": estimator,
        "rollouts": answer.rollouts,
        "cost": finite_or_none(answer.estimate.cost),
        "provenance": data.provenance,
        "covariance": covariance.tolist() if np.isfinite(covariance).all() else None,
        "airframe": answer.problem.model.airframe,
        "estimate": answer.estimate,
        "problem": answer.problem,
    }


def parameter_table(
    answer: Answer, largest_std: float, missing: Mapping[str, str] = {}
) -> dict[str, ParameterEstimate]:
    """Estimates by parameter name, without those that are fixed.

    Parameters that are not identifiable (`jaxos4.bracket.is_identifiable`) have a note instead of an estimate.

    **Arguments:** `largest_std`: see `AbstractEstimator`. `missing`: why a parameter is not identifiable, by name.
    """
    estimate, unknowns = answer.estimate, answer.problem.unknowns
    std, width = map(np.asarray, _intervals(estimate))
    values, half_width = answer.parameters, np.asarray(unknowns.half_width)
    lower, upper = np.asarray(unknowns.bracket.lower), np.asarray(unknowns.bracket.upper)
    identifiable = np.asarray(is_identifiable(std[: unknowns.count], half_width, largest_std))
    # No likelihood shows an error of the accelerometer's scale.
    scale = np.zeros_like(std)
    for gain in answer.gains:
        scale[gain] = SCALE_ERROR * values[gain]
    std, width = np.hypot(std, scale), np.hypot(width, NINETY_FIVE * scale)

    def row(i: int, name: str) -> ParameterEstimate:
        value, half, known = float(values[i]), float(width[i]), bool(identifiable[i])
        least = 0.0 if name in answer.negative else -np.inf
        found = ParameterEstimate(
            estimate=value if known else None,
            std=finite_or_none(std[i]),
            bound=finite_or_none(answer.bound[i]),
            ci95=(max(value - half, least), value + half) if known else None,
            unit=unknowns.units[i],
            note="" if known else missing.get(name, "not identifiable from this flight"),
            bracket=(float(lower[i]), float(upper[i])) if np.isfinite([lower[i], upper[i]]).all() else None,
        )
        return msgspec.structs.replace(found, note="; ".join(parameter_notes(answer, name, found))) if known else found

    return {unknowns.names[i]: row(i, unknowns.names[i]) for i in answer.free}


@eqx.filter_jit  # one compiled program instead of one for each operation
def _intervals(estimate: Estimate) -> tuple[Parameters, Parameters]:
    return estimate.std, estimate.half_width(0.95)


def parameter_notes(answer: Answer, name: str, row: ParameterEstimate) -> list[str]:
    """The warnings about a parameter that has an estimate."""
    i, seed, bracket = answer.problem.unknowns.names.index(name), answer.estimate.seed, answer.problem.unknowns.bracket
    value = float(answer.parameters[i])
    if name in answer.negative:
        return [NEGATIVE_NOTE]
    notes = ["below noise"] if row.is_below_noise else []
    if not np.asarray(bracket.lower)[i] <= value <= np.asarray(bracket.upper)[i]:
        notes.append("outside its bracket")
    if seed is not None and not np.asarray(seed.lower)[i] <= value <= np.asarray(seed.upper)[i]:
        notes.append("outside the network's interval")
    factor = answer.profiled.get(name, 1.0)
    if factor >= NOTED:
        notes.append(f"interval {factor:.1f} times as long, by the profile of the likelihood")
    return notes


def dominated(answer: VehicleAnswer) -> dict[str, str]:
    """The axes on which the disturbance is larger than the effect of the rotors, with the figures in words.

    Yaw is also listed if alpha8 is not identifiable. Roll without alpha3, and pitch without alpha6, are not listed,
    because their inertias are missing anyway.
    """
    omega, mixer = np.asarray(answer.problem.flight.omega, dtype=float), np.asarray(answer.problem.model.airframe.mixer)
    torques = (omega[:-1] ** 2 @ mixer[:3].T).std(axis=0)
    alpha, weak = np.abs(answer.parameters), {}
    strengths = {rate: row.strength for rate, row in answer.disturbances.items()}
    for axis, torque in zip(AXES, torques, strict=True):
        control, strength = alpha[axis.place] * torque, strengths.get(axis.rate, 0.0)
        if axis.inverse in answer.fixed:
            weak |= {axis.motion: f"the flights say less about {axis.inverse} than its bracket"} if axis == YAW else {}
        elif strength > control:
            weak[axis.motion] = (
                f"about {axis.motion}, the disturbance ({strength:.2g} rad/s^2) is larger than what the rotors do "
                f"({control:.2g} rad/s^2)"
            )
    return weak


def thrust_excess(answer: Answer) -> float:
    """The share by which thrust exceeds the airframe's at the same rotor speeds; 0 if the logs do not show it."""
    model = answer.problem.model
    if isinstance(model, FlightModel) and follows_commands(model.terms):
        return 0.0  # a full speed that is wrong makes thrust and drag wrong by the same factor
    return answer.thrust - 1


def drag_error(answer: Answer) -> float:
    """The relative standard deviation of the ratio of drag to thrust, from the airframe and the fitted thrust."""
    return ratio_error(answer.problem.model.airframe, thrust_excess(answer))


def ratio_error(airframe: Airframe, excess: float) -> float:
    """The relative standard deviation of an airframe's ratio of drag to thrust.

    `excess`: the share by which the thrust exceeds the airframe's.
    """
    if airframe.guesses_drag:
        return GUESSED_DRAG
    return abs(excess) if abs(excess) > OTHER_THRUST else 0.0


def vehicle_constants(answer: Answer) -> RigidBody:
    """Ix, Iy and Iz of a vehicle, as far as alpha3, alpha6 and alpha8 were estimated."""
    model, free, values = answer.problem.model, answer.free, answer.parameters
    known, bracket = np.isin(PARAMETER_NAMES, [model.parameter_names[i] for i in free]), answer.problem.unknowns
    alpha, slopes = np.where(known, values[:8], np.asarray(bracket.center)[:8]), np.eye(8, values.size)
    gains = answer.gains
    for gain in gains:
        # Torques exceed the airframe's by this factor, even if the factor is hardly known.
        for place in INVERSES:
            alpha[place] /= values[gain]
            slopes[place, place], slopes[place, gain] = 1 / values[gain], -alpha[place] / values[gain]
    slopes[~known] = 0.0
    unknown = np.where(known, 0.0, (UNKNOWN * np.asarray(bracket.half_width)[:8]) ** 2)
    covariance = np.asarray(answer.estimate.covariance)[: values.size, : values.size]
    covariance = slopes @ covariance @ slopes.T + np.diag(unknown)
    # An error of the accelerometer's scale makes all inertias wrong by one factor.
    scale = SCALE_ERROR * bool(gains)
    shared = scale * np.where(np.isin(np.arange(8), INVERSES), alpha, 0.0)
    covariance += shared[:, None] * shared
    covariance[YAW.place, YAW.place] += (drag_error(answer) * alpha[YAW.place]) ** 2
    constants, thrust = {}, "mass" if gains else "thrust_coefficient"
    ratio = float(model.airframe.drag_coefficient / model.airframe.thrust_coefficient)
    of_yaw = f"{thrust} and the ratio of drag to thrust, {ratio:.3g} m,"
    if model.airframe.guesses_drag:
        of_yaw = f"{thrust} and the guessed ratio of drag to thrust, {ratio:.3g} m,"
    for axis in AXES:
        place, needed = axis.place, of_yaw if axis == YAW else f"arms and {thrust}"
        if known[place] and alpha[place] > 0:
            std = float(np.sqrt(covariance[place, place])) / alpha[place] ** 2
            constants[axis.inertia] = Constant(1 / float(alpha[place]), float(std), UNIT, f"if {needed} are right")
    # Alphas that are fixed are no evidence for or against a rigid body.
    if not known.all():
        return RigidBody(constants)
    rigid = fit_inertia(CorrectedOS4(model.airframe), alpha, covariance)
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))
