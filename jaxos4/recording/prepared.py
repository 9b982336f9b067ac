"""Recordings of one vehicle as one flight to fit: usable stretches, longer samples, whole windows, some held out."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..errors import InputError, counted, named
from ..flight import RATES, STATE_NAMES, Flight
from ..logs import Recording
from ..models.state import CASCADE_ORDER
from ..models.terms import COMMANDS, FULL_SCALE, LATERAL_FORCE, MEASURED_VELOCITY, VELOCITY, VERTICAL_FORCE, VOLTAGE
from . import windows
from .checks import Evidence, Finding, different_thrust, findings, opposite_yaw
from .motion import in_body_axes, measures_velocity, opposite_axes, refused_note, velocity_of
from .sensor_errors import force_level, force_noise, smoothed, vibrating_rates
from .stretches import FULL, Stretch, cut, end_of_tumble, unusable_note
from .windows import averaged, concatenate, fair_share, hold_out, whole_windows

HOLDOUT = 0.25
"""The share that is held out by default."""
_NEARLY = 1.01  # sample times that differ by less than this factor count as equal
_SAME = 1e-6  # durations that differ by less than this share are equal

WINDOW = 0.25  # s
MIN_SAMPLES = 4  # of a window
# The shortest sample by default [s]. A fast controller responds to single rows of a log, which a mean does not hold: in
# samples of 4 ms instead of 2, Ix is 1 to 3 % and the damping 0.2 /s larger. Commands that change less than twice in
# 2 ms hold too little of the controller to gain from that.
SHORTEST, SHORTEST_OF_COMMANDS = 0.002, 0.004
LONGEST = 0.032  # s; the longest sample at which an answer is compared with that of shorter ones
# A given sample time becomes a multiple of the log's if that changes it by less than this share.
WHOLE = 0.05
OFTEN = 0.01  # a larger share of the time at this limit is noted


class Prepared(NamedTuple):
    """Recordings, ready to be fitted.

    - `fitted`: one flight of all stretches; measurements that are held out are missing.
    - `tested`: the same samples with only the held-out measurements; `None`: nothing is held out.
    - `recordings`: for each stretch, the number of its recording, from 0.
    - `time`: the time of each sample in its log [s].
    - `windows`: the number of windows; each lies in one stretch.
    - `available`: the data that every recording offers to the terms of a model, see `Term.needs`.
    - `level`: the constant error of the accelerometer along z, and its standard deviation [m/s^2], see `force_level`.
      `None`: unknown.
    - `force_noise`: the least standard deviation of the accelerometer's noise in a sample, along x, y, z [m/s^2].
    - `seconds`: how long the fitted and the tested measurements last [s].
    - `notes`: changes by the reader, and stretches that are not used.
    - `findings`: faults of the logs that concern moments of inertia, or contradict another quantity.
    - `log_step`: the longest sample of the logs [s].
    - `motor_step`: the longest time between new values of the motors in the logs [s].
    - `vibrates`: the rates with a line in the gyro's spectrum, and its frequency [Hz], see `vibrating_rates`.
    """

    fitted: Flight
    tested: Flight | None
    recordings: tuple[int, ...]
    time: Float[np.ndarray, " samples"]
    windows: int
    available: frozenset[str]
    level: tuple[float, float] | None
    force_noise: Float[np.ndarray, "3"]
    seconds: tuple[float, float]
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    log_step: float = 0.0
    motor_step: float = 0.0
    vibrates: Mapping[str, float] = MappingProxyType({})

    @property
    def battery_voltage(self) -> float | None:
        """The median of the battery's voltage [V]. `None`: not logged."""
        return None if self.fitted.voltage is None else float(np.median(self.fitted.voltage))


