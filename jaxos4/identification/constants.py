"""Moments of inertia from the estimated parameters."""

import numpy as np

from ..airframe import Airframe
from ..analysis.inertia import fit_inertia
from ..bracket import Bracket
from ..estimate import Estimate
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..models.corrected import CorrectedOS4
from .results import Constant, RigidBody

_UNIT = "kg m^2"
# The place of the alpha that is torque over this moment of inertia.
_INVERSE = {"Ix": 2, "Iy": 5, "Iz": 7}
# The standard deviation of an alpha that was not estimated, in half-widths of its bracket: as good as unknown.
_UNKNOWN = 1e3


def flight_constants(model: AbstractModel, estimate: Estimate) -> RigidBody:
    """Ix, Iy, Iz and J_R of the rigid body that explains the alphas of a flight best; none if not identifiable."""
    if model.parameter_names != PARAMETER_NAMES:
        return RigidBody()
    rigid = fit_inertia(model, estimate.parameters, estimate.covariance)
    values, std = np.asarray(rigid.constants), np.asarray(rigid.std)
    if not np.isfinite(std).all() or (std > np.abs(values))[:3].any():
        return RigidBody()
    table = zip(("Ix", "Iy", "Iz", "J_R"), values.tolist(), std.tolist(), strict=True)
    constants = {name: Constant(value, error, _UNIT) for name, value, error in table}
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))


def vehicle_constants(names: tuple[str, ...], estimate: Estimate, bracket: Bracket, airframe: Airframe) -> RigidBody:
    """Ix, Iy and Iz of a vehicle, from those of alpha3, alpha6 and alpha8 that were estimated.

    Torques exceed the airframe's by the same factor as thrust: an estimated `thrust_gain` divides the alphas.
    `names`: of the estimated parameters. `bracket`: of all parameters of the model, alpha_1..8 first.
    """
    values = np.asarray(estimate.parameters)
    gain = names.index("thrust_gain") if "thrust_gain" in names else None
    alpha, slopes = np.asarray(bracket.center)[:8].copy(), np.zeros((8, len(names)))
    variance = (_UNKNOWN * np.asarray(bracket.half_width)[:8]) ** 2
    for row, name in enumerate(PARAMETER_NAMES):
        if name not in names:
            continue
        column = names.index(name)
        alpha[row], slopes[row, column], variance[row] = values[column], 1.0, 0.0
        if gain is not None and row in _INVERSE.values():
            alpha[row] /= values[gain]
            slopes[row, column], slopes[row, gain] = 1 / values[gain], -alpha[row] / values[gain]
    covariance = slopes @ np.asarray(estimate.covariance) @ slopes.T + np.diag(variance)
    constants, thrust = {}, "thrust_coefficient" if gain is None else "mass"
    notes = dict.fromkeys(("Ix", "Iy"), f"if arms and {thrust} are right") | {"Iz": f"if {thrust} and drag are right"}
    for name, row in _INVERSE.items():
        if PARAMETER_NAMES[row] in names and alpha[row] > 0:
            std = float(np.sqrt(covariance[row, row])) / alpha[row] ** 2
            constants[name] = Constant(1 / float(alpha[row]), float(std), _UNIT, notes[name])
    # Alphas that are held are no evidence for or against a rigid body.
    if not set(PARAMETER_NAMES) <= set(names):
        return RigidBody(constants)
    rigid = fit_inertia(CorrectedOS4(airframe), alpha, covariance)
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))
