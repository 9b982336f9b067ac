"""The issues of an answer: cause, remedy, and the quantities that they would move.

Issues of the estimated values are in issues_of_values.py, all others here.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from ..airframe import AXES, INERTIAS, PITCH, YAW
from ..analysis.frequency_response import FrequencyResponse
from ..analysis.prediction import decisive_horizon
from ..estimate import REACH
from ..models.abstract import AbstractModel
from ..recording.checks import Finding
from ..results import meaning
from .answers import Answer, VehicleAnswer, dominated
from .data import Data
from .fit import is_white, moved
from .intervals import consequences
from .issues_of_values import ALL_INERTIAS, issues_of_alphas, issues_of_iz, issues_of_values
from .results import (
    COLOURED,
    ChannelFit,
    Constant,
    Disturbance,
    OS4Identification,
    PredictionSkill,
    SampleTime,
    VehicleIdentification,
)
from .verdict import CONTRADICTION, MAX_SHARE, PREDICTIONS, RESERVATION, RIGID_BODY, Issue, Move, Moves

# s; with less fitted data, moments of inertia have a reservation; with less than half of it, they are not identified.
# Segments last 1.25 s, and the jackknife compares at least four parts.
MIN_SECONDS = 10.0
VIBRATION = 0.4  # if innovations correlate more, filter error is biased by more than its intervals say
MAX_SAMPLE = 0.008  # s; longer samples would hide the motion along with the vibration
# Factors by which an interval is widened. In a flight of few parts, chance alone widens an interval by a factor of
# about 2; a larger one makes a warning. In 107 simulated logs, each of a single vehicle, no factor exceeds 2; a log of
# two vehicles has 9, and some real logs have 3 to 6. From the second factor on, what depends on the parameter has a
# reservation too.
WIDENED, DISAGREE = 2.0, 4.0
NO_SKILL = 2.0  # standard errors; an inertia is not identified if the skill at the shortest horizon is so far below 0
_NOT_LOWEST = (
    "the likelihood has several maxima, and the search did not find the highest",
    "fly more roll, pitch and yaw, or choose another part with `begin` and `end`",
)


def issues_of_os4(data: Data, found: OS4Identification, fit: Mapping[str, ChannelFit]) -> list[Issue]:
    """The issues about the alphas of an OS4.

    **Arguments:** `found`: the result, with the code of the search. `fit`: the fit of the channels whose residuals are
    white if the model is right; see `coloured`.
    """
    search, table = found.result, found.parameters
    every = (*table, RIGID_BODY)
    # A flight that hardly depends on one alpha says nothing against the others.
    unseen = [name for name, row in table.items() if row.estimate is None and search == "unidentifiable"]
    return [
        *issues_of_log(data.findings, every),
        *issues_of_alphas(table, found.rigid_body),
        *coloured(fit, every),
        *_issues_of_search(search, unseen or every),
    ]


def coloured(fit: Mapping[str, ChannelFit], quantities: Iterable[str]) -> Iterator[Issue]:
    """Residuals that are not white: only a reservation, because the sensors' noise may be coloured."""
    channels = {name: row.correlation for name, row in fit.items() if row.correlation > COLOURED}
    if channels:
        yield Issue(
            RESERVATION,
            f"the residuals of {', '.join(channels)} are not white (neighbours correlate by up to "
            f"{max(channels.values()):.2g}): the model does not explain the flight, or the noise is coloured",
            "check the scales, the axes and the time stamps of the log, or use another model",
            dict.fromkeys(quantities),
        )


