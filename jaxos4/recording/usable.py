"""Which parts of a flight can be used for identification, and why not the others.

A part is usable if the rotors carry the vehicle, no rotor rests or is at its limit for longer than a moment, the gyro
is not clipped, no samples are lost, and the vehicle does not crash. The rotors do not carry it if they are idle, or if
the accelerometer does not feel them (`jaxos4.recording.resting`).
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..airframe import Airframe
from ..errors import InputError
from ..flight import Flight
from .excited import RATE_COLUMNS
from .resting import resting

ON_GROUND = "on the ground"
SHORTEST = 1.0  # [s], of a usable stretch
MOMENT = 0.1  # [s]; a rotor may rest or be at its limit for this long: about its lag
_CARRIES = 0.3  # share of the weight; with less thrust for `_SUSTAINED`, the vehicle is on the ground
_SUSTAINED = 0.5  # [s]; shorter pauses of thrust happen in flight, shorter bursts on the ground
_MARGIN = 0.3  # [s], between the ground and free flight
_GAP = 0.05  # [s], the longest without a measurement
_LIMIT = 1e-3  # share of a rotor's largest speed; smaller differences count as none
_LEAST_HOVER = 0.2  # share of full command; no vehicle has a thrust of 25 times its weight
_FULL = 0.995  # share of the airframe's `max_rotor_speed`
_CLIPPED = 5  # samples in a row at the gyro's largest value
_SLOWEST_CLIP = 3.0  # [rad/s]: no gyro's range ends below 4.3 (250 deg/s)
_IMPACT_FORCE, _IMPACT_RATE = 50.0, 15.0  # [m/s^2], and [rad/s] within `_IMPACT_TIME`
_IMPACT_TIME = 0.02  # [s]
_AFTER_IMPACT, _BEFORE_IMPACT = 1.0, 0.5  # [s], until the rotors stop; not trusted before the impact

_USABLE, _SHORT, _CLIPPING, _SATURATED, _LOST, _CRASHED, _GROUND = range(7)  # the last one that applies counts
_NAMES = {
    _USABLE: "",
    _SHORT: f"less than {SHORTEST:g} s between others",
    _CLIPPING: "the gyro is clipped",
    _LOST: "nothing was measured",
    _CRASHED: "an impact",
    _GROUND: ON_GROUND,
}


class Stretch(NamedTuple):
    """A part of a flight, from the sample at `begin` to the sample at `end` [s].

    `reason`: why the part is not usable; empty if it is.
    """

    begin: float
    end: float
    reason: str = ""

    @property
    def length(self) -> float:
        """Its duration [s]."""
        return self.end - self.begin


class _Saturation(NamedTuple):
    rotor: int
    what: str
    begin: int
    end: int


def stretches(
    flight: Flight, airframe: Airframe | None = None, *, landed: Sequence[tuple[float, float]] = ()
) -> tuple[Stretch, ...]:
    """Divide a flight into stretches: usable ones, and others with the reason. Together they are the whole flight.

    **Arguments:**

    - `flight`: one flight, not a batch.
    - `airframe`: the weight, and the largest rotor speed. If there is none, or if it is evidently another vehicle's
      (thrust below a third or above three times the weight), the median thrust is taken as the weight.
    - `landed`: from when to when the vehicle itself says that it is on the ground [s], see `jaxos4.logs.LogFacts`.
    """
    time, omega = np.asarray(flight.time, dtype=float), np.asarray(flight.omega, dtype=float)
    states, dt = np.asarray(flight.states, dtype=float), float(flight.dt)
    share = _thrust_share(omega, airframe, commanded=flight.commanded)
    ground = _ground(share, dt)
    for begin, end in landed:
        ground |= (time >= begin - dt / 2) & (time <= end + dt / 2)
    saturations = _saturations(omega, airframe, dt)
    labels = np.zeros(time.size, dtype=int)
    for label, where in (
        (_CLIPPING, _clipped(states[:, RATE_COLUMNS])),
        (_SATURATED, _anywhere(saturations, time.size)),
        (_LOST, _lost(states, dt)),
        (_CRASHED, _crashed(flight, share, ground, dt)),
        (_GROUND, ground),
    ):
        labels[where] = label
    if flight.specific_force is not None:
        force = np.asarray(flight.specific_force, dtype=float)
        at_rest = resting(omega, force, states[:, RATE_COLUMNS], labels == _USABLE, dt)
        labels[at_rest & (labels != _LOST)] = _GROUND
    for begin, end in _runs(labels == _USABLE):
        if time[end - 1] - time[begin] < SHORTEST - dt / 2:
            labels[begin:end] = _SHORT
    edges = [0, *(np.flatnonzero(np.diff(labels)) + 1).tolist(), labels.size]
    return tuple(
        Stretch(float(time[begin]), float(time[end - 1]), _reason(int(labels[begin]), begin, end, saturations))
        for begin, end in itertools.pairwise(edges)
    )


def usable_stretches(flight: Flight, airframe: Airframe | None = None) -> tuple[Stretch, ...]:
    """The usable stretches, in order; each lasts at least one second."""
    return tuple(stretch for stretch in stretches(flight, airframe) if not stretch.reason)


def nothing_usable(every: Sequence[Stretch]) -> str:
    """Why none of these stretches of a flight can be used: the longest one, with its reason."""
    longest = max(every, key=lambda stretch: stretch.length)
    no_flight = {_NAMES[_GROUND], _NAMES[_SHORT], _NAMES[_LOST]}
    grounded = longest.reason == ON_GROUND and all(stretch.reason in no_flight for stretch in every)
    never = "the vehicle never flew" if grounded else "no part can be used"
    return f"{never} (from {longest.begin:.1f} s to {longest.end:.1f} s: {longest.reason})"


def cut(flight: Flight, stretch: Stretch) -> Flight:
    """The part of a flight from `stretch.begin` to `stretch.end`; its time stays as recorded.

    **Raises:** `InputError` if the part has fewer than two samples.
    """
    time, half = np.asarray(flight.time), float(flight.dt) / 2
    inside = np.flatnonzero((time >= stretch.begin - half) & (time <= stretch.end + half))
    if inside.size < 2:
        raise InputError(
            f"from {stretch.begin:g} s to {stretch.end:g} s: fewer than two samples; the flight lasts from "
            f"{time[0]:.6g} s to {time[-1]:.6g} s."
        )
    part = slice(int(inside[0]), int(inside[-1]) + 1)
    force = None if flight.specific_force is None else np.asarray(flight.specific_force)[part]
    voltage = None if flight.voltage is None else np.asarray(flight.voltage)[part]
    omega, states = np.asarray(flight.omega)[part], np.asarray(flight.states)[part]
    return Flight(time[part], omega, states, force, flight.result, commanded=flight.commanded, voltage=voltage)


def _thrust_share(omega: np.ndarray, airframe: Airframe | None, *, commanded: bool) -> np.ndarray:
    """Thrust as a share of the weight. Commands below a tenth of full scale count as idle, whatever the weight."""
    squares = (omega**2).sum(axis=1)
    usual = squares[squares > 0.1 * squares.max(initial=0.0)]
    usual = float(np.median(usual)) if usual.size else 1.0
    if airframe is not None:
        carries = float(airframe.mass * airframe.gravity / airframe.thrust_coefficient)
        if 1 / 3 < usual / carries < 3:
            usual = carries
    full = math.inf if airframe is None else float(airframe.max_rotor_speed)
    if commanded and airframe is None and omega.max(initial=0.0) <= 1:
        full = 1.0
    if commanded and math.isfinite(full):
        usual = max(usual, 4 * (_LEAST_HOVER * full) ** 2)
    return squares / max(usual, 1e-300)


def _ground(share: np.ndarray, dt: float) -> np.ndarray:
    """The samples on the ground, with a margin toward flight."""
    carried = share >= _CARRIES
    for value in (True, False):  # short pauses in flight first, then short bursts on the ground
        for begin, end in _runs(carried != value):
            inside = begin > 0 and end < carried.size
            if (end - begin) * dt < _SUSTAINED and inside:
                carried[begin:end] = value
    ground, margin = ~carried, _samples(_MARGIN, dt)
    for begin, end in _runs(~carried):
        ground[max(begin - margin, 0) : end + margin] = True
    return ground


def _clipped(rates: np.ndarray) -> np.ndarray:
    out = np.zeros(rates.shape[0], dtype=bool)
    for rate in np.abs(rates.T):
        largest = np.nanmax(rate) if np.isfinite(rate).any() else 0.0
        if largest < _SLOWEST_CLIP:
            continue
        for begin, end in _runs(rate >= (1 - _LIMIT) * largest):
            if end - begin >= _CLIPPED and np.ptp(rate[begin:end]) <= 1e-6 * largest:
                out[begin:end] = True
    return out


def _saturations(omega: np.ndarray, airframe: Airframe | None, dt: float) -> list[_Saturation]:
    """The runs in which a rotor rests, or is at its limit, for longer than a moment."""
    found, full_scale = [], math.inf if airframe is None else float(airframe.max_rotor_speed)
    for i, speed in enumerate(omega.T):
        largest, least, usual = float(speed.max()), float(speed.min()), float(np.median(speed))
        same = _LIMIT * largest
        if largest <= 0:
            continue
        full = np.asarray(speed >= _FULL * full_scale)
        if largest > 1.3 * usual > 0:
            full |= _steady(speed, same) & (speed >= largest - same)
        rest = np.asarray(speed <= same)
        if least < 0.5 * usual:
            rest |= _steady(speed, same) & (speed <= least + same)
        for where, what in ((full, "at full speed"), (rest, "at rest or idle")):
            found += [
                _Saturation(i + 1, what, begin, end) for begin, end in _runs(where) if (end - begin) * dt > MOMENT
            ]
    return found


def _steady(speed: np.ndarray, same: float) -> np.ndarray:
    """Whether each sample equals the one before or after it."""
    equal = np.abs(np.diff(speed)) <= same
    return np.append(equal, False) | np.insert(equal, 0, False)


def _lost(states: np.ndarray, dt: float) -> np.ndarray:
    """The samples in gaps of the rates; without any rate, in gaps of all channels together."""
    out, seen = np.zeros(states.shape[0], dtype=bool), np.isfinite(states)
    for measured in [seen[:, c] for c in RATE_COLUMNS if seen[:, c].any()] or [seen.any(axis=1)]:
        at = np.flatnonzero(measured)
        usual = float(np.median(np.diff(at))) * dt if at.size > 1 else 0.0
        for begin, end in _runs(np.asarray(~measured)):
            if (end - begin + 1) * dt > max(_GAP, 5 * usual):
                out[begin:end] = True
    return out


def _crashed(flight: Flight, share: np.ndarray, ground: np.ndarray, dt: float) -> np.ndarray:
    """The samples of a crash: from before an impact until the rotors stop, or the recording ends, soon after."""
    out, impact = np.zeros(share.size, dtype=bool), np.zeros(share.size, dtype=bool)
    if flight.specific_force is not None:
        impact = np.nan_to_num(np.linalg.norm(np.asarray(flight.specific_force), axis=1)) > _IMPACT_FORCE
    rates = np.asarray(flight.states)[:, RATE_COLUMNS]
    measured, rates = np.asarray(np.isfinite(rates).all(axis=1)), np.nan_to_num(rates)
    lag = min(max(_samples(_IMPACT_TIME, dt), 1), share.size - 1)
    jump = np.abs(rates[lag:] - rates[:-lag]).max(axis=1) > _IMPACT_RATE * max(lag * dt / _IMPACT_TIME, 1.0)
    impact[lag:] |= jump & measured[lag:] & measured[:-lag]
    after, before = _samples(_AFTER_IMPACT, dt), _samples(_BEFORE_IMPACT, dt)
    for begin in np.flatnonzero(impact):
        following = ground[begin : begin + after]
        if following.any() or begin + after >= share.size:
            stop = begin + int(np.argmax(following)) if following.any() else share.size
            out[max(begin - before, 0) : max(stop, begin + 1)] = True
    return out


def _reason(label: int, begin: int, end: int, saturations: list[_Saturation]) -> str:
    if label == _SATURATED:
        rotors: dict[str, set[int]] = {}
        for each in saturations:
            if each.begin < end and each.end > begin:
                rotors.setdefault(each.what, set()).add(each.rotor)
        return "; ".join(f"rotor {', '.join(map(str, sorted(which)))} {what}" for what, which in rotors.items())
    return _NAMES[label]


def _samples(seconds: float, dt: float) -> int:
    return math.ceil(seconds / dt - 1e-6)


def _runs(where: Bool[np.ndarray, " samples"]) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of each run of `True`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def _anywhere(saturations: list[_Saturation], size: int) -> np.ndarray:
    out = np.zeros(size, dtype=bool)
    for each in saturations:
        out[each.begin : each.end] = True
    return out
