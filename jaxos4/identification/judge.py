"""Checks before an estimate of a vehicle is believed: each doubt has a cause and a remedy."""

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np

from .._custom_types import as_float
from ..airframe import Airframe
from ..analysis.frequency_response import frequency_response
from ..analysis.inertia import fit_inertia
from ..analysis.prediction import Predictions, decisive_horizon
from ..models.abstract import AbstractModel, Parameter
from ..models.os4 import CorrectedOS4
from ..recording.motion import OVER_NOISE, WEAK
from ..shooting import with_room
from .answers import AXES, INVERSE, overwhelmed, parameter_table, rigid_body, vehicle_constants
from .fit import Fit
from .held_out import predict_held_out, validate_on
from .prepare import Case, Progress
from .results import Constant, Disturbance, Doubt, ParameterEstimate, PredictionSkill, RigidBody, SampleTime
from .sample_time import moved

# Doubts need this many standard deviations.
_SURE = 3.0
# All mass at the rotors would make the squared radius of gyration that of the rotors; a heavy centre, this share of it.
_HEAVIEST, _LIGHTEST = 1.5, 0.01
# Aerodynamic moments may look like a gyroscopic coupling of this size (alpha1, alpha4, alpha7).
_COUPLING = 0.25
_CONSISTENT = 1e-3
# Innovations that correlate more than this bias filter error more than its intervals say. Longer samples [s] than the
# second figure would hide the motion with the vibration.
_VIBRATION, _LONGEST_SAMPLE = 0.4, 0.008
# Value and standard deviation of each parameter that has an estimate.
Found = dict[str, tuple[float, float]]
_OF_YAW = ("alpha7", "alpha8")
_LONGEST_DELAY = 0.04  # [s], of rotors; more is an error of clocks


_NOT_LOWEST = Doubt(
    "max_sweeps",
    "the likelihood has several maxima, and the search did not find the highest",
    "fly more roll, pitch and yaw, or choose another part with `begin` and `end`",
)


def doubts_of(
    model: AbstractModel,
    parameters: dict[str, ParameterEstimate],
    constants: dict[str, Constant],
    skill: PredictionSkill | None,
    still: Sequence[str] = (),
    log_step: float = 0.0,
) -> tuple[Doubt, ...]:
    """The reasons not to trust the estimate of a vehicle; empty if there are none.

    `still`: the axes about which the held-out part hardly turns. `log_step`: the longest sample of the logs [s].

    The bounds of the parameters count, and not their standard deviations, which are large where the model is wrong.
    """
    rows = {
        name: (row.estimate, row.std, row.bound)
        for name, row in parameters.items()
        if row.estimate is not None and row.std is not None
    }
    found = {name: (value, std if bound is None else bound) for name, (value, std, bound) in rows.items()}
    stds = {name: std for name, (_, std, _) in rows.items()}
    contradicted = dict(_contradicted(model, found))
    is_thrust_wrong = any(parameter.scales_torque for parameter in contradicted)
    return (
        *contradicted.values(),
        *(() if is_thrust_wrong else _impossible_inertias(constants, model.airframe)),
        *_turns(found, stds, model.airframe),
        *_unseen(found, log_step),
        *_skill(skill, still),
    )


def _contradicted(model: AbstractModel, found: Found) -> Iterator[tuple[Parameter, Doubt]]:
    """The parameters whose values physics or the airframe forbid."""
    for parameter in model.parameters:
        if parameter.contradiction is None or parameter.name not in found:
            continue
        value, std = found[parameter.name]
        verdict = parameter.contradiction(value, _SURE * std)
        if verdict is not None:
            yield parameter, _implausible(f"{parameter.name} = {value:.2g} {verdict[0]}", verdict[1])


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
    for axis, one in constants.items() if len(constants) == len(INVERSE) else ():
        (second, two), (third, three) = (each for each in constants.items() if each[0] != axis)
        excess = one.estimate - two.estimate - three.estimate
        if excess > _SURE * np.sqrt(one.std**2 + two.std**2 + three.std**2) + 0.05 * one.estimate:
            remedy = (
                "if `drag_coefficient` is a guess, measure it; else fly more yaw"
                if axis == "Iz"
                else "check `rotor_positions`"
            )
            yield _implausible(
                f"{axis} = {one.estimate:.3g} exceeds {second} + {third} = {two.estimate + three.estimate:.3g} "
                "kg m^2, which no rigid body allows",
                remedy,
            )