def issues_of_vehicle(
    answer: VehicleAnswer,
    found: VehicleIdentification,
    response: FrequencyResponse,
    *,
    sample_times: Sequence[SampleTime],
    quantities: Iterable[str],
    still: Sequence[str],
) -> list[Issue]:
    """The issues about the estimate of a vehicle.

    **Arguments:** `found`: parameters, moments of inertia, the skill of predictions, and the result code of the search.
    `quantities`: the names of all quantities. `still`: see `issues_of_predictions`.
    """
    search, constants, weak = found.result, found.rigid_body.constants, dominated(answer)
    optimum, data, judged = answer.optimum, answer.optimum.data, found.parameters
    if YAW.motion in weak:
        judged = {name: row for name, row in judged.items() if name not in (YAW.coupling, YAW.inverse)}
    # A fixed parameter is known by its bracket only.
    widths = dict(
        zip(optimum.parameter_unknowns.names, np.asarray(optimum.parameter_unknowns.half_width).tolist(), strict=True)
    )
    fixed = {name: (row.value, widths[name]) for name, row in answer.fixed.items()} | dict(answer.negative)
    follow = partial(consequences, answer, constants)
    at_limits = [*_issues_of_limits(answer)] if search == "at_bound" else []
    return [
        *(() if optimum.is_lowest else [Issue("max_sweeps", *_NOT_LOWEST, dict.fromkeys(quantities))]),
        *issues_of_log(data.findings),
        *few_parts(data.provenance.fitted_seconds or 0.0),
        *parts_disagree(answer.problem.model, answer.widened, len(found.logs)),
        *(
            Issue("unidentifiable", weak[x.motion], f"fly more {x.motion}, or in calmer air", {x.inertia: None})
            for x in AXES
            if x.motion in weak
        ),
        *issues_of_iz(answer, found.parameters, constants),
        *issues_of_values(
            answer.problem.model, judged, constants, fixed, data.log_step, follow, motor_step=data.motor_step
        ),
        *issues_of_predictions(found.skill, still),
        *_issues_of_sample_time(answer, sample_times, constants),
        *stronger_or_weaker(response, constants),
        *(at_limits or _issues_of_search(search, quantities)),
    ]


def issues_of_log(findings: Sequence[Finding], quantities: Iterable[str] | None = None) -> Iterator[Issue]:
    """The findings in the logs, as contradictions or reservations. `quantities`: by default those of each finding."""
    for finding in findings:
        severity = CONTRADICTION if finding.contradicted else RESERVATION
        concerned = finding.quantities if quantities is None else quantities
        yield Issue(severity, f"{finding.cause} ({finding.size})", finding.remedy, dict.fromkeys(concerned))


def _issues_of_search(search: str, quantities: Iterable[str]) -> Iterator[Issue]:
    """The issue about a search that did not end well. `search`: the name of its result code."""
    if search != "successful":
        cause, remedy = meaning(search).rsplit(": ", 1)
        yield Issue(search, cause, remedy, dict.fromkeys(quantities))


def _issues_of_limits(answer: Answer) -> Iterator[Issue]:
    """Parameters that ended at their limit, and the quantities that depend on them."""
    model, own, values = answer.problem.model, answer.problem.unknowns, answer.parameters
    off = np.abs(values - np.asarray(own.center)) / np.asarray(own.half_width)
    for i in (place for place in answer.free if off[place] > 0.99 * REACH):
        concerned = dict.fromkeys(model_quantities(model, own.names[i]))
        cause = f"{own.names[i]} = {values[i]:.3g} {own.units[i]} is at the limit of the search around its bracket"
        yield Issue("at_bound", cause, "correct the airframe, or give a wider `bracket`", concerned)


def model_quantities(model: AbstractModel, name: str) -> tuple[str, ...]:
    """The quantities that depend directly on a parameter."""
    (parameter,) = (each for each in model.parameters if each.name == name)
    own = tuple(quantity for quantity, names in model.quantities.items() if name in names)
    if parameter.in_forcing or parameter.scales_torque:
        return *INERTIAS, *own
    of_axes = {"roll": ("alpha1", "alpha2", "alpha3"), "pitch": ("alpha4", "alpha5", "alpha6")}
    of_axes |= {"yaw": ("alpha7", "alpha8", "rotor_reaction")}
    of_axis = (each.inertia for each in AXES if name in of_axes[each.motion] or name.startswith(each.motion))
    return (*of_axis, *own) or INERTIAS


