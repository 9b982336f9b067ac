"""Which parts of a flight can be used for identification, and why not the others.

A part is usable if the rotors carry the vehicle, no rotor rests or is at its limit for longer than a moment, no samples
are lost, and the vehicle does not crash. The rotors do not carry it if they are idle, or if the accelerometer does not
feel them.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from ..airframe import STANDARD_GRAVITY, Airframe
from ..flight import Flight
from .motion import RATE_COLUMNS
from .pieces import Recording, Stretch, as_recording

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
_IMPACT_FORCE, _IMPACT_RATE = 50.0, 15.0  # [m/s^2], and [rad/s] within `_IMPACT_TIME`
_IMPACT_TIME = 0.02  # [s]
_AFTER_IMPACT, _BEFORE_IMPACT = 1.0, 0.5  # [s], until the rotors stop; not trusted before the impact
_BIN, _SMOOTH = 0.05, 4  # [s], means over this time; bins, longer than the lag of any rotor
_REST, _FILLED = 2.0, 5.0  # [s], a window; a gap between two resting windows is filled up to this length
_VARIES = 0.2  # standard deviation of thrust in a window, as a share of its mean
_UNFELT = 0.1  # relative change of the vertical force for a relative change of thrust: 1 in flight
_STEADY, _ONE_G = 0.1, 0.15  # [g], standard deviation of the force of a resting vehicle; error of an accelerometer
_TILTED, _STILL, _SHORTEST_REST = 0.5, 0.2, 1.0  # [g] along z, [rad/s], [s]

_USABLE, _SHORT, _SATURATED, _LOST, _CRASHED, _GROUND = range(6)  # the last one that applies counts
_NAMES = {
    _USABLE: "",
    _SHORT: f"less than {SHORTEST:g} s between others",
    _LOST: "nothing was measured",
    _CRASHED: "an impact",
    _GROUND: ON_GROUND,
}


def stretches(flight: Flight | Recording, airframe: Airframe | None = None) -> tuple[Stretch, ...]:
    """Divide a flight into stretches: usable ones, and others with the reason. Together they are the whole flight.

    **Arguments:**

    - `flight`: one flight, not a batch.
    - `airframe`: the weight, and the largest rotor speed. If there is none, or if it is evidently another vehicle's
      (thrust below a third or above three times the weight), the median thrust is taken as the weight.
    """
    recording = as_recording(flight)
    time, omega, dt, force = recording.time, recording.omega, recording.dt, recording.specific_force
    rates = recording.states[:, RATE_COLUMNS]
    share = _thrust_share(omega, airframe, commanded=recording.commanded)
    ground = _ground(share, dt)
    for begin, end in recording.facts.landed:  # as the vehicle itself says
        ground |= (time >= begin - dt / 2) & (time <= end + dt / 2)
    saturations = _saturations(omega, airframe, dt)
    labels = np.zeros(time.size, dtype=int)
    for label, where in (
        (_SATURATED, np.any([where.any(axis=1) for where in saturations.values()], axis=0)),
        (_LOST, _lost(recording.states, dt)),
        (_CRASHED, _crashed(rates, force, share, ground, dt)),
        (_GROUND, ground),
    ):
        labels[where] = label
    if force is not None:
        labels[_resting(omega, force, rates, labels == _USABLE, dt) & (labels != _LOST)] = _GROUND
    for begin, end in _runs(labels == _USABLE):
        if time[end - 1] - time[begin] < SHORTEST - dt / 2:
            labels[begin:end] = _SHORT
    edges = [0, *(np.flatnonzero(np.diff(labels)) + 1).tolist(), labels.size]
    return tuple(
        Stretch(float(time[begin]), float(time[end - 1]), _reason(int(labels[begin]), begin, end, saturations))
        for begin, end in itertools.pairwise(edges)
    )


def nothing_usable(every: Sequence[Stretch]) -> str:
    """Why none of these stretches of a flight can be used: the longest one, with its reason."""
    longest = max(every, key=lambda stretch: stretch.length)
    no_flight = [_NAMES[label] for label in (_GROUND, _SHORT, _LOST)]
    grounded = longest.reason == ON_GROUND and all(stretch.reason in no_flight for stretch in every)
    never = "the vehicle never flew" if grounded else "no part can be used"
    return f"{never} (from {longest.begin:.1f} s to {longest.end:.1f} s: {longest.reason})"


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


def _saturations(omega: np.ndarray, airframe: Airframe | None, dt: float) -> dict[str, np.ndarray]:
    """The samples of each rotor in which it is at its limit, or rests, for longer than a moment."""
    full_scale = math.inf if airframe is None else float(airframe.max_rotor_speed)
    found = {what: np.zeros(omega.shape, dtype=bool) for what in ("at full speed", "at rest or idle")}
    for i, speed in enumerate(omega.T):
        largest, least, usual = float(speed.max()), float(speed.min()), float(np.median(speed))
        same = _LIMIT * largest
        if largest <= 0:
            continue
        # Each sample that equals the one before or after it.
        equal = np.abs(np.diff(speed)) <= same
        steady = np.append(equal, False) | np.insert(equal, 0, False)
        full, rest = speed >= _FULL * full_scale, speed <= same
        if largest > 1.3 * usual > 0:
            full |= steady & (speed >= largest - same)
        if least < 0.5 * usual:
            rest |= steady & (speed <= least + same)
        for where, lasting in zip((full, rest), found.values(), strict=True):
            lasting[:, i] = _lasting(where, MOMENT / dt)
    return found


def _lost(states: np.ndarray, dt: float) -> np.ndarray:
    """The samples in gaps of the rates; without any rate, in gaps of all channels together."""
    out, seen = np.zeros(states.shape[0], dtype=bool), np.isfinite(states)
    for measured in [seen[:, c] for c in RATE_COLUMNS if seen[:, c].any()] or [seen.any(axis=1)]:
        at = np.flatnonzero(measured)
        usual = float(np.median(np.diff(at))) * dt if at.size > 1 else 0.0
        out |= _lasting(np.asarray(~measured), max(_GAP, 5 * usual) / dt - 1)
    return out


def _crashed(
    rates: np.ndarray, force: np.ndarray | None, share: np.ndarray, ground: np.ndarray, dt: float
) -> np.ndarray:
    """The samples of a crash: from before an impact until the rotors stop, or the recording ends, soon after."""
    out, impact = np.zeros((2, share.size), dtype=bool)
    if force is not None:
        impact = np.nan_to_num(np.linalg.norm(force, axis=1)) > _IMPACT_FORCE
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


def _resting(
    omega: np.ndarray, force: np.ndarray, rates: np.ndarray, airborne: np.ndarray, dt: float
) -> Bool[np.ndarray, " samples"]:
    """Which samples are of a vehicle at rest, by its accelerometer; judged are those that may be in flight.

    In flight the specific force along z is the thrust, divided by the mass. On the ground and in a hand it is that of
    gravity, whatever the rotors do. And a vehicle that lies on its side or back measures gravity across its rotors'
    axes. A window without changes of thrust proves nothing.
    """
    size = omega.shape[0]
    length = max(round(_BIN / dt), 1)
    bins = size // length
    if bins < 2 or np.ptp(np.nan_to_num(force), axis=0).max() == 0:  # no accelerometer lies still to the last bit
        return np.zeros(size, dtype=bool)
    sensed = np.column_stack([omega.mean(axis=1) ** 2, force / STANDARD_GRAVITY, np.abs(rates).max(axis=1)])
    sensed[~airborne] = np.nan
    means = sensed[: bins * length].reshape(bins, length, -1).mean(axis=1)  # NaN where a sample is
    step, weight = length * dt, np.linalg.norm(means[:, 1:4], axis=1)
    # A vehicle lies on its side or back for at least a second.
    with np.errstate(invalid="ignore"):
        lies = (np.abs(weight - 1) < _ONE_G) & (means[:, 3] < _TILTED) & (means[:, 4] < _STILL)
    found = _unfelt(means, step) | _lasting(lies, math.ceil(_SHORTEST_REST / step) - 1)
    return found[np.minimum(np.arange(size) // length, bins - 1)]


def _unfelt(means: np.ndarray, step: float) -> np.ndarray:
    """The bins of windows in which thrust changes, and the accelerometer does not."""
    smooth = np.column_stack([np.convolve(column, np.full(_SMOOTH, 1 / _SMOOTH), "same") for column in means.T])
    smooth[: _SMOOTH // 2] = smooth[-(_SMOOTH // 2) :] = np.nan
    out, felt = np.zeros((2, means.shape[0]), dtype=bool)
    wide = max(round(_REST / step), 4)
    for begin in range(0, means.shape[0] - wide // 2, max(wide // 4, 1)):
        part = smooth[begin : begin + wide]
        part = part[np.isfinite(part[:, :4]).all(axis=1)]
        if part.shape[0] < wide // 2:
            continue
        thrust, vertical, size = part[:, 0], part[:, 3], np.linalg.norm(part[:, 1:4], axis=1)
        mean = thrust.mean()
        if mean <= 0 or thrust.std() < _VARIES * mean:
            continue
        deviation = thrust - mean
        follows = (deviation @ vertical) / (deviation @ deviation) * mean / max(abs(vertical.mean()), 0.1)
        gravity = abs(size.mean() - 1) < _ONE_G and size.std() < _STEADY
        (out if gravity and abs(follows) < _UNFELT else felt)[begin : begin + wide] = True
    known = np.flatnonzero(out)
    for one, following in zip(known[:-1], known[1:], strict=True):
        if 1 < following - one <= _FILLED / step and not felt[one + 1 : following].any():
            out[one:following] = True
    return out


def _reason(label: int, begin: int, end: int, saturations: dict[str, np.ndarray]) -> str:
    if label != _SATURATED:
        return _NAMES[label]
    rotors = {what: np.flatnonzero(where[begin:end].any(axis=0)) + 1 for what, where in saturations.items()}
    return "; ".join(f"rotor {', '.join(map(str, which))} {what}" for what, which in rotors.items() if which.size)


def _lasting(where: np.ndarray, most: float) -> np.ndarray:
    """`where`, without runs of at most so many samples."""
    out = np.zeros_like(where)
    for begin, end in _runs(where):
        out[begin:end] = end - begin > most
    return out


def _samples(seconds: float, dt: float) -> int:
    return math.ceil(seconds / dt - 1e-6)


def _runs(where: Bool[np.ndarray, " samples"]) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of each run of `True`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
