"""Issues of values that physics or the airframe forbids, and of an Iz without a measured drag coefficient."""

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from ..airframe import AXES, INERTIAS, PITCH, ROLL, YAW, Airframe
from ..analysis.inertia import fit_inertia
from ..models.abstract import PARAMETER_NAMES, AbstractModel, Parameter
from ..models.os4 import CorrectedOS4
from ..models.terms import DAMPED
from ..recording.checks.evidence import HELD
from .answers import Answer, drag_error, thrust_excess
from .results import Constant, ParameterEstimate, RigidBody
from .verdict import (
    CONTRADICTION,
    IMPROBABLE,
    MAX_PRIOR,
    RESERVATION,
    RIGID_BODY,
    SIGNIFICANT,
    UNUSUAL,
    Issue,
    Move,
    Moves,
)

Estimated = Mapping[str, tuple[float, float]]
"""Value and standard deviation of each parameter that has an estimate."""
Consequences = Callable[[str, float], Mapping[str, Move | None]]
"""The changes of quantities if a parameter has another value; see `consequences`."""

# Limits of the squared radius of gyration, relative to all mass at the rotors. The lower one allows a heavy centre.
HEAVIEST, LIGHTEST = 1.5, 0.01
COUPLING = 0.25  # of alpha1, alpha4 and alpha7: aerodynamic moments may mimic a gyroscopic coupling of this size
MAX_DELAY = 0.04  # s; a longer delay of rotors is a clock error
ALL_INERTIAS: Moves = dict.fromkeys(INERTIAS)
_FLAT = 0.6  # Iz / (Ix + Iy) is rarely smaller if the rotors lie in a plane; for a lamina it is 1
MEASURE = "measure the yaw torque of a rotor, or swing the vehicle as a pendulum"


def issues_of_alphas(table: Mapping[str, ParameterEstimate], body: RigidBody) -> Iterator[Issue]:
    """Alphas of an OS4 that no rigid body can have.

    They contradict the rigid body. An alpha itself is contradicted only if it is outside its bracket, which bounds its
    possible values.
    """
    gyro, moves = "check the scale, the axes and the signs of the gyro, and the time stamps", {RIGID_BODY: None}
    for name in (axis.coupling for axis in AXES):
        row = table[name]
        if row.estimate is not None and row.std is not None and abs(row.estimate) - SIGNIFICANT * row.std > 1:
            cause = f"{name} = {row.estimate:.3g} is not between -1 and 1, as in every rigid body"
            yield Issue(CONTRADICTION, cause, gyro, moves | dict.fromkeys([name] * row.is_outside_bracket()))
    rotor, largest = body.constants.get("J_R"), body.constants.get(YAW.inertia)
    if rotor is not None and largest is not None:
        remedy, margin = "check `rotor_spins`, and which rotor is which", SIGNIFICANT * rotor.std
        if rotor.estimate + margin < 0:
            yield Issue(CONTRADICTION, f"J_R = {rotor.estimate:.3g} kg m^2 is negative", remedy, moves)
        elif rotor.estimate - margin > largest.estimate:
            cause = f"J_R = {rotor.estimate:.3g} kg m^2 is larger than the {YAW.inertia} of the vehicle"
            yield Issue(CONTRADICTION, cause, remedy, moves)
    if body.consistency_p is not None and body.consistency_p < IMPROBABLE:
        cause = f"the alphas are not those of one rigid body (p = {body.consistency_p:.1g})"
        yield Issue(CONTRADICTION, cause, f"use the alphas alone; if the body is rigid, {gyro}", moves)
    elif body.is_rigid_body is False:
        cause = "one moment of inertia exceeds the sum of the other two, which no rigid body allows"
        yield Issue(CONTRADICTION, cause, "check `rotor_positions` and `drag_coefficient`", moves)


