"""Checks that the numbers of a log can be in the units of the flight CSV.

Each limit lies beyond the reach of any quadrotor, but not beyond that of a wrong unit. A wrong unit can still give
numbers within the limits, so each angle is also compared with the integral of its rate, if both were measured.
"""

import math
from typing import NamedTuple

import numpy as np

from .sampling import Series, integral
from .table import Table

DEGREES = 180 / math.pi


class Limit(NamedTuple):
    """The largest possible magnitude, its unit, and advice on the probable unit of a larger one."""

    largest: float
    unit: str
    advice: str


_TIME = Limit(1e11, "s", "t is in seconds: if these are milli-, micro- or nanoseconds, divide")
_SPEED = Limit(1e5, "rad/s", "rotor speeds are in rad/s: if these are rpm, divide by 9.549")
_YAW = Limit(1e4, "rad", "it looks like degrees: divide by 57.3")
_PITCH = "pitch lies within +-pi/2: if this is in degrees, divide by 57.3"
_FORCE = "specific force is in m/s^2: if these are thousandths of g, multiply by 0.00980665"

LIMITS = {
    "t": _TIME,
    **dict.fromkeys(("omega1", "omega2", "omega3", "omega4"), _SPEED),
    **dict.fromkeys("xyz", Limit(1e6, "m", "positions are in metres from a point near the flight; subtract an offset")),
    **dict.fromkeys(("vx", "vy", "vz"), Limit(1e3, "m/s", "velocities are in m/s: if these are mm/s, divide by 1000")),
    **dict.fromkeys("pqr", Limit(60.0, "rad/s", "it looks like deg/s: divide by 57.3")),
    "phi": Limit(2 * math.pi, "rad", _YAW.advice),
    "theta": Limit(math.nextafter(math.pi / 2, 0), "rad", _PITCH),
    "psi": _YAW,
    **dict.fromkeys(("ax", "ay", "az"), Limit(1e3, "m/s^2", _FORCE)),
    "voltage": Limit(200.0, "V", "the battery's voltage is in volts: if these are mV, divide by 1000"),
}
_NEGATIVE = "is {:g} rad/s; drop the sign, because rotor_spins gives the direction"
_NO_FRACTION = "is {:g}; commands are fractions 0..1 of full scale: divide by full scale (100, 65535)"
SHORTEST_STEP, LONGEST_STEP = 1e-6, 2.0  # [s], limits of the median time between rows
_ANGLES = (("phi", "p"), ("theta", "q"), ("psi", "r"))
_WINDOW = 0.2  # [s]: increments of an angle over this time are compared with the integral of its rate
_FEWEST = 8  # windows that a comparison needs
_SIMILARITY = 0.7  # smallest cosine between increments and integrals at which their ratio is used
_SPREAD = 1.6  # a ratio within this factor of 57.3 counts as 57.3


def check_units(table: Table) -> None:
    """Refuse numbers beyond `LIMITS`, speeds and commands out of range, and angles that contradict their rates.

    Roll may pass 2 pi if its rate agrees: the vehicle made a flip.
    """
    columns = table.columns
    flips = False
    for name, rate in _ANGLES:
        ratio = scale_ratio(columns["t"], columns[name], columns[rate]) if {name, rate} <= columns.keys() else None
        if ratio is None:
            continue
        flips |= name == "phi" and 1 / 3 < ratio < 3
        if 1 / _SPREAD < ratio / DEGREES < _SPREAD:
            what = table.remedy or "it looks like degrees, divide by 57.3"
            table.refuse(f"changes {ratio:.3g} times as fast as {rate}: {what}", column=name)
        if 1 / _SPREAD < ratio * DEGREES < _SPREAD:
            what = table.remedy or "it looks like deg/s, divide by 57.3"
            table.refuse(f"is {1 / ratio:.3g} times as fast as {name} changes: {what}", column=rate)
    for name, values in columns.items():
        limit = LIMITS.get(name)
        if limit is None:
            _refuse_any(table, name, (values < 0) | (values > 1), _NO_FRACTION)
            continue
        largest = _YAW.largest if name == "phi" and flips else limit.largest
        beyond = f"is {{:g}} {limit.unit}, beyond {largest:.4g} {limit.unit}; {table.remedy or limit.advice}"
        _refuse_any(table, name, np.abs(values) > largest, beyond)
        if limit is _SPEED:
            _refuse_any(
                table, name, values < 0, "is {:g} rad/s; drop the sign, because rotor_spins gives the direction"
            )
    if "psi" in columns:
        measured = np.flatnonzero(np.isfinite(columns["psi"]))
        jumps = np.zeros(columns["psi"].size, dtype=bool)
        jumps[measured[1:]] = np.abs(np.abs(np.diff(columns["psi"][measured])) - 360) < 20
        _refuse_any(table, "psi", jumps, "jumps by about 360: it looks like degrees, divide by 57.3")