def vibration(disturbances: dict[str, Disturbance], sample_time: float) -> Iterator[Doubt]:
    """A gyro whose noise is not white, usually by vibration: the controller answers it, and filter error is biased.

    `sample_time`: of the fitted data [s].
    """
    longer = f"average to longer samples by `sample_time` {2 * sample_time:g}, or " * (
        2 * sample_time <= _LONGEST_SAMPLE
    )
    for name, row in disturbances.items():
        if name in AXES and abs(row.correlation) > _VIBRATION:
            yield _implausible(
                f"the noise of {name} is not white (innovations correlate by {row.correlation:.2g}): the gyro vibrates",
                f"{longer}damp the vibration, or log faster",
            )


def _moved(sample_times: Sequence[SampleTime], step: float, body: RigidBody) -> Iterator[Doubt]:
    """A moment of inertia of `body` that is another one at the next longer sample time. `step`: the chosen one [s]."""
    place = next((i for i, each in enumerate(sample_times) if each.sample_time == step), len(sample_times))
    for own, other in zip(sample_times[place : place + 1], sample_times[place + 1 : place + 2], strict=False):
        for name in (each for each in moved(own, other) if each in body.constants):
            values = [
                f"{each.constants[name].estimate:.3g} at {1e3 * each.sample_time:.3g} ms" for each in (own, other)
            ]
            yield _implausible(
                f"{name} depends on the sample time: {' and '.join(values)}",
                "the sensors vibrate, or the model lacks an effect: see the figure of inertia against sample time",
            )


def _turns(found: Found, stds: dict[str, float], airframe: Airframe) -> Iterator[Doubt]:
    """Roll and pitch must answer the rotors, and no axis with the opposite sign; else nothing was identified.

    If none has, gyroscopic couplings must be those of a rigid body with these inertias.
    """
    opposite = False
    for name, axis in (("alpha3", "roll"), ("alpha6", "pitch"), ("alpha8", "yaw")):
        value, std = found.get(name, (0.0, 0.0))
        if value + _SURE * std < 0:
            opposite = True
            yield _implausible(
                f"{name} = {value:.3g} is negative: {axis} answers the rotors with the opposite sign",
                "check `rotor_positions` and `rotor_spins`, and the axes of the log",
            )
        elif value <= _SURE * std and axis != "yaw":
            yield _implausible(
                f"{axis} does not clearly answer the rotors ({name} cannot be distinguished from 0)",
                f"fly more {axis}, or check `rotor_positions` in the airframe, and which rotor is which",
            )
    if opposite or not found.keys() >= {"alpha1", "alpha3", "alpha4", "alpha6", "alpha7", "alpha8"}:
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


def _unseen(found: Found, log_step: float) -> Iterator[Doubt]:
    """A lag or delay of the rotors that the log is too slow to show. `log_step`: its longest sample [s]."""
    lag, error = found.get("rotor_lag", (np.inf, 0.0))
    if -_SURE * error <= lag < log_step - _SURE * error:
        yield _implausible(
            f"rotor_lag = {lag:.2g} s is shorter than a sample of the log, {log_step:.2g} s",
            "log faster, or leave out the term `motor` or `lag`",
        )
    delay, error = found.get("rotor_delay", (0.0, 0.0))
    if abs(delay) - _SURE * error > _LONGEST_DELAY:
        how = "late" if delay < 0 else "early"
        yield _implausible(
            f"rotor_delay = {delay:.2g} s: motors are recorded {1e3 * abs(delay):.0f} ms {how}, more than any rotor",
            "check the time stamps of motors and gyro",
        )


def _still_axes(fit: Fit, predicted: Predictions) -> tuple[str, ...]:
    """The axes about which the held-out part hardly turns, or about which it was not measured."""
    still = []
    for (rate, axis), measured in zip(AXES.items(), np.moveaxis(predicted.measured, 2, 0), strict=True):
        noise = fit.disturbances[rate].sensor if rate in fit.disturbances else 0.0
        seen = measured[np.isfinite(measured)]
        if not seen.size or seen.std() < max(WEAK, OVER_NOISE * noise):
            still.append(axis)
    return tuple(still)


