"""Checks of the channels by themselves: time, values, rate, length."""

import math

import numpy as np

from ...airframe import AXES, INERTIAS
from ...errors import counted, percent
from ...flight import RATES, UNITS
from .evidence import HELD, Evidence, Finding

# Clipped thrust seems too weak, and moments of inertia are proportional to it.
_CLIPPED = {axis.rate: (axis.inertia,) for axis in AXES} | {"az": ("thrust", *INERTIAS)}


def uneven_time(evidence: Evidence) -> Finding | None:
    """Samples that are not on a uniform grid, which a `Flight` from Python may have."""
    steps = np.diff(evidence.logged.time)
    step = float(np.median(steps))
    uneven = np.abs(steps - step) > 0.05 * step  # resampled logs are far below
    if not uneven.any():
        return None
    missing = 1 - (steps.size + 1) / (np.sum(steps) / step + 1)
    if missing > 0:
        size = f"{percent(missing)} of the samples are missing, in gaps of up to {1e3 * steps.max():.3g} ms"
    else:
        size = f"steps of {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms"
    return Finding(
        "uneven_time",
        "the time of the flight is not uniform",
        size,
        "write the flight to a CSV and read it with `jaxos4.recording.read_recording`, which resamples it",
        (*INERTIAS, "thrust", "motors", "damping", "attitude"),
    )


def impossible_values(evidence: Evidence) -> Finding | None:
    """Single values far from all others."""
    found = evidence.plausible.impossible
    if not found:
        return None
    return Finding(
        "impossible_values",
        "single values are impossible, and count as not measured",
        ", ".join(f"{name}: {counted(number, 'value')}, as {worst:.4g}" for name, (number, worst) in found.items()),
        "if they are few, nothing needs to be done",
        (*INERTIAS, "thrust"),
        False,
    )


MANY_CLIPPED = 0.1  # share of clipped values above which a channel cannot be used


def clipped_values(evidence: Evidence) -> Finding | None:
    """Values at the end of a sensor's range."""
    found = evidence.plausible.clipped
    if not found:
        return None
    each = [f"{n}: {count} ({percent(share)}) at {end:.4g} {UNITS[n]}" for n, (count, share, end) in found.items()]
    many = bool(max(share for _, share, _ in found.values()) > MANY_CLIPPED)
    return Finding(
        "clipped_values",
        "a sensor is clipped at the end of its range; these values count as not measured",
        ", ".join(each),
        "fly more gently, or set a larger range of the sensor",
        tuple(dict.fromkeys(quantity for name in found for quantity in _CLIPPED.get(name, ()))),
        many,
    )


THRUST_MOVES = 0.01  # standard deviation of the thrust of a vehicle that moves, relative


def constant_force(evidence: Evidence) -> Finding | None:
    """A vertical specific force that never changes, although the rotors do."""
    force = evidence.logged.specific_force
    measured = np.empty(0) if force is None else force[np.isfinite(force[:, 2]), 2]
    squares = np.square(evidence.logged.omega).sum(axis=1)
    if not measured.size or np.ptp(measured) > 0 or squares.std() < THRUST_MOVES * squares.mean():
        return None
    return Finding(
        "constant_force",
        "the vertical specific force never changes, although the rotors do",
        f"{measured[0]:.4g} m/s^2 in all {measured.size} samples",
        "log what the accelerometer measures, or leave its columns out",
        ("thrust", *INERTIAS),
    )


# Longest time between instantaneous rotor speeds [s]. For rotors with a lag of 25 ms, 16 ms make Ix 4 % too small and
# Iz 9 % too large; the errors for 8 ms are below 1 % and 5 %.
INSTANTS = 0.0105


def rare_speeds(evidence: Evidence) -> Finding | None:
    """Instantaneous rotor speeds so far apart that their changes in between matter."""
    logged = evidence.logged
    if logged.commanded or logged.held or logged.dt <= INSTANTS:
        return None
    return Finding(
        "rare_speeds",
        "rotor speeds were logged too rarely to show how they changed in between",
        f"every {1e3 * logged.dt:.0f} ms",
        "log rotor speeds at 100 Hz or more, or their means",
        (*INERTIAS, "damping"),
        False,
    )


def rare_motors(evidence: Evidence) -> Finding | None:
    """Rotor speeds or commands that keep their value for longer than rotors take to answer."""
    if evidence.motor_step <= HELD:
        return None
    return Finding(
        "rare_motors",
        "motors were logged more rarely than the rotors respond, so the damping comes out too large",
        f"new values every {1e3 * evidence.motor_step:.0f} ms",
        "log motors at 100 Hz or more, on board",
        ("damping",),
    )


# Fewest independent motions of roll and pitch that show how large the noise is: with 15, the standard deviation of a
# mean square is 37 %. Two seconds of flight have 5 to 12, four have 7 to 21.
MIN_MOTIONS = 15.0


def short_flight(evidence: Evidence) -> Finding | None:
    """Few independent motions of roll and pitch."""
    measured = [each for each in evidence.stretches if np.isfinite(each.states[:, RATES[:2]]).any(axis=0).all()]
    if not measured:
        return None
    lengths = [float(np.ptp(each.time)) for each in measured]
    longest, seconds = measured[int(np.argmax(lengths))], sum(lengths)
    lasting = float(np.mean([longest.dt * _correlated(column) for column in longest.states[:, RATES[:2]].T]))
    motions = seconds / (2 * lasting) if lasting > 0 else math.inf  # nothing moves
    if motions >= MIN_MOTIONS:
        return None
    return Finding(
        "short_flight",
        "the flight is short, so that intervals may be too narrow",
        f"{seconds:.1f} s, or {motions:.0f} independent motions of {2 * lasting:.2g} s",
        f"fly for {5 * math.ceil(2 * MIN_MOTIONS * 2 * lasting / 5)} s or longer",
        INERTIAS,
        False,
    )


def _correlated(values: np.ndarray) -> float:
    """The sum of the autocorrelation until it is first negative, in samples."""
    values = np.nan_to_num(values - np.nanmean(values))
    power = np.square(np.abs(np.fft.rfft(values, 1 << (2 * values.size - 1).bit_length())))
    products = np.fft.irfft(power)[: values.size]
    until = int(np.argmax(products < 0)) or values.size
    return float(products[:until].sum() / max(products[0], 1e-300))