def check_time(table: Table) -> float:
    """The median time between rows [s]. Refuses a time that is missing, does not increase, or is not in seconds."""
    t = table.columns["t"]
    _refuse_any(table, "t", np.isnan(t), "is empty; each row needs its time")
    _refuse_any(table, "t", np.abs(t) > _TIME.largest, f"is {{:g}} s; {_TIME.advice}")
    step = np.diff(t)
    if (step <= 0).any():
        index = int(np.argmax(step <= 0))
        if step[index] == 0:
            row = index + (table.first_row or 0)
            what = f"repeats {t[index]:.9g} s of row {row}; time must increase: delete one of the two rows"
        else:
            what = f"runs backward, from {t[index]:.9g} s to {t[index + 1]:.9g} s; sort the rows, or cut the file there"
        table.refuse(what, index=index + 1, column="t")
    dt = float(np.median(step))
    if dt < SHORTEST_STEP:
        table.refuse(f"has rows {dt:.3g} s apart, less than a microsecond; t is in seconds: multiply", column="t")
    if dt > LONGEST_STEP:
        what = f"has rows {dt:.4g} s apart, too far for a flight; t is in seconds: if these are ms or us, divide"
        table.refuse(what, column="t")
    return dt


def scale_ratio(t: np.ndarray, angle: np.ndarray, rate: np.ndarray) -> float | None:
    """How much faster an angle changes than its rate, or None if the flight does not show it.

    Increments of the angle over 0.2 s are compared with the integral of the rate, so that noise averages out. In a
    steep attitude the axes are coupled, and the increments no longer resemble the integral: the result is then None.
    """
    with_angle, with_rate = np.isfinite(angle), np.isfinite(rate)
    if np.count_nonzero(with_rate) < 2:
        return None
    rates = Series(t[with_rate], rate[with_rate, None])
    with_angle &= (t >= rates.t[0]) & (t <= rates.t[-1])
    instants = t[with_angle]
    if instants.size <= _FEWEST:
        return None
    windows = np.arange(1 + min((instants[-1] - instants[0]) / _WINDOW, instants.size))
    knots = np.unique(np.searchsorted(instants, instants[0] + _WINDOW * windows))
    knots = knots[knots < instants.size]
    if knots.size <= _FEWEST:
        return None
    steps = np.diff(angle[with_angle])
    turn = 360.0 if np.abs(steps).max() > 3 * math.pi else 2 * math.pi
    unwrapped = np.concatenate([[0.0], np.cumsum(steps - turn * np.rint(steps / turn))])
    increments = np.diff(unwrapped[knots])
    expected = np.diff(integral(rates, instants[knots], linear=True)[:, 0])
    sizes = float(np.linalg.norm(increments)), float(np.linalg.norm(expected))
    if min(sizes) == 0 or increments @ expected < _SIMILARITY * sizes[0] * sizes[1]:
        return None
    return sizes[0] / sizes[1]


def force_note(force: np.ndarray) -> list[str]:
    """A note, if specific force [m/s^2], shape (samples, 3), seems to be in multiples of g."""
    size = np.sqrt((force**2).sum(axis=1))
    size = size[np.isfinite(size)]
    if size.size == 0 or not 0.5 < np.median(size) < 2:
        return []
    return [f"ax, ay, az have a median magnitude of {np.median(size):.2g} m/s^2: if they are in g, multiply by 9.80665"]


def thrust_note(ratio: float) -> list[str]:
    """A note, if the median thrust is `ratio` times the weight, and rpm or rev/s would explain it."""
    if 1 / 25 < ratio < 25:
        return []
    if ratio == 0:
        return ["the rotors do not turn for at least half of the flight: keep only the part in the air"]
    unit = "rpm, divide by 9.549" if ratio > 1 else "rev/s, multiply by 6.283"
    what = f"the median thrust of the rotors is {ratio:.2g} times the airframe's weight"
    return [f"{what}: check the airframe, and whether rotor speeds are in {unit}"]


def _refuse_any(table: Table, name: str, wrong: np.ndarray, what: str) -> None:
    """Refuse the first value of a column that is `wrong`; `what` may hold a place for the value."""
    if wrong.any():
        index = int(np.argmax(wrong))
        table.refuse(what.format(table.columns[name][index]), index=index, column=name)
