"""Parameters and moments of inertia with their intervals, and how well the model explains each channel."""

import equinox as eqx
import msgspec
import numpy as np

from .._custom_types import Parameters
from ..analysis.diagnostics import Diagnostics
from ..analysis.identifiability import identifiability
from ..analysis.inertia import fit_inertia
from ..bracket import GAUSSIAN_PRIOR, is_identifiable
from ..estimate import Estimate
from ..flight import STATE_NAMES, STATE_UNITS
from ..models.abstract import PARAMETER_NAMES
from ..models.os4 import CorrectedOS4
from ..models.state import CASCADE_ORDER
from ..shooting import ShootingProblem
from .fit import NEGATIVE_NOTE, Fit
from .prepare import Case
from .results import ChannelFit, Constant, ParameterEstimate, RigidBody, finite_or_none

UNIT = "kg m^2"
# The place of the alpha that is torque over this moment of inertia.
INVERSE = {"Ix": 2, "Iy": 5, "Iz": 7}
AXES = {"p": "roll", "q": "pitch", "r": "yaw"}
# The scale of an accelerometer, with what forward flight adds to the lift of rotors, is known to 1 %.
_SCALE = 0.01
# The standard deviation of an alpha that was not estimated, in half-widths of its bracket: as good as unknown.
_UNKNOWN = 1e3
# A factor of an interval from this one on is noted: it is printed with one decimal.
_NOTED = 1.05
# A channel with fewer measurements has no diagnostics.
_FEWEST_SAMPLES = 2


def parameter_table(case: Case, fit: Fit) -> dict[str, ParameterEstimate]:
    """Estimates by parameter name, without those that are fixed.

    The rule of `jaxos4.bracket.is_identifiable` decides which have an estimate. The others have a note instead.
    """
    estimate, unknowns = fit.estimate, fit.problem.unknowns
    std, width = map(np.asarray, _intervals(estimate))
    values, half_width, free = np.asarray(estimate.parameters), np.asarray(unknowns.half_width), fit.free
    lower, upper = np.asarray(unknowns.bracket.lower), np.asarray(unknowns.bracket.upper)
    prior = GAUSSIAN_PRIOR if case.is_vehicle else case.estimator.prior
    identifiable = np.asarray(is_identifiable(std[: unknowns.count], half_width, prior))
    reasons = dict.fromkeys(unknowns.names, "not identifiable from this flight")
    least = [0.0 if name in fit.negative else -np.inf for name in unknowns.names]
    limits = dict.fromkeys(unknowns.names, msgspec.UNSET if case.is_vehicle else None)
    if fit.evaluation is not None:
        information = identifiability(fit.evaluation, unknowns.bracket)
        notes, known = information.notes(unknowns.names), information.identifiable & information.excited
        reasons |= {name: notes[name] for i, name in enumerate(unknowns.names) if not known[i] and name in notes}
        limits = {name: finite_or_none(x) for name, x in zip(unknowns.names, information.noise_limit, strict=True)}
    return {
        (name := unknowns.names[i]): ParameterEstimate(
            estimate=float(values[i]) if identifiable[i] else None,
            std=finite_or_none(std[i]),
            bound=finite_or_none(fit.bound[i]),
            ci95=(max(float(values[i] - width[i]), least[i]), float(values[i] + width[i])) if identifiable[i] else None,
            unit=unknowns.units[i],
            note=_note(fit, i, float(width[i])) if identifiable[i] else reasons[name],
            noise_limit=limits[name],
            bracket=(float(lower[i]), float(upper[i])) if np.isfinite([lower[i], upper[i]]).all() else None,
        )
        for i in free
    }


@eqx.filter_jit  # one compiled program instead of one for each operation
def _intervals(estimate: Estimate) -> tuple[Parameters, Parameters]:
    return estimate.std, estimate.half_width(0.95)


def _note(fit: Fit, i: int, half_width: float) -> str:
    value, seed = float(np.asarray(fit.estimate.parameters)[i]), fit.estimate.seed
    bracket = fit.problem.unknowns.bracket
    if fit.problem.unknowns.names[i] in fit.negative:
        return NEGATIVE_NOTE
    notes = ["below noise"] if abs(value) < half_width else []
    if not np.asarray(bracket.lower)[i] <= value <= np.asarray(bracket.upper)[i]:
        notes.append("outside its bracket")
    if seed is not None and not np.asarray(seed.lower)[i] <= value <= np.asarray(seed.upper)[i]:
        notes.append("outside the network's interval")
    factor = fit.profiled.get(fit.problem.unknowns.names[i], 1.0)
    if factor >= _NOTED:
        notes.append(f"interval {factor:.1f} times as long, by the profile of the likelihood")
    return "; ".join(notes)


