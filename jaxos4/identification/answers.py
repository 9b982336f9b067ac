"""`Answer`: an estimate with intervals; its parameters, moments of inertia, and the quantities that get a verdict."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
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
from ..models.terms import SAG, VOLTAGE_EXPONENT, follows_commands
from ..results import NINETY_FIVE, has_answer
from ..shooting import ShootingProblem
from .data import Data
from .results import (
    Constant,
    Disturbance,
    FixedParameter,
    OS4Identification,
    ParameterEstimate,
    PredictionSkill,
    RigidBody,
    VehicleIdentification,
)
from .search import Optimum
from .verdict import MAX_PRIOR, PREDICTIONS, RIGID_BODY, Quantity

UNIT = "kg m^2"
NEGATIVE_NOTE = "negative, which is impossible; set to 0"
PRIOR_NOTE = "not identifiable from these flights; the uncertainty is included in the other intervals"
MEASURE = "measure the yaw torque of a rotor, or swing the vehicle as a pendulum"
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


def parameter_table(answer: Answer, prior: float, missing: Mapping[str, str] = {}) -> dict[str, ParameterEstimate]:
    """Estimates by parameter name, without those that are fixed.

    Parameters that are not identifiable (`jaxos4.bracket.is_identifiable`) have a note instead of an estimate.

    **Arguments:** `prior`: how the estimator uses the bracket. `missing`: why a parameter is not identifiable, by name.
    """
    estimate, unknowns = answer.estimate, answer.problem.unknowns
    std, width = map(np.asarray, _intervals(estimate))
    values, half_width = answer.parameters, np.asarray(unknowns.half_width)
    lower, upper = np.asarray(unknowns.bracket.lower), np.asarray(unknowns.bracket.upper)
    identifiable = np.asarray(is_identifiable(std[: unknowns.count], half_width, prior))

    def row(i: int, name: str) -> ParameterEstimate:
        value, half, known = float(values[i]), float(width[i]), bool(identifiable[i])
        least = 0.0 if name in answer.negative else -np.inf
        return ParameterEstimate(
            estimate=value if known else None,
            std=finite_or_none(std[i]),
            bound=finite_or_none(answer.bound[i]),
            ci95=(max(value - half, least), value + half) if known else None,
            unit=unknowns.units[i],
            note=_note(answer, i, half) if known else missing.get(name, "not identifiable from this flight"),
            bracket=(float(lower[i]), float(upper[i])) if np.isfinite([lower[i], upper[i]]).all() else None,
        )

    return {unknowns.names[i]: row(i, unknowns.names[i]) for i in answer.free}


@eqx.filter_jit  # one compiled program instead of one for each operation
def _intervals(estimate: Estimate) -> tuple[Parameters, Parameters]:
    return estimate.std, estimate.half_width(0.95)


def _note(answer: Answer, i: int, half_width: float) -> str:
    value, seed = float(answer.parameters[i]), answer.estimate.seed
    bracket, name = answer.problem.unknowns.bracket, answer.problem.unknowns.names[i]
    if name in answer.negative:
        return NEGATIVE_NOTE
    notes = ["below noise"] if abs(value) < half_width else []
    if not np.asarray(bracket.lower)[i] <= value <= np.asarray(bracket.upper)[i]:
        notes.append("outside its bracket")
    if seed is not None and not np.asarray(seed.lower)[i] <= value <= np.asarray(seed.upper)[i]:
        notes.append("outside the network's interval")
    factor = answer.profiled.get(name, 1.0)
    if factor >= NOTED:
        notes.append(f"interval {factor:.1f} times as long, by the profile of the likelihood")
    return "; ".join(notes)


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
    model, values = answer.problem.model, answer.parameters
    if isinstance(model, FlightModel) and follows_commands(model.terms):
        return 0.0  # a full speed that is wrong makes thrust and drag wrong by the same factor
    gains = [values[i] for i, parameter in enumerate(model.parameters) if parameter.scales_torque]
    return float(np.prod(gains)) - 1


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
    gains = [i for i, parameter in enumerate(model.parameters) if parameter.scales_torque]
    for gain in gains:
        # Torques exceed the airframe's by this factor, even if the factor is hardly known.
        for place in INVERSES:
            alpha[place] /= values[gain]
            slopes[place, place], slopes[place, gain] = 1 / values[gain], -alpha[place] / values[gain]
    slopes[~known] = 0.0
    unknown = np.where(known, 0.0, (UNKNOWN * np.asarray(bracket.half_width)[:8]) ** 2)
    covariance = np.asarray(answer.estimate.covariance)[: values.size, : values.size]
    covariance = slopes @ covariance @ slopes.T + np.diag(unknown)
    # No likelihood shows an error of the accelerometer's scale, which makes all inertias wrong by one factor.
    scale = SCALE_ERROR * bool(gains)
    shared = scale * np.where(np.isin(np.arange(8), INVERSES), alpha, 0.0)
    covariance += shared[:, None] * shared
    covariance[YAW.place, YAW.place] += (drag_error(answer) * alpha[YAW.place]) ** 2
    constants, thrust = {}, "mass" if gains else "thrust_coefficient"
    ratio = float(model.airframe.drag_coefficient / model.airframe.thrust_coefficient)
    guessed = "guessed " if model.airframe.guesses_drag else ""
    of_yaw = f"{thrust} and the {guessed}ratio of drag to thrust, {ratio:.3g} m,"
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


def vehicle_quantities(answer: Answer, found: VehicleIdentification, still: Sequence[str]) -> dict[str, Quantity]:
    """Moments of inertia, the quantities of the terms, and predictions.

    `found`: the answer's parameters, moments of inertia and skill. `still`: axes without predictions.
    """
    model, own, quantities = answer.problem.model, answer.problem.unknowns, dict[str, Quantity]()
    table, constants = found.parameters, found.rigid_body.constants
    shares = dict(zip(own.names, np.square(answer.bound / np.asarray(own.half_width)).tolist(), strict=True))
    half_widths = dict(zip(own.names, np.asarray(own.half_width).tolist(), strict=True))
    for axis in AXES:
        row, alpha = constants.get(axis.inertia), axis.inverse
        if row is None:
            quantities[axis.inertia] = Quantity(
                missing=f"the flights say too little about {alpha}; fly more {axis.motion}"
            )
        else:
            condition = f", {row.note}" if row.note else ""
            value = f"{row.estimate:.4g} +- {row.half_width:.2g} {row.unit} (95 %){condition}"
            notes = _notes(answer, {alpha: table[alpha]}, shares)
            remedy = f"fly more {axis.motion}, or longer"
            if axis == YAW and drag_error(answer):
                remedy = MEASURE
            elif shares.get(SAG, 0.0) > MAX_PRIOR and VOLTAGE_EXPONENT not in own.names:
                remedy = f"log rotor speeds, or the battery's voltage at 10 Hz or more, or {remedy}"
            quantities[axis.inertia] = Quantity(value, row.half_width / row.estimate, reservations=notes, remedy=remedy)
    for quantity, names in model.quantities.items():
        unseen = [name for name in names if name in answer.fixed and answer.fixed[name].note == PRIOR_NOTE]
        which = f"the flights say less about {', '.join(unseen)} than the bracket; fly with more motion"
        rows = {name: table[name] for name in names if name in table}
        reservations = ((which,) if unseen else ()) + _notes(answer, rows, shares)
        wide = tuple(_too_wide(rows, half_widths))
        missing = which if not rows else "; ".join(wide) if len(wide) == len(rows) else ""
        axes = {axis.inertia for axis in AXES for name in names if name.startswith(axis.motion) and axis != YAW}
        quantities[quantity] = Quantity("", 0.0, missing, (*reservations, *wide), requires=tuple(sorted(axes)))
    return quantities | {PREDICTIONS: prediction_horizons(found.skill, still)}


def _too_wide(rows: dict[str, ParameterEstimate], half_widths: dict[str, float]) -> Iterator[str]:
    """The parameters whose 95 % intervals are wider than their brackets."""
    for name, row in rows.items():
        if row.std is not None and NINETY_FIVE * row.std > half_widths[name]:
            unit = "" if row.unit == "1" else f" {row.unit}"
            yield f"{name} is known to +-{NINETY_FIVE * row.std:.2g}{unit} only; fly with more motion"


def _notes(answer: Answer, rows: dict[str, ParameterEstimate], shares: dict[str, float]) -> tuple[str, ...]:
    """Notes on parameters that rest on a bracket, lie outside it, or are at their limit."""
    parameters, guessed = answer.problem.model.parameters, {axis.inverse: axis.inertia for axis in AXES}
    found, of_airframe = [], {each.name for each in parameters if each.scales_torque or callable(each.center)}
    for name, row in rows.items():
        if name in answer.negative:
            found.append(f"{name} is negative, which is impossible; it is 0 here")
        elif row.is_outside_bracket and name in guessed and row.estimate and isinstance(row.bracket, tuple):
            ratio = sum(row.bracket) / 2 / row.estimate
            check = (
                "measure `drag_coefficient`" if guessed[name] == YAW.inertia else "check `mass` and `rotor_positions`"
            )
            found.append(f"{guessed[name]} is {ratio:.2g} times the guess; {check}, or give a wider `bracket`")
        elif row.is_outside_bracket:
            # Only an airframe that has such a constant can be wrong about it.
            check = "check the airframe, or " if name in (*PARAMETER_NAMES, *of_airframe) else ""
            found.append(f"{name} is outside its bracket; {check}give a wider `bracket`")
    resting = (name for name in rows if shares[name] > MAX_PRIOR)
    return *found, *(
        f"{100 * shares[name]:.0f} % of the information about {name} comes from its bracket" for name in resting
    )


def prediction_horizons(skill: PredictionSkill | None, still: Sequence[str]) -> Quantity:
    """The horizon up to which predictions beat constant rates by a standard error, about each axis that moves."""
    if skill is None:
        return Quantity(missing="nothing was held out; give `holdout` or `validate`")
    ahead, poor = [], []
    for axis in (each for each in AXES if each.motion not in still):
        own, longest = getattr(skill, axis.rate), 0.0
        for horizon, value, std in zip(skill.horizons, own.skill, own.std, strict=True):
            if value is not None and value <= (std or 0.0):
                break
            longest = horizon if value is not None else longest
        if longest:
            ahead.append(f"{axis.motion} {longest:.2g} s")
        else:
            poor.append(axis.motion)
    unseen = (f"{' and '.join(still)} cannot be checked; fly more {' and '.join(still)}",) if still else ()
    if poor and not ahead:
        motions = " and ".join(poor)
        return Quantity(missing=f"{motions} cannot be predicted better than by constant rates; fly more {motions}")
    reach = f"better than constant rates up to {', '.join(ahead)} ahead" if ahead else ""
    worse = f"; no better for {' and '.join(poor)}" if poor else ""
    return Quantity(reach + worse, reservations=unseen)


def os4_quantities(found: OS4Identification) -> dict[str, Quantity]:
    """The alphas of an OS4, and its rigid body."""
    quantities = {}
    for name, row in found.parameters.items():
        notes = tuple(filter(None, row.note.split("; ")))
        quantities[name] = Quantity(missing=row.note) if row.estimate is None else Quantity(reservations=notes)
    unknown = "" if found.rigid_body.constants else "the alphas are not known well enough"
    return quantities | {RIGID_BODY: Quantity(missing=unknown)}