def issues_of_values(
    model: AbstractModel,
    parameters: Mapping[str, ParameterEstimate],
    constants: Mapping[str, Constant],
    fixed: Mapping[str, tuple[float, float]] = {},
    log_step: float = 0.0,
    follow: Consequences = lambda name, value: {},
    *,
    motor_step: float = 0.0,
) -> Iterator[Issue]:
    """The issues about the parameters and moments of inertia of a vehicle.

    `fixed`: parameters that are not estimated. `log_step`: the longest sample of the logs [s]; `motor_step`: the
    longest time between new motor values [s]. `follow`: how far quantities move if a parameter has another value.

    Parameters are judged by their Cramer-Rao bounds, because standard deviations are large if the model is wrong.
    """
    estimated, stds = {}, {}
    for name, row in parameters.items():
        if row.estimate is not None and row.std is not None:
            estimated[name], stds[name] = (row.estimate, row.std if row.bound is None else row.bound), row.std
    yield from (issue for _, issue in contradicted(model, fixed, motor_step=motor_step))
    wrong = dict(contradicted(model, estimated, follow, motor_step=motor_step))
    yield from wrong.values()
    if not any(parameter.scales_torque for parameter in wrong):
        yield from _impossible_inertias(constants, model.airframe)
    yield from _turns(estimated, stds, model.airframe)
    yield from _unseen(estimated, log_step, follow)
    yield from _odd_motors(model, parameters, wrong, follow)


def _odd_motors(
    model: AbstractModel,
    parameters: Mapping[str, ParameterEstimate],
    wrong: Mapping[Parameter, Issue],
    follow: Consequences,
) -> Iterator[Issue]:
    """Motor parameters far outside their brackets: an unusual value may be a fault of the model."""
    for parameter in (each for each in model.parameters if each.in_forcing and each not in wrong):
        row = parameters.get(parameter.name)
        usual = None if row is None or not row.is_outside_bracket(UNUSUAL) else row.wider_bracket(UNUSUAL)
        if row is not None and row.estimate is not None and usual is not None:
            least, most = max(usual[0], 0.0) if parameter.nonnegative else usual[0], usual[1]
            yield Issue(
                RESERVATION,
                f"{parameter.name} = {row.estimate:.2g} is unusual (expected: {least:.3g} to {most:.3g})",
                "log rotor speeds",
                follow(parameter.name, float(np.clip(row.estimate, least, most))),
            )


def contradicted(
    model: AbstractModel,
    estimated: Estimated,
    follow: Consequences = lambda name, value: {},
    *,
    motor_step: float = 0.0,
) -> Iterator[tuple[Parameter, Issue]]:
    """The parameters whose values physics or the airframe forbid. `motor_step`: see `issues_of_values`.

    Its moves are how far each other quantity would shift if the parameter had its expected value.
    """
    owner = {name: quantity for quantity, names in model.quantities.items() for name in names}
    for parameter, usual in zip(model.parameters, np.asarray(model.alpha).tolist(), strict=True):
        if parameter.contradiction is None or parameter.name not in estimated:
            continue
        value, std = estimated[parameter.name]
        why = parameter.contradiction(value, SIGNIFICANT * std)
        if why is not None:
            own: Moves = dict.fromkeys([owner[parameter.name]] if parameter.name in owner else [])
            others = dict.fromkeys((*INERTIAS, "thrust")) if parameter.scales_torque else follow(parameter.name, usual)
            rare = ": motors were logged too rarely" * (why[0] == DAMPED and motor_step > HELD)
            cause = f"{parameter.name} = {value:.2g} {why[0]}{rare}"
            yield parameter, Issue(CONTRADICTION, cause, why[1], {**others, **own})


def _impossible_inertias(constants: Mapping[str, Constant], airframe: Airframe) -> Iterator[Issue]:
    radius_squared = np.square(np.asarray(airframe.rotor_positions)).sum(axis=1).max()
    limit = float(airframe.mass) * radius_squared
    for name, row in constants.items():
        largest, least = HEAVIEST * limit * (2 if name == YAW.inertia else 1), LIGHTEST * limit
        beyond = row.estimate - SIGNIFICANT * row.std > largest
        if beyond or row.estimate + SIGNIFICANT * row.std < least:
            compared = f"more than the {largest:.2g}" if beyond else f"less than the {least:.2g}"
            scale = "`drag_coefficient`" if name == YAW.inertia else "`thrust_coefficient`, `max_rotor_speed`"
            yield Issue(
                CONTRADICTION,
                f"{name} = {row.estimate:.3g} kg m^2 is {compared} of a vehicle with this mass and arms",
                f"check `mass`, `rotor_positions` and {scale} in the airframe, and which rotor is which",
                {name: None},
            )
    for name, one in constants.items() if len(constants) == len(INERTIAS) else ():
        (second, two), (third, three) = (each for each in constants.items() if each[0] != name)
        excess = one.estimate - two.estimate - three.estimate
        if excess > SIGNIFICANT * np.sqrt(one.std**2 + two.std**2 + three.std**2) + 0.05 * one.estimate:
            remedy = (
                "if `drag_coefficient` is a guess, measure it; else fly more yaw"
                if name == YAW.inertia
                else "check `rotor_positions`"
            )
            yield Issue(
                CONTRADICTION,
                f"{name} = {one.estimate:.3g} exceeds {second} + {third} = {two.estimate + three.estimate:.3g} "
                "kg m^2, which no rigid body allows",
                remedy,
                {name: None} if name == YAW.inertia else ALL_INERTIAS,
            )