def prepare(
    recordings: Sequence[Recording],
    airframe: Airframe,
    *,
    begin: float | None = None,
    end: float | None = None,
    sample_time: float | None = None,
    holdout: float = HOLDOUT,
    predicted: bool = False,
) -> tuple[Prepared, ...]:
    """Make one flight of the usable stretches of one vehicle's recordings. Arguments as in `jaxos4.identify`.

    `predicted`: the recordings are not fitted, but only predicted: then the gyro may be slow, but not the motors, and
    messages do not name options of the fit.

    **Returns:** the flight, averaged to `sample_time`, by default the shortest, and to each longer one at which an
    answer is compared with the others.

    **Raises:** `InputError`, one line, for arguments out of range and recordings that cannot be used.
    """
    _check_arguments(recordings, begin, end, sample_time, holdout)
    commanded = any(each.commanded for each in recordings)
    logged = max(each.dt for each in recordings)
    step = finest(logged, sample_time, commands=logged * commanded)
    seconds = math.inf if predicted else fair_share(recordings, step)
    evidences = [Evidence(each, airframe, seconds=seconds) for each in recordings]
    pieces, notes, found = [], [], []
    for evidence in evidences:
        stretches, remarks, faults = _cleaned(evidence, airframe, begin, end, predicted=predicted)
        pieces.append(stretches)
        notes += remarks
        found += faults
    if len({stretch.commanded for stretches in pieces for stretch in stretches}) > 1:
        raise InputError(
            f"{recordings[0].name}: some of these logs hold commands, others rotor speeds; fit them separately."
        )
    if (different := different_thrust(evidences)) is not None:
        found.append(different)
    numbers, stretched, remarks = smoothed(recordings, pieces, airframe)
    notes += remarks
    slowest = max(stretch.dt for stretch in stretched)
    motor_step = max(slowest, *(each.motor_step for each in evidences))
    commands = motor_step * commanded
    steps = _sample_times(recordings[0].name, slowest, sample_time, commands=commands, predicted=predicted)
    coarse = zip(*(averaged(stretch, steps) for stretch in stretched), strict=True)
    vibrates = {name: at for stretches in pieces for name, at in vibrating_rates(stretches).items()}
    noise = np.min([force_noise(in_body_axes(each, airframe)) for each in recordings], axis=0)
    rests = [rest for each in evidences if (rest := each.rest) is not None]
    return tuple(
        _sampled(recordings, numbers, flown, airframe, step, holdout, rests, noise)._replace(
            notes=tuple(notes),
            findings=tuple(found),
            log_step=slowest,
            motor_step=motor_step,
            vibrates=vibrates,
        )
        for step, flown in zip(steps, coarse, strict=True)
    )


def _check_arguments(
    recordings: Sequence[Recording],
    begin: float | None,
    end: float | None,
    sample_time: float | None,
    holdout: float,
) -> None:
    """Raises `InputError` for an argument out of range, and for a log that is given twice."""
    if sample_time is not None and not 0 < sample_time < math.inf:
        raise InputError(f"`sample_time`: must be a positive number of seconds, got {sample_time:g}.")
    if not 0 <= holdout <= 0.5:
        raise InputError(f"`holdout`: must be a share from 0 to 0.5, got {holdout:g}.")
    if begin is not None and end is not None and not begin < end:
        raise InputError(f"`begin` {begin:g} `end` {end:g}: must be in this order.")
    for number, recording in enumerate(recordings):
        if any(recording.same_data(earlier) for earlier in recordings[:number]):
            raise InputError(f"{recording.name}: given twice; give each log once.")


def _cleaned(
    evidence: Evidence, airframe: Airframe, begin: float | None, end: float | None, *, predicted: bool
) -> tuple[list[Recording], list[str], list[Finding]]:
    """The plausible stretches of one recording to fit, notes, and findings.

    Findings concern a moment of inertia, or contradict another quantity. All others, and those about the attitude
    alone, become notes. Raises `InputError` if the recording cannot be used.
    """
    recording = evidence.logged
    name, facts = recording.name, recording.facts
    if np.isnan(recording.states[:, RATES]).all(axis=0).any():
        raise InputError(f"{name}: a vehicle model needs p, q and r; log the gyro.")
    slow = (facts._replace(gyro=None) if predicted else facts).too_slow_note
    usable, note = _usable(evidence, begin, end, slow, predicted=predicted)
    if slow:
        raise InputError(f"{name}: {slow}.")
    opposite = opposite_axes(usable, airframe)
    if refused := refused_note(opposite):
        raise InputError(f"{name}: {refused}.")
    notes, judged = [], []
    for found in filter(None, (*findings(evidence), opposite_yaw(opposite))):
        found = msgspec.structs.replace(found, cause=f"{name}: {found.cause}")
        if found.counts_for_vehicles:
            judged.append(found)
        else:
            notes.append(str(found))
    if limited := saturation_note(evidence.recording, airframe):
        notes.append(limited)
    if begin is None and (recovered := end_of_tumble(evidence.recording, airframe)) is not None:
        notes.append(f"{name}: tumbles at launch until {recovered:.1f} s (`begin` {recovered:.1f} leaves this out)")
    return usable, [*notes, *recording.named_notes, *note], judged


