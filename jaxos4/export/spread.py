"""How far drawn vehicles differ: the joint Gaussian of physical constants, as wide as the verdicts say.

The covariance of an estimate does not know the reservations of its verdicts, nor constants that are guesses. Each adds
to the width of the quantity that it concerns, independently of the others.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..airframe import AXES, INERTIAS, YAW, Airframe
from ..identification.answers import GUESSED_DRAG, SCALE_ERROR, UNIT, ratio_error
from ..identification.results import VehicleIdentification
from ..identification.verdict import CONTRADICTED, IDENTIFIED, MAX_SHARE, RESERVED
from ..linalg import covariance_root
from ..models.flight_model import without_recording
from ..models.terms import TERMS
from .vehicle import CARRIED, RigidVehicle

DRAG, ROTOR_INERTIA, GAIN, REACTION = "drag_coefficient", "rotor_inertia", "thrust_gain", "rotor_reaction"
_GUESS = GUESSED_DRAG  # of a moment of inertia too
_RESERVED, _REFUSED = "widened by the reservations of its verdict", "as wide as a guess: its verdict refuses it"
ESTIMATE, _MISSING = "the estimate", "a guess: it was not identified"


@np.errstate(all="ignore")  # what is not finite gives no possible vehicle
def spread_of(
    file: VehicleIdentification, values: Mapping[str, float], estimated: Sequence[str], vehicle: RigidVehicle
) -> tuple[dict[str, dict[str, Any]], Float[np.ndarray, "n n"]]:
    """The Gaussian of a result, before draws that no vehicle can have are repeated.

    **Arguments:** `values` of all parameters, the names of those that were `estimated`, and the `vehicle` with these
    values.

    **Returns:** mean, standard deviation, unit and origin of Ix, Iy, Iz, parameters, and uncertain constants of the
    airframe; and a matrix B, with the covariance B B^T.
    """
    inverses = [axis.inverse for axis in AXES]
    known = [name for name in estimated if without_recording(name) in CARRIED]
    fixed = [name for name in file.held if without_recording(name) in CARRIED and name in values and name not in known]
    others = [name for name in (*known, *fixed) if name not in inverses]
    mean = dict(zip(INERTIAS, vehicle.inertia.tolist(), strict=True)) | {name: values[name] for name in others}
    constants, excess = _guessed_constants(file.airframe, values)
    names = [*mean, *constants]
    mean |= {name: float(getattr(file.airframe, name)) for name in constants}
    slopes = _slopes(names, known, mean, values)
    places = [list(file.parameters).index(name) for name in known]
    covariance, widened = slopes @ np.array(file.covariance)[np.ix_(places, places)] @ slopes.T, {}
    if GAIN in known:  # the scale of the accelerometer is one factor of thrust and moments of inertia
        scale = SCALE_ERROR * values[GAIN] * slopes[:, known.index(GAIN)]
        covariance += np.outer(scale, scale)
    for place, (name, (quantity, size, guess)) in enumerate(_sizes(file, mean, others).items()):
        spared = name == YAW.inertia and DRAG in constants
        share, refused = _reservations(file, quantity, spared=spared)
        missing = inverses[place] not in known if name in INERTIAS else name in fixed
        variance = covariance[place, place] + (share * size) ** 2
        if missing or share:
            widened[name] = _MISSING if missing else _RESERVED
        if (refused or missing) and variance < guess**2:
            variance = guess**2
            widened[name] = _MISSING if missing else _REFUSED
        covariance[place, place] = variance
    for name, share in constants.items():
        both = [name, YAW.inertia] if name == DRAG and YAW.inverse in known else [name]
        moved = np.array([share * mean[each] if each in both else 0.0 for each in names])
        covariance += np.outer(moved, moved)
        widened[name] = "a guess" if name in file.airframe.guessed else f"the thrust is off by {100 * excess:.0f} %"
        if len(both) > 1:  # flights show the yaw torque over Iz: another drag coefficient means another Iz
            before = f"{widened[YAW.inertia]}; " if YAW.inertia in widened else ""
            widened[YAW.inertia] = f"{before}proportional to {DRAG}"
    units = {name: row.unit for name, row in (*file.held.items(), *file.parameters.items())}
    units |= dict.fromkeys((*INERTIAS, ROTOR_INERTIA), UNIT) | {DRAG: "N m s^2/rad^2"}
    root = covariance_root(covariance) if np.isfinite(covariance).all() else np.full_like(covariance, np.nan)
    stds = np.sqrt(np.square(root).sum(axis=1)).tolist()
    rows = {
        name: {"mean": mean[name], "std": std, "unit": units[name], "origin": widened.get(name, ESTIMATE)}
        for name, std in zip(names, stds, strict=True)
    }
    return rows, root


def _guessed_constants(airframe: Airframe, values: Mapping[str, float]) -> tuple[dict[str, float], float]:
    """Standard deviations of constants of the airframe that are guesses, as shares, and how far its thrust is off."""
    # With commands, a full speed that is wrong makes thrust and drag wrong by the same factor.
    excess = 0.0 if "rotor_lag" in values else abs(values.get(GAIN, 1.0) - 1)
    shares = {DRAG: ratio_error(airframe, excess)}
    if REACTION not in values:
        shares[ROTOR_INERTIA] = _GUESS * (ROTOR_INERTIA in airframe.guessed)
    return {name: share for name, share in shares.items() if share}, excess


def _slopes(
    names: Sequence[str], known: Sequence[str], mean: Mapping[str, float], values: Mapping[str, float]
) -> Float[np.ndarray, "names known"]:
    """The derivatives of the constants that vary with respect to the parameters that were estimated."""
    slopes = np.array([[float(name == parameter) for parameter in known] for name in names])
    for place, axis in enumerate(AXES):
        if axis.inverse in known:  # the inertia is thrust_gain / alpha
            slopes[place, known.index(axis.inverse)] = -mean[axis.inertia] / values[axis.inverse]
            if GAIN in known:
                slopes[place, known.index(GAIN)] = mean[axis.inertia] / values[GAIN]
    return slopes.reshape(len(names), len(known))


def _sizes(
    file: VehicleIdentification, mean: Mapping[str, float], parameters: Sequence[str]
) -> dict[str, tuple[str, float, float]]:
    """The name of its verdict, the size that its moves are shares of, and the width of a guess, by name.

    The names are those of moments of inertia and parameters.
    """
    terms = {x.name: (term.quantity, x.half_width) for term in TERMS.values() for x in term.parameters}
    sizes = {name: (name, mean[name], _GUESS * mean[name]) for name in INERTIAS}
    for name in parameters:
        quantity, half_width = terms.get(without_recording(name), ("", 0.0))
        half_width = float(half_width(file.airframe) if callable(half_width) else half_width)
        bracket = file.parameters[name].bracket if name in file.parameters else None
        if isinstance(bracket, tuple):
            half_width = (bracket[1] - bracket[0]) / 2
        sizes[name] = quantity, half_width, half_width
    return sizes


def _reservations(file: VehicleIdentification, quantity: str, *, spared: bool = False) -> tuple[float, bool]:
    """How far the reservations may move a quantity, as a share, and whether its verdict refuses it.

    `spared`: whether one issue that refuses it does not count.
    """
    left = [(issue.status_allowed(quantity), issue.moves.get(quantity)) for issue in file.issues]
    # A reservation that does not say how far it moves the quantity is taken to move it as far as a reservation may.
    moves = [MAX_SHARE if move is None else move.share for status, move in left if status == RESERVED]
    refusing = sum(status not in (IDENTIFIED, RESERVED) for status, _ in left)
    verdict = file.verdicts.get(quantity)
    # Without an issue: it was not estimated well, or reservations contradict it together.
    by_verdict = verdict is not None and (verdict.status == CONTRADICTED or not (spared or verdict.trusted))
    return math.hypot(*moves), by_verdict or refusing > spared