def _turns(estimated: Estimated, stds: Mapping[str, float], airframe: Airframe) -> Iterator[Issue]:
    """Axes that do not answer the rotors, or with the opposite sign: nothing was identified about them.

    If all signs are right, the gyroscopic couplings must fit a rigid body with these inertias.
    """
    opposite = False
    for axis in AXES:
        name, moves = axis.inverse, {axis.inertia: None}
        value, std = estimated.get(name, (0.0, 0.0))
        if value + SIGNIFICANT * std < 0:
            opposite = True
            yield Issue(
                CONTRADICTION,
                f"{name} = {value:.3g} is negative: {axis.motion} answers the rotors with the opposite sign",
                "check `rotor_positions` and `rotor_spins`, and the axes of the log",
                moves,
            )
        elif value <= SIGNIFICANT * std and axis != YAW:
            yield Issue(
                "unidentifiable",
                f"{axis.motion} does not clearly answer the rotors ({name} cannot be distinguished from 0)",
                f"fly more {axis.motion}, or check `rotor_positions` in the airframe, and which rotor is which",
                moves,
            )
    couplings, inverses = [axis.coupling for axis in AXES], [axis.inverse for axis in AXES]
    if opposite or not estimated.keys() >= {*couplings, *inverses}:
        return
    model = CorrectedOS4(airframe)
    alpha, variance = np.array(model.alpha, dtype=float), np.full(8, np.inf)
    for i, name in enumerate(PARAMETER_NAMES):
        if name in estimated:
            alpha[i] = estimated[name][0]
        if name in couplings:
            variance[i] = stds[name] ** 2 + COUPLING**2
        elif name in inverses:  # the others need the inertia of the rotors too
            variance[i] = np.inf if name == YAW.inverse and airframe.guesses_drag else stds[name] ** 2
    p_value, without_yaw = (_p_value(model, alpha, variance, unknown) for unknown in ([], [YAW.place]))
    if p_value < IMPROBABLE:
        yield Issue(
            CONTRADICTION,
            f"alpha1, alpha4 and alpha7 contradict the inertias of alpha3, alpha6 and alpha8 (p = {p_value:.1g})",
            "check the axes and signs of the gyro, `rotor_positions` and `drag_coefficient`",
            ALL_INERTIAS if without_yaw < IMPROBABLE else {YAW.inertia: None},
        )


def _p_value(model: CorrectedOS4, alpha: np.ndarray, variance: np.ndarray, unknown: list[int]) -> float:
    """The probability that alphas of a rigid body disagree this much or more. `unknown`: indices to ignore."""
    variance = variance.copy()
    variance[unknown] = np.inf
    variance = np.where(np.isfinite(variance), variance, (1e3 * np.asarray(model.half_width)) ** 2)
    return float(fit_inertia(model, alpha, np.diag(variance)).p_value)


def _unseen(estimated: Estimated, log_step: float, follow: Consequences) -> Iterator[Issue]:
    """A lag that the log is too slow to show, or a delay longer than any rotor's. `log_step`: longest sample [s]."""
    lag, error = estimated.get("rotor_lag", (np.inf, 0.0))
    if -SIGNIFICANT * error <= lag < log_step - SIGNIFICANT * error:
        yield Issue(
            CONTRADICTION,
            f"rotor_lag = {lag:.2g} s is shorter than a sample of the log, {log_step:.2g} s",
            "log faster, or leave out the term `motor` or `lag`",
            {**follow("rotor_lag", log_step), "motors": None},
        )
    delay, error = estimated.get("rotor_delay", (0.0, 0.0))
    if abs(delay) - SIGNIFICANT * error > MAX_DELAY:
        how = "late" if delay < 0 else "early"
        yield Issue(
            CONTRADICTION,
            f"rotor_delay = {delay:.2g} s: motors are recorded {1e3 * abs(delay):.0f} ms {how}, more than any rotor",
            "check the time stamps of motors and gyro",
            {**follow("rotor_delay", float(np.copysign(MAX_DELAY, delay))), "motors": None},
        )