def few_parts(seconds: float) -> Iterator[Issue]:
    """Fitted data of too few `seconds` to compare parts, which would show whether intervals are too narrow."""
    if seconds < MIN_SECONDS:
        severity = "unidentifiable" if 2 * seconds < MIN_SECONDS else RESERVATION
        cause = f"only {seconds:.1f} s were fitted, too few to compare parts of the flight: intervals may be too narrow"
        yield Issue(severity, cause, f"fly for {2 * MIN_SECONDS:g} s or longer", ALL_INERTIAS)


def much_widened(found: VehicleIdentification) -> dict[str, float]:
    """The factors of intervals that were widened more than chance explains."""
    return {name: factor for name, factor in found.widened.items() if factor > WIDENED}


def parts_disagree(model: AbstractModel, widened: Mapping[str, float], logs: int = 1) -> Iterator[Issue]:
    """Parts of the flight that give different values of a parameter: wider intervals allow for random differences only.

    `widened`: see `VehicleAnswer`. `logs`: how many were fitted together.
    """
    flights, remedy = "flight", "fit parts of the flight with `begin` and `end`, and compare them"
    if logs > 1:
        flights, remedy = "flights", "fit the logs one by one"
    concerned: dict[tuple[str, ...], list[str]] = {}
    for name, factor in widened.items():
        if factor > DISAGREE:
            said = f"{name} (interval widened {factor:.1f} times)"
            concerned.setdefault(model_quantities(model, name), []).append(said)
    for quantities, said in concerned.items():
        yield Issue(
            RESERVATION,
            f"parts of the {flights} disagree on {', '.join(said)}: the vehicle changed, or the model lacks an effect",
            remedy,
            dict.fromkeys(quantities),
        )


def stronger_or_weaker(response: FrequencyResponse, constants: Mapping[str, Constant]) -> Iterator[Issue]:
    """Axes whose measured frequency response is clearly stronger or weaker than the model's.

    Only a reservation, because the frequency response has two to three times the error of the fit.
    """
    for axis, found in zip(AXES, response, strict=True):
        agreement, row = found.agreement(), constants.get(axis.inertia)
        if row is not None and agreement.excludes_one(MAX_SHARE):
            ratio, (low, high) = agreement.ratio, agreement.interval
            # Above a ratio of 2, the inertia would move by more than its corrected value: the share exceeds 1.
            share = ratio - 1 if ratio > 2 else abs(1 / ratio - 1)
            verb = f"{axis.motion}es" if axis == PITCH else f"{axis.motion}s"
            yield Issue(
                RESERVATION,
                f"from {agreement.low:g} to {agreement.high:g} Hz, the vehicle {verb} {_compared(ratio)} the "
                f"model (95 %: {low:.2f} to {high:.2f} times)",
                f"fly more {axis.motion}, or look at its frequency response for effects that the model lacks",
                {axis.inertia: Move(share, share * row.estimate / row.std)},
            )


def _compared(ratio: float) -> str:
    """Compares a motion with the model's, in words. `ratio`: of their amplitudes."""
    if 0.5 <= ratio <= 2:
        return f"{100 * abs(ratio - 1):.0f} % {'more' if ratio > 1 else 'less'} strongly than"
    return f"{ratio:.2g} times as strongly as"


