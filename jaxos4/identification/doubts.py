"""Doubts about an estimate of a vehicle: each has a cause, a remedy, and the quantities that it would move."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..airframe import Airframe
from ..analysis.frequency_response import FrequencyResponse
from ..analysis.inertia import fit_inertia
from ..analysis.prediction import decisive_horizon
from ..models.abstract import AbstractModel, Parameter
from ..models.os4 import CorrectedOS4
from ..recording.checks import Finding
from .answers import AXES, INVERSE
from .results import Constant, Disturbance, ParameterEstimate, PredictionSkill, SampleTime
from .sample_time import moved
from .verdict import PREDICTIONS, TOLERANCE, Doubt, Move, Tolerance

Found = dict[str, tuple[float, float]]
"""Value and standard deviation of each parameter that has an estimate."""
Moves = dict[str, Move | None]
Consequences = Callable[[str, float], Mapping[str, Move | None]]
"""The changes of quantities if a parameter has another value; see `consequences`."""


class Plausible(NamedTuple):
    """Limits of what is physically plausible for a vehicle.

    - `heaviest`, `lightest`: the squared radius of gyration, as a share of that of all mass at the rotors; the second
      is that of a heavy centre.
    - `coupling`: aerodynamic moments may look like a gyroscopic coupling (alpha1, alpha4, alpha7) of this size.
    - `vibration`: innovations that correlate more bias filter error more than its intervals say.
    - `longest_sample`: longer ones [s] would hide the motion with the vibration.
    - `hopeless`: standard errors below 0 of a skill at the shortest horizon from which on an inertia is not identified.
    - `longest_delay`: of rotors [s]; more is an error of clocks.
    """

    heaviest: float = 1.5
    lightest: float = 0.01
    coupling: float = 0.25
    vibration: float = 0.4
    longest_sample: float = 0.008
    hopeless: float = 2.0
    longest_delay: float = 0.04


PLAUSIBLE = Plausible()
_ALL: Moves = dict.fromkeys(INVERSE)
_TORQUES: Moves = dict.fromkeys((*INVERSE, "thrust"))


def doubts_of_log(findings: Sequence[Finding]) -> Iterator[Doubt]:
    """The findings in the logs, as contradictions or as reservations."""
    for finding in findings:
        result = "implausible" if finding.contradicted else "successful"
        yield Doubt(result, f"{finding.cause} ({finding.size})", finding.remedy, dict.fromkeys(finding.quantities))


def few_parts(seconds: float, tolerance: Tolerance = TOLERANCE) -> Iterator[Doubt]:
    """A flight with too few parts to compare: nothing shows whether its intervals are too narrow.

    **Arguments:** `seconds`: how long the fitted measurements last [s].
    """
    if seconds < tolerance.seconds:
        yield Doubt(
            "unidentifiable" if 2 * seconds < tolerance.seconds else "successful",
            f"only {seconds:.1f} s were fitted, too few to compare parts of the flight: intervals may be too narrow",
            f"fly for {2 * tolerance.seconds:g} s or longer",
            _ALL,
        )


def stronger_or_weaker(
    response: FrequencyResponse, constants: Mapping[str, Constant], tolerance: Tolerance = TOLERANCE
) -> Iterator[Doubt]:
    """An axis that clearly answers the rotors more or less strongly than the model, by its frequency response.

    A reservation, and no refusal, because the frequency response has two to three times the error of the fit.
    """
    for (axis, found), name in zip(response._asdict().items(), INVERSE, strict=True):
        agreement, row = found.agreement(), constants.get(name)
        if row is not None and agreement.excludes_one(tolerance.share):
            share, (low, high) = abs(1 / agreement.ratio - 1), agreement.interval
            yield Doubt(
                "successful",
                f"from {agreement.low:g} to {agreement.high:g} Hz, {axis} answers the rotors {agreement.ratio:.2f} "
                f"({low:.2f} to {high:.2f}) times as strongly as the model",
                f"fly more {axis}, or look at its frequency response for what the model lacks",
                {name: Move(share, share * row.estimate / row.std)},
            )


def doubts_of(
    model: AbstractModel,
    parameters: dict[str, ParameterEstimate],
    constants: dict[str, Constant],
    skill: PredictionSkill | None,
    still: Sequence[str] = (),
    log_step: float = 0.0,
    follow: Consequences = lambda name, value: {},
) -> tuple[Doubt, ...]:
    """The reasons not to trust the estimate of a vehicle; empty if there are none.

    `still`: the axes about which the held-out part hardly turns. `log_step`: the longest sample of the logs [s].
    `follow`: how far the quantities move if a parameter has another value.

    The bounds of the parameters count, and not their standard deviations, which are large where the model is wrong.
    """
    rows = {
        name: (row.estimate, row.std, row.bound)
        for name, row in parameters.items()
        if row.estimate is not None and row.std is not None
    }
    found = {name: (value, std if bound is None else bound) for name, (value, std, bound) in rows.items()}
    stds = {name: std for name, (_, std, _) in rows.items()}
    wrong = dict(contradicted(model, found, follow))
    is_thrust_wrong = any(parameter.scales_torque for parameter in wrong)
    return (
        *wrong.values(),
        *(() if is_thrust_wrong else _impossible_inertias(constants, model.airframe)),
        *_turns(found, stds, model.airframe),
        *_unseen(found, log_step, follow),
        *_skill(skill, still),
    )


def contradicted(
    model: AbstractModel, found: Found, follow: Consequences = lambda name, value: {}
) -> Iterator[tuple[Parameter, Doubt]]:
    """The parameters whose values physics or the airframe forbid.

    The doubt moves other quantities as if the parameter had the value that the airframe lets expect.
    """
    owner = {name: quantity for quantity, names in model.quantities.items() for name in names}
    for parameter, usual in zip(model.parameters, np.asarray(model.alpha).tolist(), strict=True):
        if parameter.contradiction is None or parameter.name not in found:
            continue
        value, std = found[parameter.name]
        why = parameter.contradiction(value, TOLERANCE.sure * std)
        if why is not None:
            own: Moves = dict.fromkeys([owner[parameter.name]] if parameter.name in owner else [])
            others = _TORQUES if parameter.scales_torque else follow(parameter.name, usual)
            yield parameter, _implausible(f"{parameter.name} = {value:.2g} {why[0]}", why[1], {**others, **own})


def _impossible_inertias(constants: dict[str, Constant], airframe: Airframe) -> Iterator[Doubt]:
    reach = np.square(np.asarray(airframe.rotor_positions)).sum(axis=1).max()
    limit = float(airframe.mass) * reach
    for name, row in constants.items():
        largest, least = PLAUSIBLE.heaviest * limit * (2 if name == "Iz" else 1), PLAUSIBLE.lightest * limit
        beyond = row.estimate - TOLERANCE.sure * row.std > largest
        if beyond or row.estimate + TOLERANCE.sure * row.std < least:
            limit_passed = f"more than the {largest:.2g}" if beyond else f"less than the {least:.2g}"
            scale = "`drag_coefficient`" if name == "Iz" else "`thrust_coefficient`, `max_rotor_speed`"
            yield _implausible(
                f"{name} = {row.estimate:.3g} kg m^2 is {limit_passed} of a vehicle with this mass and arms",
                f"check `mass`, `rotor_positions` and {scale} in the airframe, and which rotor is which",
                {name: None},
            )
    for axis, one in constants.items() if len(constants) == len(INVERSE) else ():
        (second, two), (third, three) = (each for each in constants.items() if each[0] != axis)
        excess = one.estimate - two.estimate - three.estimate
        if excess > TOLERANCE.sure * np.sqrt(one.std**2 + two.std**2 + three.std**2) + 0.05 * one.estimate:
            remedy = (
                "if `drag_coefficient` is a guess, measure it; else fly more yaw"
                if axis == "Iz"
                else "check `rotor_positions`"
            )
            yield _implausible(
                f"{axis} = {one.estimate:.3g} exceeds {second} + {third} = {two.estimate + three.estimate:.3g} "
                "kg m^2, which no rigid body allows",
                remedy,
                {"Iz": None} if axis == "Iz" else _ALL,
            )


def vibration(
    disturbances: dict[str, Disturbance], sample_time: float, moves: Mapping[str, Move] | None = None
) -> Iterator[Doubt]:
    """A gyro whose noise is not white, usually by vibration: the controller answers it, and filter error is biased.

    **Arguments:** `sample_time`: of the fitted data [s]. `moves`: of the moments of inertia to another sample time.
    """
    longer = f"average to longer samples by `sample_time` {2 * sample_time:g}, or " * (
        2 * sample_time <= PLAUSIBLE.longest_sample
    )
    for rate, inertia in zip(AXES, INVERSE, strict=True):
        row = disturbances.get(rate)
        if row is not None and abs(row.correlation) > PLAUSIBLE.vibration:
            yield _implausible(
                f"the noise of {rate} is not white (innovations correlate by {row.correlation:.2g}): the gyro vibrates",
                f"{longer}damp the vibration, or log faster",
                {inertia: (moves or {}).get(inertia)},
            )


def neighbours(sample_times: Sequence[SampleTime], step: float) -> tuple[SampleTime, SampleTime] | None:
    """The answers at the chosen sample time, `step` [s], and at the next longer one, or else at the next shorter."""
    place = next((i for i, each in enumerate(sample_times) if each.sample_time == step), None)
    if place is None or len(sample_times) < 2:
        return None
    return sample_times[place], sample_times[place + 1 if place + 1 < len(sample_times) else place - 1]


def moves_between(own: SampleTime, other: SampleTime) -> dict[str, Move]:
    """The changes of the moments of inertia from one sample time to another."""
    both = [(name, row, other.constants[name]) for name, row in own.constants.items() if name in other.constants]
    return {
        name: Move(abs(two.estimate / one.estimate - 1), abs(two.estimate - one.estimate) / max(one.std, two.std))
        for name, one, two in both
    }


def moved_by_sample_time(own: SampleTime, other: SampleTime, constants: Mapping[str, Constant]) -> Iterator[Doubt]:
    """A moment of inertia, of those to judge, that is another one at the next sample time."""
    moves = moves_between(own, other)
    for name in (each for each in moved(own, other) if each in constants):
        values = [f"{each.constants[name].estimate:.3g} at {1e3 * each.sample_time:.3g} ms" for each in (own, other)]
        yield _implausible(
            f"{name} depends on the sample time: {' and '.join(values)}",
            "the sensors vibrate, or the model lacks an effect: see the figure of inertia against sample time",
            {name: moves[name]},
        )


def _turns(found: Found, stds: dict[str, float], airframe: Airframe) -> Iterator[Doubt]:
    """Roll and pitch must answer the rotors, and no axis with the opposite sign; else nothing was identified.

    If none has, gyroscopic couplings must be those of a rigid body with these inertias.
    """
    opposite = False
    for name, axis, inertia in (("alpha3", "roll", "Ix"), ("alpha6", "pitch", "Iy"), ("alpha8", "yaw", "Iz")):
        value, std = found.get(name, (0.0, 0.0))
        if value + TOLERANCE.sure * std < 0:
            opposite = True
            yield _implausible(
                f"{name} = {value:.3g} is negative: {axis} answers the rotors with the opposite sign",
                "check `rotor_positions` and `rotor_spins`, and the axes of the log",
                {inertia: None},
            )
        elif value <= TOLERANCE.sure * std and axis != "yaw":
            yield Doubt(
                "unidentifiable",
                f"{axis} does not clearly answer the rotors ({name} cannot be distinguished from 0)",
                f"fly more {axis}, or check `rotor_positions` in the airframe, and which rotor is which",
                {inertia: None},
            )
    if opposite or not found.keys() >= {"alpha1", "alpha3", "alpha4", "alpha6", "alpha7", "alpha8"}:
        return
    model = CorrectedOS4(airframe)
    alpha, variance = np.array(model.alpha, dtype=float), np.full(8, np.inf)
    for i in range(8):
        if f"alpha{i + 1}" in found:
            alpha[i] = found[f"alpha{i + 1}"][0]
            variance[i] = stds[f"alpha{i + 1}"] ** 2
    variance[[0, 3, 6]] += PLAUSIBLE.coupling**2
    variance[[1, 4]] = np.inf  # they need the inertia of the rotors too
    p_value, without_yaw = (_p_value(model, alpha, variance, unknown) for unknown in ([], [7]))
    if p_value < TOLERANCE.consistent:
        yield _implausible(
            f"alpha1, alpha4 and alpha7 contradict the inertias of alpha3, alpha6 and alpha8 (p = {p_value:.1g})",
            "check the axes and signs of the gyro, `rotor_positions` and `drag_coefficient`",
            _ALL if without_yaw < TOLERANCE.consistent else {"Iz": None},
        )


def _p_value(model: CorrectedOS4, alpha: np.ndarray, variance: np.ndarray, unknown: list[int]) -> float:
    """The probability that alphas of a rigid body disagree this much or more. `unknown`: places that do not count."""
    variance = variance.copy()
    variance[unknown] = np.inf
    variance = np.where(np.isfinite(variance), variance, (1e3 * np.asarray(model.half_width)) ** 2)
    return float(fit_inertia(model, alpha, np.diag(variance)).p_value)


def _unseen(found: Found, log_step: float, follow: Consequences) -> Iterator[Doubt]:
    """A lag or delay of the rotors that the log is too slow to show. `log_step`: its longest sample [s]."""
    lag, error = found.get("rotor_lag", (np.inf, 0.0))
    if -TOLERANCE.sure * error <= lag < log_step - TOLERANCE.sure * error:
        yield _implausible(
            f"rotor_lag = {lag:.2g} s is shorter than a sample of the log, {log_step:.2g} s",
            "log faster, or leave out the term `motor` or `lag`",
            {**follow("rotor_lag", log_step), "motors": None},
        )
    delay, error = found.get("rotor_delay", (0.0, 0.0))
    if abs(delay) - TOLERANCE.sure * error > PLAUSIBLE.longest_delay:
        how = "late" if delay < 0 else "early"
        yield _implausible(
            f"rotor_delay = {delay:.2g} s: motors are recorded {1e3 * abs(delay):.0f} ms {how}, more than any rotor",
            "check the time stamps of motors and gyro",
            {**follow("rotor_delay", float(np.copysign(PLAUSIBLE.longest_delay, delay))), "motors": None},
        )


def _skill(skill: PredictionSkill | None, still: Sequence[str]) -> Iterator[Doubt]:
    if skill is None:
        return
    if len(still) == len(AXES):
        yield Doubt(
            "no_skill",
            "the held-out part hardly turns, so that no prediction checks the fit",
            "choose another part with `begin` and `end`, or another flight with `validate`",
            {PREDICTIONS: None},
        )
        return
    table = {rate: np.array(getattr(skill, rate).skill, dtype=float) for rate in AXES}
    places = {rate: decisive_horizon(skill.horizons, np.isfinite(row)) for rate, row in table.items()}
    poor = [rate for rate, row in table.items() if row[places[rate]] <= 0 and AXES[rate] not in still]
    # Far ahead, what nobody can foresee is larger than what the rotors do. That says nothing of the inertia.
    first = {rate: (getattr(skill, rate).skill[0], getattr(skill, rate).std[0] or 0.0) for rate in poor}
    near = [rate for rate, (value, _) in first.items() if value is None or value <= 0]
    hopeless = [
        rate for rate, (value, std) in first.items() if value is not None and value + PLAUSIBLE.hopeless * std < 0
    ]
    if poor:
        moves: Moves = dict.fromkeys([PREDICTIONS])
        moves |= {inertia: None for inertia, rate in zip(INVERSE, AXES, strict=True) if rate in hopeless}
        named = ", ".join(f"{r} {table[r][places[r]]:.2g} at {skill.horizons[places[r]]:.2g} s" for r in poor)
        axes = " and ".join(AXES[rate] for rate in poor)
        yield Doubt(
            "no_skill" if near else "successful",
            f"the fit predicts {axes} no better than constant rates (skill {named})",
            f"fly more {axes}, or check the airframe and the time stamps",
            moves,
        )


def _implausible(cause: str, remedy: str, moves: Moves) -> Doubt:
    return Doubt("implausible", cause, remedy, moves)