def saturation_note(recording: Recording, airframe: Airframe) -> str:
    """The rotors that are often at full speed, and the remedy; empty if none is. These stretches are not used."""
    shares = (recording.omega >= FULL * float(airframe.max_rotor_speed)).mean(axis=0)
    often = [
        f"rotor {i + 1} is at its limit for {100 * share:.0f} % of the time"
        for i, share in enumerate(shares)
        if share > OFTEN
    ]
    return f"{recording.name}: {', '.join(often)}; fly more gently, or with a fuller battery" if often else ""


def _usable(
    evidence: Evidence, begin: float | None, end: float | None, slow: str, *, predicted: bool
) -> tuple[list[Recording], list[str]]:
    """The usable stretches, or those from `begin` to `end`; notes on the others. `slow`: why the log is too slow."""
    recording = evidence.recording
    name, (first, last), notes = recording.name, recording.time[[0, -1]].tolist(), []
    parts, refused = evidence.usable, [stretch for stretch in evidence.all_stretches if stretch.reason]
    if begin is not None or end is not None:
        given = Stretch(first if begin is None else begin, last if end is None else end)
        with named(name):
            cut(recording, given)
        parts = [Stretch(max(given.begin, first), min(given.end, last))]
    elif not parts:
        remedy = "give the log of a flight" + ("" if predicted else ", or `begin` and `end` to use a part all the same")
        besides = f" Besides, {slow}." if slow else ""
        raise InputError(f"{name}: {unusable_note(evidence.all_stretches)}; {remedy}.{besides}")
    elif refused:
        longest = sorted(refused, key=lambda stretch: -stretch.length)[:3]
        reasons = "; ".join(f"{each.begin:.1f} to {each.end:.1f} s: {each.reason}" for each in longest)
        notes.append(
            f"{name}: {sum(part.length for part in parts):.1f} of {last - first:.1f} s are used, in {len(parts)} "
            f"stretches; not used: {reasons}{'; ...' if len(refused) > 3 else ''}"
            f"{'' if predicted else ' (`begin` and `end` override)'}"
        )
    chosen = evidence.richest(parts)
    seconds, usable = (sum(each.length for each in every) for every in (chosen, parts))
    if seconds <= (1 - _SAME) * usable:
        notes.append(
            f"{name}: {seconds:.1f} of {usable:.1f} usable s are fitted, because more than {windows.MOST:,} samples "
            f"take minutes: the {counted(len(chosen), 'part')} whose torques vary the most (a longer `sample_time` "
            "fits more; `begin` and `end` choose another part)"
        )
    return [cut(recording, each) for each in chosen], notes


def _sample_times(
    name: str, slowest: float, sample_time: float | None, *, commands: float, predicted: bool
) -> list[float]:
    """The sample times at which answers are compared [s], the shortest first. `slowest`, `commands`: see `finest`."""
    if slowest > _NEARLY * WINDOW / MIN_SAMPLES:
        least = f"log at {MIN_SAMPLES / WINDOW:g} Hz or more"
        raise InputError(f"{name}: has one sample every {slowest:.4g} s, too few for a vehicle; {least}.")
    if sample_time is not None and slowest > sample_time * _NEARLY:
        if predicted:
            raise InputError(
                f"{name}: has one sample every {slowest:.4g} s, the fitted logs one every "
                f"{sample_time:.4g} s; give `sample_time` {slowest:.4g}, or another `validate`."
            )
        raise InputError(f"`sample_time` {sample_time:g}: the logs have one sample every {slowest:.4g} s; give that.")
    shortest = finest(slowest, sample_time, commands=commands, predicted=predicted)
    doublings = 0 if predicted else math.floor(math.log2(LONGEST * _NEARLY / shortest))
    return [shortest * 2**k for k in range(max(doublings, 0) + 1)]