def issues_of_iz(
    answer: Answer, table: Mapping[str, ParameterEstimate], constants: Mapping[str, Constant]
) -> Iterator[Issue]:
    """The issues about Iz. `table`: of the parameters. `constants`: the moments of inertia that are judged."""
    if YAW.inertia in constants:
        yield from _drag(answer)
        # All of these signs would have one cause, a wrong drag coefficient, so only the largest counts.
        signs = [*_flat(constants), *_rotor_inertia(table, constants[YAW.inertia])]
        yield from sorted(signs, key=lambda issue: issue.share_of(YAW.inertia))[-1:]


def _drag(answer: Answer) -> Iterator[Issue]:
    """An unmeasured ratio of drag to thrust, to which Iz is proportional."""
    excess, moves = thrust_excess(answer), {YAW.inertia: None}
    if answer.problem.model.airframe.guesses_drag:
        yield Issue("unidentifiable", "`drag_coefficient` is a guess, to which Iz is proportional", MEASURE, moves)
    elif drag_error(answer):
        cause = (
            f"the rotors give {100 * abs(excess):.0f} % {'more' if excess > 0 else 'less'} thrust than the airframe "
            "says, so that the ratio of drag to thrust, to which Iz is proportional, may be off by as much"
        )
        yield Issue("unidentifiable", cause, MEASURE, moves)


def _flat(constants: Mapping[str, Constant]) -> Iterator[Issue]:
    """An Iz that is too small for a flat vehicle, compared with Ix + Iy."""
    if not {ROLL.inertia, PITCH.inertia} <= constants.keys():
        return
    x, y, z = (constants[axis.inertia] for axis in (ROLL, PITCH, YAW))
    least, error = _FLAT * (x.estimate + y.estimate), math.hypot(z.std, _FLAT * x.std, _FLAT * y.std)
    if least - z.estimate > SIGNIFICANT * error:
        share = z.estimate / (x.estimate + y.estimate)
        yield Issue(
            RESERVATION,
            f"Iz is only {share:.2g} times Ix + Iy; of a flat vehicle it is {_FLAT:g} to 1 times",
            f"if `drag_coefficient` is uncertain, {MEASURE}",
            {YAW.inertia: Move(least / z.estimate - 1, (least - z.estimate) / z.std)},
        )


def _rotor_inertia(table: Mapping[str, ParameterEstimate], iz: Constant) -> Iterator[Issue]:
    """A difference between the rotors' inertia from their gyroscopic torques and from their reaction in yaw.

    The first is alpha2 / alpha3, with alpha2 = J_R / Ix and alpha3 = 1 / Ix. The second is the reaction, J_R / Iz,
    over alpha8. They agree if Iz is right.
    """
    by_yaw = _quotient(table, "rotor_reaction", YAW.inverse)
    for gyroscopic, axis in (("alpha2", ROLL), ("alpha5", PITCH)):
        by_axis = _quotient(table, gyroscopic, axis.inverse)
        if by_yaw is None or by_axis is None:
            continue
        off = by_axis[0] - by_yaw[0]
        if abs(off) > SIGNIFICANT * math.hypot(by_axis[1], by_yaw[1]):
            yield Issue(
                RESERVATION,
                f"the inertia of the rotors from {axis.motion} is {by_axis[0] / by_yaw[0]:.2g} times the one from "
                "their reaction in yaw",
                f"fly more yaw; if `drag_coefficient` is uncertain, {MEASURE}",
                {YAW.inertia: Move(abs(off) / by_yaw[0], abs(off) / by_yaw[0] * iz.estimate / iz.std)},
            )


def _quotient(table: Mapping[str, ParameterEstimate], name: str, inverse: str) -> tuple[float, float] | None:
    """The ratio of two parameters and its error, if both are positive and hardly rest on their brackets."""
    rows = [table.get(name), table.get(inverse)]
    values, squares = [], 0.0
    for row in rows:
        if row is None or not row.estimate or row.estimate <= 0 or not row.std or not isinstance(row.bracket, tuple):
            return None
        if (row.std / (row.bracket[1] - row.bracket[0]) * 2) ** 2 > MAX_PRIOR:
            return None
        values.append(row.estimate)
        squares += (row.std / row.estimate) ** 2
    ratio = values[0] / values[1]
    return ratio, ratio * math.sqrt(squares)
