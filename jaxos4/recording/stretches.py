"""Divides a flight into stretches that can be used for identification and unusable ones, with the reason.

A stretch is usable if the rotors carry the vehicle and the accelerometer feels it, no rotor rests or is at its limit
for longer than a moment, no samples are lost, and the vehicle does not crash.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..airframe import STANDARD_GRAVITY, Airframe
from ..errors import InputError
from ..flight import RATES, Flight
from ..logs import Recording, as_recording
from ..logs.sampling import runs

ON_GROUND, IDLE, LOST = "on the ground", "motors idle", "nothing was measured"
_SATURATED = "rotors"  # a placeholder: the final reason names the rotors

Samples = Bool[np.ndarray, " samples"]


class Stretch(NamedTuple):
    """A stretch of a flight from the sample at `begin` to the one at `end` [s]. `reason`: why it is unusable, or ""."""

    begin: float
    end: float
    reason: str = ""

    @property
    def length(self) -> float:
        """Its duration [s]."""
        return self.end - self.begin


MIN_STRETCH = 1.0  # s; shortest usable stretch, and shortest rest of a vehicle that lies on its side or back
MARGIN = 0.3  # s; between the ground and free flight
ONE_G = 0.15  # in multiples of gravity; the error of an accelerometer that feels only the weight


def stretches(flight: Flight | Recording, airframe: Airframe | None = None) -> tuple[Stretch, ...]:
    """Divide a flight into stretches: usable ones, and others with the reason. Together they are the whole flight.

    `airframe`: gives the weight and the largest rotor speed. Without it, or if the thrust is below a third or above
    three times the weight, the median thrust is taken as the weight.
    """
    recording = as_recording(flight)
    time, omega, dt, force = recording.time, recording.omega, recording.dt, recording.specific_force
    rates = recording.states[:, RATES]
    share = _thrust_share(recording, airframe)
    landed = np.zeros(time.size, dtype=bool)
    for begin, end in recording.facts.landed:  # as the vehicle itself reports
        landed |= (time >= begin - dt / 2) & (time <= end + dt / 2)
    ground = _ground(share, dt) | landed
    saturations = _saturations(omega, airframe, dt)
    reasons = np.full(time.size, "", dtype=object)  # of each sample; the last one that applies counts
    reasons[np.any([where.any(axis=1) for where in saturations.values()], axis=0)] = _SATURATED
    reasons[_lost(recording.states, dt)] = LOST
    reasons[_crashed(rates, force, share, ground, dt)] = "an impact"
    reasons[ground] = IDLE
    reasons[landed] = ON_GROUND
    weight = np.full(time.size, np.nan) if force is None else np.linalg.norm(force, axis=1) / STANDARD_GRAVITY
    for begin, end in runs(reasons == IDLE):
        felt = weight[begin:end][np.isfinite(weight[begin:end])]
        if felt.size and abs(np.median(felt) - 1) < ONE_G:
            reasons[begin:end] = ON_GROUND
    if force is not None:
        reasons[_resting(omega, force, rates, reasons == "", dt) & (reasons != LOST)] = ON_GROUND
    for begin, end in runs(reasons == ""):
        if time[end - 1] - time[begin] < MIN_STRETCH - dt / 2:
            reasons[begin:end] = f"less than {MIN_STRETCH:g} s between others"
    found = []
    edges = [0, *(np.flatnonzero(reasons[1:] != reasons[:-1]) + 1).tolist(), reasons.size]
    for begin, end in itertools.pairwise(edges):
        reason = reasons[begin]
        if reason == _SATURATED:
            rotors = {what: np.flatnonzero(where[begin:end].any(axis=0)) + 1 for what, where in saturations.items()}
            every = (f"rotor {', '.join(map(str, which))} {what}" for what, which in rotors.items() if which.size)
            reason = "; ".join(every)
        found.append(Stretch(float(time[begin]), float(time[end - 1]), reason))
    return tuple(found)


def unusable_note(every: Sequence[Stretch]) -> str:
    """Why none of these stretches can be used, in words: the longest one, with its reason."""
    longest = max(every, key=lambda stretch: stretch.length)
    no_flight = (ON_GROUND, IDLE, "less than", LOST)
    grounded = longest.reason in (ON_GROUND, IDLE) and all(each.reason.startswith(no_flight) for each in every)
    never = "the vehicle never flew" if grounded else "no part can be used"
    return f"{never} (from {longest.begin:.1f} s to {longest.end:.1f} s: {longest.reason})"


LAUNCH = 3.0  # s after the ground
TUMBLES = 10.0  # rad/s; a vehicle that turns faster so early was thrown, or tips over


def end_of_tumble(recording: Recording, airframe: Airframe) -> float | None:
    """The time at which a vehicle has recovered from tumbling at its first launch [s]; `None` if it does not tumble."""
    dt, time = recording.dt, recording.time
    flies = np.flatnonzero(~_ground(_thrust_share(recording, airframe), dt))
    if not flies.size or flies[0] == 0:  # the log begins in flight
        return None
    launch = recording.states[flies[0] : flies[0] + _samples(LAUNCH, dt), RATES]
    fast = np.flatnonzero(np.linalg.norm(launch, axis=1) > TUMBLES)
    return float(time[flies[0] + fast[-1]]) + MARGIN if fast.size else None


def cut(flight: Recording, stretch: Stretch) -> Recording:
    """The samples from `stretch.begin` to `stretch.end`; times stay. Raises `InputError` for fewer than two."""
    time, half = flight.time, flight.dt / 2
    inside = np.flatnonzero((time >= stretch.begin - half) & (time <= stretch.end + half))
    if inside.size < 2:
        raise InputError(
            f"from {stretch.begin:g} s to {stretch.end:g} s: fewer than two samples; the flight lasts from "
            f"{time[0]:.6g} s to {time[-1]:.6g} s."
        )
    return flight.rows(slice(int(inside[0]), int(inside[-1]) + 1))


# The smallest share of full command at which a vehicle hovers: no vehicle has a thrust of 25 times its weight.
LEAST_HOVER = 0.2


def _thrust_share(recording: Recording, airframe: Airframe | None) -> Float[np.ndarray, " samples"]:
    """Thrust as a share of the weight. Commands below a tenth of full scale count as idle, whatever the weight."""
    omega, commanded = recording.omega, recording.commanded
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
        usual = max(usual, 4 * (LEAST_HOVER * full) ** 2)
    return squares / max(usual, 1e-300)


CARRIES = 0.3  # share of the weight; with less thrust, a vehicle does not fly, though it may fall
SUSTAINED = 0.5  # s; shorter pauses of thrust happen in flight, shorter bursts on the ground


def _ground(share: Float[np.ndarray, " samples"], dt: float) -> Samples:
    """The samples on the ground, with a margin toward flight."""
    carried = share >= CARRIES
    for value in (True, False):  # short pauses in flight first, then short bursts on the ground
        for begin, end in runs(carried != value):
            if (end - begin) * dt < SUSTAINED and begin > 0 and end < carried.size:
                carried[begin:end] = value
    ground, margin = ~carried, _samples(MARGIN, dt)
    for begin, end in runs(~carried):
        ground[max(begin - margin, 0) : end + margin] = True
    return ground


MOMENT = 0.1  # s; a rotor may rest or be at its limit for this long: about its lag
SAME = 1e-3  # share of a rotor's largest speed; smaller differences count as none
FULL = 0.995  # share of the airframe's `max_rotor_speed` that counts as full speed, with a margin for noise


def _saturations(omega: np.ndarray, airframe: Airframe | None, dt: float) -> dict[str, Bool[np.ndarray, "samples 4"]]:
    """The samples of each rotor in which it is at its limit, or rests, for longer than a moment."""
    full_scale = math.inf if airframe is None else float(airframe.max_rotor_speed)
    found = {what: np.zeros(omega.shape, dtype=bool) for what in ("at full speed", "at rest or idle")}
    for i, speed in enumerate(omega.T):
        largest, least, usual = float(speed.max()), float(speed.min()), float(np.median(speed))
        same = SAME * largest
        if largest <= 0:
            continue
        # A sample is steady if it equals the one before or after it.
        equal = np.abs(np.diff(speed)) <= same
        steady = np.append(equal, False) | np.insert(equal, 0, False)
        full, rest = speed >= FULL * full_scale, speed <= same
        if largest > 1.3 * usual > 0:
            full |= steady & (speed >= largest - same)
        if least < 0.5 * usual:
            rest |= steady & (speed <= least + same)
        for where, lasting in zip((full, rest), found.values(), strict=True):
            lasting[:, i] = _lasting(where, MOMENT / dt)
    return found


GAP = 0.05  # s; the longest usable gap between measurements, or five samples of a slow sensor


def _lost(states: np.ndarray, dt: float) -> Samples:
    """The samples in gaps of the rates; without any rate, in gaps of all channels together."""
    out, seen = np.zeros(states.shape[0], dtype=bool), np.isfinite(states)
    for measured in [seen[:, c] for c in RATES if seen[:, c].any()] or [seen.any(axis=1)]:
        at = np.flatnonzero(measured)
        step = float(np.median(np.diff(at))) * dt if at.size > 1 else 0.0
        out |= _lasting(np.asarray(~measured), max(GAP, 5 * step) / dt - 1)
    return out


IMPACT_FORCE = 50.0  # m/s^2
IMPACT_RATE = 15.0  # rad/s; the change within `IMPACT_TIME`
IMPACT_TIME = 0.02  # s
BEFORE_IMPACT = 0.5  # s before an impact that are not trusted
AFTER_IMPACT = 1.0  # s within which the rotors stop after a crash


def _crashed(rates: np.ndarray, force: np.ndarray | None, share: np.ndarray, ground: Samples, dt: float) -> Samples:
    """The samples of a crash: from before an impact until the rotors stop, or the recording ends, soon after."""
    out, impact = np.zeros((2, share.size), dtype=bool)
    if force is not None:
        impact = np.nan_to_num(np.linalg.norm(force, axis=1)) > IMPACT_FORCE
    measured, rates = np.asarray(np.isfinite(rates).all(axis=1)), np.nan_to_num(rates)
    lag = min(max(_samples(IMPACT_TIME, dt), 1), share.size - 1)
    most = IMPACT_RATE * max(lag * dt / IMPACT_TIME, 1.0)
    impact[lag:] |= (np.abs(rates[lag:] - rates[:-lag]).max(axis=1) > most) & measured[lag:] & measured[:-lag]
    after, before = _samples(AFTER_IMPACT, dt), _samples(BEFORE_IMPACT, dt)
    for begin in np.flatnonzero(impact):
        following = ground[begin : begin + after]
        if following.any() or begin + after >= share.size:
            stop = begin + int(np.argmax(following)) if following.any() else share.size
            out[max(begin - before, 0) : max(stop, begin + 1)] = True
    return out


BIN = 0.05  # s; means over this time are compared
TILTED, STILL = 0.5, 0.2  # largest share of gravity along z, and rate [rad/s], of a vehicle on its side or back


def _resting(omega: np.ndarray, force: np.ndarray, rates: np.ndarray, airborne: Samples, dt: float) -> Samples:
    """Whether the accelerometer shows that the vehicle is at rest, for each `airborne` sample.

    In flight, the specific force along z is thrust over mass. On the ground or in a hand it is gravity, whatever the
    rotors do. If the vehicle lies on its side or back, gravity is not along +z. Constant thrust proves nothing.
    """
    size = omega.shape[0]
    length = max(round(BIN / dt), 1)
    bins = size // length
    if bins < 2 or np.ptp(np.nan_to_num(force), axis=0).max() == 0:  # no accelerometer is still to the last bit
        return np.zeros(size, dtype=bool)
    sensed = np.column_stack([omega.mean(axis=1) ** 2, force / STANDARD_GRAVITY, np.abs(rates).max(axis=1)])
    sensed[~airborne] = np.nan
    means = sensed[: bins * length].reshape(bins, length, -1).mean(axis=1)  # NaN where a sample is
    step, weight = length * dt, np.linalg.norm(means[:, 1:4], axis=1)
    with np.errstate(invalid="ignore"):
        lies = (np.abs(weight - 1) < ONE_G) & (means[:, 3] < TILTED) & (means[:, 4] < STILL)
    found = _unfelt(means, step) | _lasting(lies, math.ceil(MIN_STRETCH / step) - 1)
    return found[np.minimum(np.arange(size) // length, bins - 1)]


SMOOTH = 4  # bins; longer than the lag of any rotor
REST = 2.0  # s; a window in which thrust and force are compared
FILLED = 5.0  # s; the longest gap between two resting windows that is filled
VARIES = 0.2  # smallest relative standard deviation of thrust in a window
UNFELT = 0.1  # relative change of the vertical force per relative change of thrust; 1 in flight
STEADY = 0.1  # standard deviation of the force of a resting vehicle, in multiples of gravity


def _unfelt(means: Float[np.ndarray, "bins 5"], step: float) -> Bool[np.ndarray, " bins"]:
    """The bins of windows in which thrust changes, but the accelerometer's signal does not."""
    kernel, edge = np.full(SMOOTH, 1 / SMOOTH), SMOOTH // 2
    smooth = np.column_stack([np.convolve(column, kernel, "same") for column in means.T])
    smooth[:edge] = smooth[-edge:] = np.nan
    out, felt = np.zeros((2, means.shape[0]), dtype=bool)
    wide = max(round(REST / step), 4)
    for begin in range(0, means.shape[0] - wide // 2, max(wide // 4, 1)):
        window = smooth[begin : begin + wide]
        window = window[np.isfinite(window[:, :4]).all(axis=1)]
        if window.shape[0] < wide // 2:
            continue
        thrust, vertical, size = window[:, 0], window[:, 3], np.linalg.norm(window[:, 1:4], axis=1)
        mean = thrust.mean()
        if mean <= 0 or thrust.std() < VARIES * mean:
            continue
        deviation = thrust - mean
        follows = (deviation @ vertical) / (deviation @ deviation) * mean / max(abs(vertical.mean()), 0.1)
        gravity = abs(size.mean() - 1) < ONE_G and size.std() < STEADY
        (out if gravity and abs(follows) < UNFELT else felt)[begin : begin + wide] = True
    for one, following in itertools.pairwise(np.flatnonzero(out)):
        if 1 < following - one <= FILLED / step and not felt[one + 1 : following].any():
            out[one:following] = True
    return out


def _lasting(where: Samples, most: float) -> Samples:
    """`where`, without the runs of at most `most` samples."""
    out = np.zeros_like(where)
    for begin, end in runs(where):
        out[begin:end] = end - begin > most
    return out


def _samples(seconds: float, dt: float) -> int:
    return math.ceil(seconds / dt - 1e-6)
