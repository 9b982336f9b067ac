"""Recordings of one vehicle as one flight to fit: usable stretches, longer samples, whole windows, a part held out."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..errors import InputError, named
from ..flight import RATES, STATE_NAMES, Flight
from ..models.state import CASCADE_ORDER
from ..models.terms import COMMANDS, FULL_SCALE, LATERAL_FORCE, MEASURED_VELOCITY, VELOCITY, VERTICAL_FORCE, VOLTAGE
from .checks import different_vehicles, plausible, self_checks
from .checks.finding import INERTIAS, Finding
from .motion import opposite_axes, refused_note, white_noise, yaw_doubt
from .pieces import Recording, Stretch, averaged, cut, hold_out, joined, whole_windows
from .speed_noise import without_noise
from .usable import nothing_usable, stretches
from .velocity import Ups, measures_velocity, velocity_of

# Length of a window, and the shortest sample [s]: no quadrotor's motion needs shorter samples.
WINDOW, SAMPLE_TIME = 0.25, 0.004
# The longest sample at which an answer is compared with that of shorter ones [s].
LONGEST_SAMPLE_TIME = 0.032
# The share that is held out by default.
HOLDOUT = 0.25
_MOST_REASONS = 3
_FEWEST_SAMPLES = 4
# Sample times that differ by less than this factor count as equal.
_NEARLY_EQUAL = 1.01
# A sample time that the user gives becomes a multiple of the log's if that changes it by less than this share.
_NEARLY_WHOLE = 0.05
# The least noise of an accelerometer as a share of that by second differences, and the smallest change that is no
# rounding error as a share of the largest value.
_SHARE, _ROUNDING = 0.5, 1e-6
# The velocity that a stretch gains [m/s], and the share of the weight that is not carried by other causes.
_GAINED, _CARRIED = 1.0, 0.003
# The least mean cosine of the tilt of a vehicle whose weight says how its accelerometer errs.
_LEAST_UPRIGHT = 0.5
# Noise of rotor speeds is noted from this share of their changes on.
_NOISY = 0.1
# The share of time of a rotor at its limit, and how close to full speed that is.
_OFTEN, _FULL = 0.01, 0.999


class Prepared(NamedTuple):
    """Recordings, ready to be fitted.

    - `fitted`: one flight of all stretches; measurements that are held out are missing.
    - `tested`: the same samples with only the held-out measurements; `None`: nothing is held out.
    - `recordings`: for each stretch, the number of its recording, from 0.
    - `time`: of each sample in its log [s].
    - `length`: of a window, in samples.
    - `available`: what every recording offers to the terms of a model, see `Term.needs`.
    - `level`: the constant error of the accelerometer along z, and its standard deviation [m/s^2], see `_level`.
      `None`: unknown.
    - `force_noise`: the least standard deviation of the accelerometer's noise in a sample, along x, y, z [m/s^2].
    - `seconds`: how long the fitted and the tested measurements last [s].
    - `notes`: what the reader changed, and which stretches are not used.
    - `doubts`: what the logs show that concerns moments of inertia.
    - `log_step`: the longest sample of the logs [s].
    """

    fitted: Flight
    tested: Flight | None
    recordings: tuple[int, ...]
    time: Float[np.ndarray, " samples"]
    length: int
    available: frozenset[str]
    level: tuple[float, float] | None
    force_noise: Float[np.ndarray, "3"]
    seconds: tuple[float, float]
    notes: tuple[str, ...]
    doubts: tuple[Finding, ...]
    log_step: float

    @property
    def windows(self) -> int:
        """The number of windows; each lies in one stretch."""
        return self.fitted.time.shape[0] // self.length

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
    """Make one flight of the usable stretches of one vehicle's recordings. Arguments as of `jaxos4.identify`.

    `predicted`: the recordings are not fitted, but only predicted: then the gyro may be slow, but not the motors, and
    messages do not name options of the fit.

    **Returns:** the flight, averaged to `sample_time`, by default the shortest, and to each longer one at which an
    answer is compared with the others.

    **Raises:** `InputError`, one line, for arguments out of range and recordings that cannot be used.
    """
    _check_options(begin, end, sample_time, holdout)
    notes: list[str] = []
    parts: list[tuple[int, Recording]] = []
    doubts: list[Finding] = []
    for number, recording in enumerate(recordings):
        if any(recording.same_data(earlier) for earlier in recordings[:number]):
            raise InputError(f"{recording.name}: given twice; give each log once.")
        if np.isnan(recording.states[:, RATES]).all(axis=0).any():
            raise InputError(f"{recording.name}: a vehicle model needs p, q and r; log the gyro.")
        for finding in self_checks(recording, airframe):
            own = msgspec.structs.replace(finding, cause=f"{recording.name}: {finding.cause}")
            if {*own.quantities} & {*INERTIAS}:
                doubts.append(own)
            else:
                notes.append(str(own))
        recording = plausible(recording).recording
        slow = (recording.facts._replace(gyro=None) if predicted else recording.facts).too_slow
        pieces, note = _usable_parts(recording, airframe, begin, end, slow, predicted)
        if slow:
            raise InputError(f"{recording.name}: {slow}.")
        if doubt := at_limit(recording, airframe):
            notes.append("; ".join(doubt))
        opposite = opposite_axes(pieces, airframe)
        if refused := refused_note(opposite):
            raise InputError(f"{recording.name}: {refused}.")
        if doubt := yaw_doubt(opposite):
            cause, size, remedy = doubt
            doubts.append(Finding("yaw_sign", f"{recording.name}: {cause}", size, remedy, ("Iz",), True))
        notes += [*recording.named_notes, *([] if note is None else [f"{recording.name}: {note}"])]
        parts += [(number, piece) for piece in pieces]
    if different := different_vehicles(recordings, airframe):
        doubts.append(different)
    if len({piece.commanded for _, piece in parts}) > 1:
        raise InputError(
            f"{recordings[0].name}: some of these logs hold commands, others rotor speeds; fit them separately."
        )
    slowest = max(piece.dt for _, piece in parts)
    if slowest > _NEARLY_EQUAL * WINDOW / _FEWEST_SAMPLES:
        least = f"log at {_FEWEST_SAMPLES / WINDOW:g} Hz or more"
        raise InputError(f"{recordings[0].name}: has one sample every {slowest:.4g} s, too few for a vehicle; {least}.")
    if sample_time is not None and slowest > sample_time * _NEARLY_EQUAL:
        if predicted:
            raise InputError(
                f"{recordings[0].name}: has one sample every {slowest:.4g} s, the fitted logs one every "
                f"{sample_time:.4g} s; give `sample_time` {slowest:.4g}, or another `validate`."
            )
        raise InputError(f"`sample_time` {sample_time:g}: the logs have one sample every {slowest:.4g} s; give that.")
    shortest = max(SAMPLE_TIME if sample_time is None else sample_time, slowest)
    whole = max(round(shortest / slowest), 1) * slowest
    if not predicted and (sample_time is None or abs(whole - shortest) < _NEARLY_WHOLE * shortest):
        shortest = whole  # samples of whole rows
    doublings = 0 if predicted else math.floor(math.log2(LONGEST_SAMPLE_TIME * _NEARLY_EQUAL / shortest))
    steps = [shortest * 2**k for k in range(max(doublings, 0) + 1)]
    numbers, smooth = [number for number, _ in parts], _smooth(recordings, parts, airframe, notes)
    about = tuple(notes), tuple(doubts), slowest
    coarse = [averaged(piece, steps) for piece in smooth]
    return tuple(
        _sampled(recordings, [*zip(numbers, pieces, strict=True)], airframe, step, holdout, about)
        for step, *pieces in zip(steps, *coarse, strict=True)
    )


def _smooth(
    recordings: Sequence[Recording], parts: Sequence[tuple[int, Recording]], airframe: Airframe, notes: list[str]
) -> list[Recording]:
    """The parts without the noise of measured rotor speeds. Adds a note for each recording whose noise is large."""
    smooth = []
    for number, recording in enumerate(recordings):
        own, noise, share = without_noise([piece for i, piece in parts if i == number], airframe)
        smooth += own
        if share > _NOISY:
            how = f"white noise of {noise:.2g} rad/s, {share:.0%} of their changes from sample to sample"
            notes.append(f"{recording.name}: rotor speeds have {how}; their expected values are used")
    return smooth


def at_limit(recording: Recording, airframe: Airframe) -> tuple[str, str] | None:
    """Cause and remedy, if rotors are at full speed for a noticeable time. These stretches are not used."""
    shares = (recording.omega >= _FULL * float(airframe.max_rotor_speed)).mean(axis=0)
    often = [
        f"rotor {i + 1} is at its limit for {100 * x:.0f} % of the time" for i, x in enumerate(shares) if x > _OFTEN
    ]
    return (f"{recording.name}: {', '.join(often)}", "fly gentler, or with a fuller battery") if often else None


def _sampled(
    recordings: Sequence[Recording],
    parts: Sequence[tuple[int, Recording]],
    airframe: Airframe,
    step: float,
    holdout: float,
    about: tuple,
) -> Prepared:
    """One flight of the usable parts, averaged to samples of `step` [s]. `about`: the last fields of the result."""
    length = round(WINDOW / step)
    if length < _FEWEST_SAMPLES:
        least = WINDOW / _FEWEST_SAMPLES
        raise InputError(f"`sample_time` {step:g}: too long for a vehicle; give at most {least:g}, or log faster.")
    coarse = [(number, whole_windows(piece, length)) for number, piece in parts]
    numbers = tuple(number for number, piece in coarse if piece.time.size)
    pieces = [piece for _, piece in coarse if piece.time.size]
    if unused := [recording for i, recording in enumerate(recordings) if i not in numbers]:
        raise InputError(f"{unused[0].name}: no part is as long as a window, {WINDOW:g} s; leave this log out.")
    moved, ups = [velocity_of(piece) for piece in pieces], []
    if None not in moved:
        velocities, ups = zip(*moved, strict=True)
        pieces = [piece._replace(body_velocity=each) for piece, each in zip(pieces, velocities, strict=True)]
    whole, whole_time = joined(pieces), np.concatenate([piece.time for piece in pieces])
    fitted, tested = hold_out(whole, length, holdout)
    return Prepared(
        fitted.flight,
        None if tested is None else tested.flight,
        numbers,
        whole_time,
        length,
        _available_inputs(whole, pieces, airframe),
        _level(fitted, ups, float(airframe.gravity)) if ups else None,
        np.min([_force_noise(recording, step) for recording in recordings], axis=0),
        (_seconds(fitted), 0.0 if tested is None else _seconds(tested)),
        *about,
    )


def _available_inputs(whole: Recording, pieces: Sequence[Recording], airframe: Airframe) -> frozenset[str]:
    """The inputs for `Term.needs` that the joined recording offers. A force counts if every piece measured it."""
    force = np.all([~np.isnan(piece.channels[:, len(STATE_NAMES) :]).all(axis=0) for piece in pieces], axis=0)
    offers = {
        COMMANDS: whole.commanded,
        VELOCITY: whole.body_velocity is not None,
        MEASURED_VELOCITY: all(map(measures_velocity, pieces)),
        LATERAL_FORCE: force[0] and force[1],
        VERTICAL_FORCE: force[2],
        FULL_SCALE: airframe.has_full_scale,
        VOLTAGE: whole.voltage is not None,
    }
    return frozenset(name for name, offered in offers.items() if offered)


def _level(fitted: Recording, every: Sequence[Ups], gravity: float) -> tuple[float, float] | None:
    """The constant error of the accelerometer along z: the mean upright part of the specific force, less gravity.

    Over a stretch of flight a vehicle gains little velocity, so all forces together carry its weight.
    """
    force = fitted.specific_force
    if force is None or not (known := np.isfinite(force).all(axis=1)).any():
        return None
    ups = [np.concatenate(each)[known] for each in zip(*every, strict=True)]
    other, upright = ((force[known] * up).sum(axis=1).mean() for up in ups)
    cosine = ups[-1][:, 2].mean()
    if cosine < _LEAST_UPRIGHT or force[known, 2].mean() < 0:  # the second: the z axis points down
        return None
    gained = _GAINED * math.sqrt(len(every)) / (np.count_nonzero(known) * fitted.dt)
    return (upright - gravity) / cosine, math.hypot(gained, _CARRIED * gravity, upright - other) / cosine


def _force_noise(recording: Recording, step: float) -> Float[np.ndarray, "3"]:
    """The least white noise of means over samples of `step` [s]: by second differences, and by one count of the sensor.

    Vibration is not smooth from row to row, and so no disturbance. Without this limit, a fit may take it for one.
    """
    least, force = np.zeros(3), recording.specific_force
    for axis, values in enumerate([] if force is None else force.T):
        size = np.abs(np.diff(values))
        count = np.min(size[size > _ROUNDING * np.nanmax(np.abs(values), initial=1.0)], initial=np.inf)
        noise = max(_SHARE * white_noise(values, 2), count if np.isfinite(count) else 0.0)
        least[axis] = np.nan_to_num(noise) * math.sqrt(min(recording.dt / step, 1.0))
    return least


def _seconds(recording: Recording) -> float:
    return float(np.count_nonzero(~np.isnan(recording.states[:, CASCADE_ORDER[0]])) * recording.dt)


def _usable_parts(
    recording: Recording, airframe: Airframe, begin: float | None, end: float | None, slow: str, predicted: bool
) -> tuple[list[Recording], str | None]:
    """The usable stretches, or what `begin` and `end` ask for; and a note about the stretches that are not used.

    `slow`: what is wrong with the rate of logging, for the message if nothing is usable.
    """
    name, (first, last) = recording.name, recording.time[[0, -1]].tolist()
    if begin is not None or end is not None:
        with named(name):
            return [cut(recording, Stretch(first if begin is None else begin, last if end is None else end))], None
    every = stretches(recording, airframe)
    usable = [stretch for stretch in every if not stretch.reason]
    refused = sorted((stretch for stretch in every if stretch.reason), key=lambda stretch: -stretch.length)
    if not usable:
        remedy = "give the log of a flight" + ("" if predicted else ", or `begin` and `end` to use a part all the same")
        besides = f" Besides, {slow}." if slow else ""
        raise InputError(f"{name}: {nothing_usable(every)}; {remedy}.{besides}")
    if not refused:
        return [recording], None
    reasons = "; ".join(f"{part.begin:.1f} to {part.end:.1f} s: {part.reason}" for part in refused[:_MOST_REASONS])
    seconds = sum(stretch.length for stretch in usable)
    return [cut(recording, stretch) for stretch in usable], (
        f"{seconds:.1f} of {last - first:.1f} s are used, in {len(usable)} stretches; not used: {reasons}"
        f"{'; ...' if len(refused) > _MOST_REASONS else ''}{'' if predicted else ' (`begin` and `end` override)'}"
    )


def _check_options(begin: float | None, end: float | None, sample_time: float | None, holdout: float) -> None:
    if sample_time is not None and not 0 < sample_time < math.inf:
        raise InputError(f"`sample_time`: must be a positive number of seconds, got {sample_time:g}.")
    if not 0 <= holdout <= 0.5:
        raise InputError(f"`holdout`: must be a share from 0 to 0.5, got {holdout:g}.")
    if begin is not None and end is not None and not begin < end:
        raise InputError(f"`begin` {begin:g} `end` {end:g}: must be in this order.")