def _issues_of_sample_time(
    answer: VehicleAnswer, sample_times: Sequence[SampleTime], constants: Mapping[str, Constant]
) -> Iterator[Issue]:
    """Innovations that are not white; an inertia that changes with the sample time."""
    step, steps = float(answer.problem.flight.dt), [each.sample_time for each in sample_times]
    vibrates = answer.optimum.data.vibrates
    place = steps.index(step) if step in steps else 0
    if len(steps) < 2:
        yield from vibration(answer.disturbances, step, vibrates=vibrates)
        if sample_times:
            yield from _correlated(sample_times[place], {})
        return
    own, other = sample_times[place], sample_times[place + 1 if place + 1 < len(steps) else place - 1]
    both = [(name, row, other.constants[name]) for name, row in own.constants.items() if name in other.constants]
    moves = {
        name: Move(abs(two.estimate / one.estimate - 1), abs(two.estimate - one.estimate) / max(one.std, two.std))
        for name, one, two in both
    }
    yield from vibration(answer.disturbances, step, moves, vibrates)
    yield from _correlated(own, moves)
    for name in (each for each in moved(own, other) if each in constants):
        values = [f"{each.constants[name].estimate:.3g} at {1e3 * each.sample_time:.3g} ms" for each in (own, other)]
        yield Issue(
            CONTRADICTION,
            f"{name} depends on the sample time: {' and '.join(values)}",
            "the sensors vibrate, or the model lacks an effect: see the figure of inertia against sample time",
            {name: moves[name]},
        )


def _correlated(row: SampleTime, moves: Mapping[str, Move]) -> Iterator[Issue]:
    """Innovations that are not white, but less correlated than by vibration."""
    if not is_white(row) and abs(row.correlation) <= VIBRATION:
        cause = f"innovations of the body rates correlate by {row.correlation:.2g} at {1e3 * row.sample_time:.3g} ms"
        yield Issue(RESERVATION, cause, "log faster, or before the filters of the gyro", moves)


def vibration(
    disturbances: Mapping[str, Disturbance],
    sample_time: float,
    moves: Mapping[str, Move] = {},
    vibrates: Mapping[str, float] = {},
) -> Iterator[Issue]:
    """A gyro whose noise is not white: the controller answers the noise, which biases filter error.

    **Arguments:** `sample_time`: of the fitted data [s]. `moves`: how far the moments of inertia move to another sample
    time. `vibrates`: the rates that vibrate, with their frequencies [Hz].
    """
    longer = f"average to longer samples by `sample_time` {2 * sample_time:g}, or " * (2 * sample_time <= MAX_SAMPLE)
    for axis in AXES:
        row = disturbances.get(axis.rate)
        if row is not None and abs(row.correlation) > VIBRATION:
            frequency = vibrates.get(axis.rate)
            why = "the model lacks an effect, or the gyro vibrates"
            yield Issue(
                CONTRADICTION,
                f"the noise of {axis.rate} is not white (innovations correlate by {row.correlation:.2g}): "
                f"{why if frequency is None else f'the gyro vibrates at {frequency:.0f} Hz'}",
                f"{longer}damp the vibration, or log faster",
                {axis.inertia: moves.get(axis.inertia)},
            )


def issues_of_predictions(skill: PredictionSkill | None, still: Sequence[str] = ()) -> Iterator[Issue]:
    """Predictions that are no better than constant rates. `still`: the axes about which nothing can be predicted."""
    if skill is None:
        return
    if len(still) == len(AXES):
        yield Issue(
            "no_skill",
            "the held-out part hardly turns, so that no prediction checks the fit",
            "choose another part with `begin` and `end`, or another flight with `validate`",
            {PREDICTIONS: None},
        )
        return
    poor, named, near = [], [], False
    moves: Moves = {PREDICTIONS: None}
    for axis in AXES:
        own = getattr(skill, axis.rate)
        values = np.array(own.skill, dtype=float)
        place = decisive_horizon(skill.horizons, np.isfinite(values))
        if axis.motion in still or not values[place] <= 0:
            continue
        poor.append(axis.motion)
        named.append(f"{axis.rate} {values[place]:.2g} at {skill.horizons[place]:.2g} s")
        # Far ahead, unpredictable gusts outweigh the rotors. That says nothing about the inertia.
        near |= not values[0] > 0
        if values[0] + NO_SKILL * (own.std[0] or 0.0) < 0:
            moves[axis.inertia] = None
    if poor:
        motions = " and ".join(poor)
        cause = f"the fit predicts {motions} no better than constant rates (skill {', '.join(named)})"
        remedy = f"fly more {motions}, or check the airframe and the time stamps"
        yield Issue("no_skill" if near else RESERVATION, cause, remedy, moves)