def overwhelmed(fit: Fit) -> dict[str, str]:
    """The axes on which disturbances are larger than the torque of the rotors, each with the figures in words.

    Yaw is one of them too if the flights say nothing of alpha8. Roll and pitch are then doubted for that reason.
    """
    omega, mixer = np.asarray(fit.problem.flight.omega, dtype=float), np.asarray(fit.problem.model.airframe.mixer)
    torques, names = (omega[:-1] ** 2 @ mixer[:3].T).std(axis=0), fit.problem.model.parameter_names
    alpha, weak = np.abs(np.asarray(fit.estimate.parameters)), {}
    strengths = {rate: row.strength for rate, row in fit.disturbances.items()}
    for (rate, axis), place, torque in zip(AXES.items(), INVERSE.values(), torques, strict=True):
        control = alpha[place] * torque
        if names[place] in fit.held:
            weak |= {axis: "the flights say less about alpha8 than its bracket"} if axis == "yaw" else {}
        elif strengths.get(rate, 0.0) > control:
            weak[axis] = (
                f"about {axis}, the disturbance ({strengths[rate]:.2g} rad/s^2) is larger than what the rotors do "
                f"({control:.2g} rad/s^2)"
            )
    return weak


def rigid_body(fit: Fit) -> RigidBody:
    """The moments of inertia of an OS4 that explain the estimate best; none if they are not identifiable."""
    model, estimate = fit.problem.model, fit.estimate
    rigid = fit_inertia(model, estimate.parameters, estimate.covariance)
    values, std = np.asarray(rigid.constants), np.asarray(rigid.std)
    if not np.isfinite(std).all() or (std > np.abs(values))[:3].any():
        return RigidBody()
    table = zip(("Ix", "Iy", "Iz", "J_R"), values.tolist(), std.tolist(), strict=True)
    constants = {name: Constant(value, error, UNIT) for name, value, error in table}
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))


def vehicle_constants(fit: Fit) -> RigidBody:
    """Ix, Iy and Iz of a vehicle, from those of alpha3, alpha6 and alpha8 that were estimated."""
    model, free, values = fit.problem.model, fit.free, np.asarray(fit.estimate.parameters)
    known, bracket = np.isin(PARAMETER_NAMES, [model.parameter_names[i] for i in free]), fit.problem.unknowns
    alpha, slopes = np.where(known, values[:8], np.asarray(bracket.center)[:8]), np.eye(8, values.size)
    gains = [i for i, parameter in enumerate(model.parameters) if parameter.scales_torque]
    for gain in gains:
        # Torques exceed those of the airframe by this factor, also if it is hardly known.
        for row in INVERSE.values():
            alpha[row] /= values[gain]
            slopes[row, row], slopes[row, gain] = 1 / values[gain], -alpha[row] / values[gain]
    slopes[~known] = 0.0
    unknown = np.where(known, 0.0, (_UNKNOWN * np.asarray(bracket.half_width)[:8]) ** 2)
    covariance = slopes @ np.asarray(fit.estimate.covariance) @ slopes.T + np.diag(unknown)
    # What no likelihood sees makes all moments of inertia wrong by one factor.
    scale = _SCALE * bool(gains)
    shared = scale * np.where(np.isin(np.arange(8), list(INVERSE.values())), alpha, 0.0)
    covariance += shared[:, None] * shared
    constants, thrust = {}, "mass" if gains else "thrust_coefficient"
    drag = f"the drag coefficient {float(model.airframe.drag_coefficient):.3g}"
    notes = dict.fromkeys(("Ix", "Iy"), f"if arms and {thrust} are right") | {"Iz": f"if {thrust} and {drag} are right"}
    for name, row in INVERSE.items():
        if known[row] and alpha[row] > 0:
            std = float(np.sqrt(covariance[row, row])) / alpha[row] ** 2
            constants[name] = Constant(1 / float(alpha[row]), float(std), UNIT, notes[name])
    # Alphas that are fixed are no evidence for or against a rigid body.
    if not known.all():
        return RigidBody(constants)
    rigid = fit_inertia(CorrectedOS4(model.airframe), alpha, covariance)
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))


def channel_fits(problem: ShootingProblem, diagnostics: Diagnostics) -> dict[str, ChannelFit]:
    """The diagnostics of each measured channel, by its name."""
    return {
        STATE_NAMES[column]: ChannelFit(
            rms=float(diagnostics.rms[i]),
            unit=STATE_UNITS[column],
            percent=finite_or_none(diagnostics.percent[i]),
            level=float(diagnostics.level[i]),
            level_p=float(diagnostics.level_p[i]),
            correlation=float(diagnostics.colour[i]),
            white_p=float(diagnostics.white_p[i]),
            input_correlation=dict(
                zip(("roll", "pitch", "yaw"), diagnostics.input_correlation[i].tolist(), strict=True)
            ),
            input_p=float(diagnostics.input_p[i]),
        )
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if diagnostics.count[i] > _FEWEST_SAMPLES
    }