def _skill(skill: PredictionSkill | None, still: Sequence[str]) -> Iterator[Doubt]:
    if skill is None:
        return
    if len(still) == len(AXES):
        yield Doubt(
            "no_skill",
            "the held-out part hardly turns, so that no prediction checks the fit",
            "choose another part with `begin` and `end`, or another flight with `validate`",
        )
        return
    table = {rate: np.array(getattr(skill, rate).skill, dtype=float) for rate in AXES}
    places = {rate: decisive_horizon(skill.horizons, np.isfinite(row)) for rate, row in table.items()}
    poor = [rate for rate, row in table.items() if row[places[rate]] <= 0 and AXES[rate] not in still]
    if poor:
        named = ", ".join(f"{r} {table[r][places[r]]:.2g} at {skill.horizons[places[r]]:.2g} s" for r in poor)
        axes = " and ".join(AXES[rate] for rate in poor)
        yield Doubt(
            "no_skill",
            f"the fit predicts {axes} no better than constant rates (skill {named})",
            f"fly more {axes}, or check the airframe and the time stamps",
        )


def _implausible(cause: str, remedy: str) -> Doubt:
    return Doubt("implausible", cause, remedy)


def judge(case: Case, fit: Fit, sample_times: Sequence[SampleTime] = (), *, progress: Progress) -> dict[str, Any]:
    """Compare an answer with the airframe, with other sample times, and with measurements that were not fitted.

    `sample_times`: of a vehicle; the one of the fit is among them.

    **Returns:** the fields of an `Identification` for the answer, and for what speaks for and against it. `notes`: what
    could not be checked.
    """
    if not fit.answered:
        return {"parameters": {} if case.is_vehicle else parameter_table(case, fit)}
    table, held_out = parameter_table(case, fit), case.held_out
    if not case.is_vehicle:
        other = None if held_out is None else validate_on(fit, held_out, case.validate)
        return {"parameters": table, "rigid_body": rigid_body(fit), "validation": other}
    step = float(fit.problem.flight.dt)
    body = vehicle_constants(fit)
    predicted = skill = None
    if held_out is not None:
        progress("predicting what was not fitted")
        predicted, skill = predict_held_out(case, fit, held_out)
    still = () if predicted is None else _still_axes(fit, predicted)
    notes = [
        f"the held-out part hardly turns about {' and '.join(still)}; choose another with `begin`, `end` or `validate`"
    ] * (0 < len(still) < len(AXES))
    weak, trusted = overwhelmed(fit), table
    if yaw := weak.pop("yaw", None):
        # Vehicles hardly yaw. The other axes do not need it.
        body = RigidBody({name: row for name, row in body.constants.items() if name != "Iz"})
        trusted = {name: row for name, row in table.items() if name not in _OF_YAW}
        table |= {
            name: msgspec.structs.replace(table[name], note="not identified: the disturbance is larger")
            for name in _OF_YAW
            if name in table
        }
        still = (*still, *({"yaw"} - {*still}))
        notes.append(f"Iz is not identified: {yaw}; fly more yaw, or in calmer air")
    own = fit.problem.unknowns
    widths = dict(zip(own.names, np.asarray(own.half_width).tolist(), strict=True))
    # What is known of a held one is its bracket.
    held = {name: (row.value, widths[name]) for name, row in fit.held.items()} | fit.negative
    doubts = (
        *(() if fit.is_lowest else (_NOT_LOWEST,)),
        *(_implausible(cause, remedy) for cause, remedy in case.doubts),
        *(_implausible(why, f"fly more {axis}, or in calmer air") for axis, why in weak.items()),
        *(doubt for _, doubt in _contradicted(fit.problem.model, held)),
        *doubts_of(fit.problem.model, trusted, body.constants, skill, still, case.log_step),
    )
    doubts += (*vibration(fit.disturbances, step), *_moved(sample_times, step, body))
    values = as_float(np.asarray(fit.estimate.parameters)[: own.count])
    return {
        "parameters": table,
        "rigid_body": body,
        "doubts": doubts,
        "notes": notes,
        "skill": skill,
        "predictions": predicted,
        "response": frequency_response(with_room(fit.problem, case.room), values),
    }
