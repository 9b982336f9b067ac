"""Checks before an estimate of a vehicle is believed: each doubt has a cause and a remedy."""

from collections.abc import Iterator

import numpy as np

from ..airframe import Airframe
from ..analysis.inertia import fit_inertia
from ..models.corrected import CorrectedOS4
from .results import Constant, Disturbance, Doubt, ParameterEstimate, PredictionSkill

# Doubts need this many standard deviations.
_SURE = 3.0
# All mass at the rotors would make the squared radius of gyration that of the rotors; a heavy centre, this share of it.
_HEAVIEST, _LIGHTEST = 1.5, 0.01
# A thrust gain beyond this factor, or its reciprocal, is no error of a scale or of a propeller's table.
_FAR_GAIN = 2.0
# An accelerometer that follows less than this share of the thrust does not measure it.
_DEAD = 0.2
# Aerodynamic moments may look like a gyroscopic coupling of this size (alpha1, alpha4, alpha7).
_COUPLING = 0.25
_CONSISTENT = 1e-3
# A time constant or delay this far below 0 is not chance and not rounding [s].
_EARLY = 0.002
# Innovations that correlate more than this bias filter error more than its intervals say. Longer samples [s] than the
# second figure would hide the motion with the vibration.
_VIBRATION, _LONGEST_SAMPLE = 0.4, 0.008
_HORIZON = 0.25  # [s]
# Value and standard deviation of each parameter that has an estimate.
Found = dict[str, tuple[float, float]]
_PLACES = {"p": "roll", "q": "pitch", "r": "yaw"}


def doubts_of(
    parameters: dict[str, ParameterEstimate],
    constants: dict[str, Constant],
    skill: PredictionSkill | None,
    airframe: Airframe,
) -> tuple[Doubt, ...]:
    """The reasons not to trust the estimate of a vehicle; empty if there are none.

    The bounds of the parameters count, and not their standard deviations, which are large where the model is wrong.
    """
    found: Found = {}
    stds: dict[str, float] = {}
    for name, row in parameters.items():
        if row.estimate is not None and row.std is not None:
            found[name], stds[name] = (row.estimate, row.std if row.bound is None else row.bound), row.std
    thrust = tuple(_thrust(found))
    return (
        *thrust,
        *(() if thrust else _impossible_inertias(constants, airframe)),
        *_contradictions(found, stds, airframe),
        *_no_answer(found),
        *_times(found),
        *_skill(skill),
    )


def _impossible_inertias(constants: dict[str, Constant], airframe: Airframe) -> Iterator[Doubt]:
    reach = np.square(np.asarray(airframe.rotor_positions)).sum(axis=1).max()
    limit = float(airframe.mass) * reach
    for name, row in constants.items():
        largest, least = _HEAVIEST * limit * (2 if name == "Iz" else 1), _LIGHTEST * limit
        beyond = row.estimate - _SURE * row.std > largest
        if beyond or row.estimate + _SURE * row.std < least:
            limit_passed = f"more than the {largest:.2g}" if beyond else f"less than the {least:.2g}"
            scale = "`drag_coefficient`" if name == "Iz" else "`thrust_coefficient`, `max_rotor_speed`"
            yield _implausible(
                f"{name} = {row.estimate:.3g} kg m^2 is {limit_passed} of a vehicle with this mass and arms",
                f"check `mass`, `rotor_positions` and {scale} in the airframe, and which rotor is which",
            )
    for axis, others in (("Ix", "IyIz"), ("Iy", "IxIz"), ("Iz", "IxIy")):
        names = (axis, others[:2], others[2:])
        if not all(name in constants for name in names):
            continue
        one, two, three = (constants[name] for name in names)
        excess = one.estimate - two.estimate - three.estimate
        if excess > _SURE * np.sqrt(one.std**2 + two.std**2 + three.std**2) + 0.05 * one.estimate:
            remedy = (
                "if `drag_coefficient` is a guess, measure it; else fly more yaw"
                if axis == "Iz"
                else "check `rotor_positions`"
            )
            yield _implausible(
                f"{axis} = {one.estimate:.3g} exceeds {names[1]} + {names[2]} = {two.estimate + three.estimate:.3g} "
                "kg m^2, which no rigid body allows",
                remedy,
            )


def answered_gusts(constants: dict[str, Constant], allowed: dict[str, Constant]) -> Iterator[Doubt]:
    """Moments of inertia that differ because the controller answered gusts, which shooting does not know.

    `allowed`: those of filter error, which allows for gusts.
    """
    pairs = {name: (constants[name], allowed[name]) for name in sorted(constants.keys() & allowed.keys())}
    apart = {
        name: f"{name} {other.estimate:.3g} instead of {one.estimate:.3g} kg m^2"
        for name, (one, other) in pairs.items()
        if abs(one.estimate - other.estimate) > _SURE * np.hypot(one.std, other.std)
    }
    if apart:
        yield _implausible(
            f"filter error, which allows for a controller that answers gusts, finds {', '.join(apart.values())}",
            "use `estimator` filter-error",
        )