def finest(
    slowest: float, sample_time: float | None = None, *, commands: float = 0.0, predicted: bool = False
) -> float:
    """The shortest sample time [s] at which logs are fitted, or `sample_time`.

    `slowest`: the longest time between rows [s]. `commands`: between new commands; 0: speeds were measured.
    """
    default = SHORTEST_OF_COMMANDS if 2 * commands > SHORTEST * _NEARLY else SHORTEST
    shortest = max(default if sample_time is None else sample_time, slowest)
    whole = max(round(shortest / slowest), 1) * slowest  # samples of whole rows
    is_near = sample_time is None or abs(whole - shortest) < WHOLE * shortest
    return whole if is_near and not predicted else shortest


def _sampled(
    recordings: Sequence[Recording],
    numbers: Sequence[int],
    flown: Sequence[Recording],
    airframe: Airframe,
    step: float,
    holdout: float,
    rests: Sequence[Float[np.ndarray, "3"]],
    noise: Float[np.ndarray, "3"],
) -> Prepared:
    """Joins stretches, averaged to samples of `step` [s], to one flight.

    - `numbers`: for each stretch, the number of its recording.
    - `rests`: the specific forces before take-off that are known [m/s^2].
    - `noise`: the lower limit of the accelerometer's noise, see `force_noise`.
    """
    length = round(WINDOW / step)
    if length < MIN_SAMPLES:
        least = WINDOW / MIN_SAMPLES
        raise InputError(f"`sample_time` {step:g}: too long for a vehicle; give at most {least:g}, or log faster.")
    whole = [(number, whole_windows(each, length)) for number, each in zip(numbers, flown, strict=True)]
    whole = [(number, each) for number, each in whole if each.time.size]
    numbers, flown = tuple(number for number, _ in whole), [each for _, each in whole]
    if unused := [recording for i, recording in enumerate(recordings) if i not in numbers]:
        raise InputError(f"{unused[0].name}: no part is as long as a window, {WINDOW:g} s; leave this log out.")
    moved, ups = [velocity_of(each) for each in flown], []
    if None not in moved:
        velocities, ups = zip(*moved, strict=True)
        flown = [each._replace(body_velocity=velocity) for each, velocity in zip(flown, velocities, strict=True)]
    everything = concatenate(flown)
    fitted, tested = hold_out(everything, length, holdout)
    return Prepared(
        fitted=fitted.flight,
        tested=None if tested is None else tested.flight,
        recordings=numbers,
        time=np.concatenate([each.time for each in flown]),
        windows=everything.time.size // length,
        available=_available_inputs(everything, flown, airframe),
        level=force_level(fitted, ups, rests, float(airframe.gravity)),
        force_noise=noise / math.sqrt(step),
        seconds=(_seconds(fitted), 0.0 if tested is None else _seconds(tested)),
    )


def _available_inputs(whole: Recording, flown: Sequence[Recording], airframe: Airframe) -> frozenset[str]:
    """The inputs for `Term.needs` that the whole recording offers; a force only if every stretch measured it."""
    force = np.all([~np.isnan(each.channels[:, len(STATE_NAMES) :]).all(axis=0) for each in flown], axis=0)
    offers = {
        COMMANDS: whole.commanded,
        VELOCITY: whole.body_velocity is not None,
        MEASURED_VELOCITY: all(map(measures_velocity, flown)),
        LATERAL_FORCE: force[0] and force[1],
        VERTICAL_FORCE: force[2],
        FULL_SCALE: airframe.has_full_scale,
        VOLTAGE: whole.voltage is not None,
    }
    return frozenset(name for name, offered in offers.items() if offered)


def _seconds(recording: Recording) -> float:
    return float(np.count_nonzero(~np.isnan(recording.states[:, CASCADE_ORDER[0]])) * recording.dt)