def vibration(disturbances: dict[str, Disturbance], sample_time: float) -> Iterator[Doubt]:
    """A gyro whose noise is not white, usually by vibration: the controller answers it, and filter error is biased.

    `sample_time`: of the fitted data [s].
    """
    longer = f"average to longer samples by `sample_time` {2 * sample_time:g}, or " * (
        2 * sample_time <= _LONGEST_SAMPLE
    )
    for name, row in disturbances.items():
        if name in _PLACES and abs(row.correlation) > _VIBRATION:
            yield _implausible(
                f"the noise of {name} is not white (innovations correlate by {row.correlation:.2g}): the gyro vibrates",
                f"{longer}damp the vibration, or log faster",
            )


def _no_answer(found: Found) -> Iterator[Doubt]:
    """Roll and pitch must answer the rotors: otherwise nothing was identified."""
    for name, axis in (("alpha3", "roll"), ("alpha6", "pitch")):
        value, std = found.get(name, (0.0, np.inf))
        if -_SURE * std <= value <= _SURE * std:
            yield _implausible(
                f"{axis} does not clearly answer the rotors ({name} cannot be distinguished from 0)",
                f"fly more {axis}, or check `rotor_positions` in the airframe, and which rotor is which",
            )


def _contradictions(found: Found, stds: dict[str, float], airframe: Airframe) -> Iterator[Doubt]:
    negative = False
    for name, axis in (("alpha3", "roll"), ("alpha6", "pitch"), ("alpha8", "yaw")):
        value, std = found.get(name, (0.0, 0.0))
        if value + _SURE * std < 0:
            negative = True
            yield _implausible(
                f"{name} = {value:.3g} is negative: {axis} answers the rotors with the opposite sign",
                "check `rotor_positions` and `rotor_spins`, and the axes of the log",
            )
    if negative or not all(name in found for name in ("alpha1", "alpha3", "alpha4", "alpha6", "alpha7", "alpha8")):
        return
    model = CorrectedOS4(airframe)
    alpha, variance = np.array(model.alpha, dtype=float), np.full(8, np.inf)
    for i in range(8):
        if f"alpha{i + 1}" in found:
            alpha[i] = found[f"alpha{i + 1}"][0]
            variance[i] = stds[f"alpha{i + 1}"] ** 2
    variance[[0, 3, 6]] += _COUPLING**2
    variance[[1, 4]] = np.inf  # they need the inertia of the rotors too
    variance = np.where(np.isfinite(variance), variance, (1e3 * np.asarray(model.half_width)) ** 2)
    p_value = float(fit_inertia(model, alpha, np.diag(variance)).p_value)
    if p_value < _CONSISTENT:
        yield _implausible(
            f"alpha1, alpha4 and alpha7 contradict the inertias of alpha3, alpha6 and alpha8 (p = {p_value:.1g})",
            "check the axes and signs of the gyro, `rotor_positions` and `drag_coefficient`",
        )


def _times(found: Found) -> Iterator[Doubt]:
    for name, cause, remedy in (
        (
            "rotor_lag",
            "rotors cannot answer before their command",
            "if the log holds measured rotor speeds, name the columns omega1..4; else check the time stamps",
        ),
        (
            "rotor_delay",
            "commands cannot act before they are given",
            "commands or gyro are logged with wrong time stamps: correct them, or leave out the term `delay`",
        ),
    ):
        value, std = found.get(name, (0.0, 0.0))
        if value + _SURE * std < -_EARLY:
            yield _implausible(f"{name} = {1e3 * value:.2g} ms is negative: {cause}", remedy)


def _thrust(found: Found) -> Iterator[Doubt]:
    gain, std = found.get("thrust_gain", (1.0, 0.0))
    error = _SURE * std
    if gain + error < 0:
        yield _implausible(
            f"the accelerometer answers thrust with the opposite sign (thrust_gain = {gain:.2g})",
            "its z axis points down: change its sign",
        )
    elif gain + error < _DEAD:
        yield _implausible(
            f"the accelerometer does not follow the thrust (thrust_gain = {gain:.2g})",
            "check that it is switched on and in m/s^2, or leave out the term `accelerometer`",
        )
    elif gain - error > _FAR_GAIN or gain + error < 1 / _FAR_GAIN:
        yield _implausible(
            f"thrust is {gain:.2g} times that of the airframe (thrust_gain)",
            "correct `mass`, `thrust_coefficient` or `max_rotor_speed`",
        )


def _skill(skill: PredictionSkill | None) -> Iterator[Doubt]:
    if skill is None:
        return
    place = int(np.argmin(np.abs(np.array(skill.horizons) - _HORIZON)))
    values = {rate: getattr(skill, rate).skill[place] for rate in _PLACES}
    poor = [rate for rate, value in values.items() if value is not None and value <= 0]
    if poor:
        named = ", ".join(f"{rate} {values[rate]:.2g}" for rate in poor)
        axes = " and ".join(_PLACES[rate] for rate in poor)
        yield Doubt(
            "no_skill",
            f"the fit predicts {axes} {_HORIZON:g} s ahead no better than constant rates (skill {named})",
            f"fly more {axes}, or check the airframe and the time stamps",
        )


def _implausible(cause: str, remedy: str) -> Doubt:
    return Doubt("implausible", cause, remedy)
