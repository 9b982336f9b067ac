"""The values that columns can have, and those that no sensor measured: impossible, far from all others, or stuck.

The latter count as not measured. Many of them in a column are a wrong unit, and refuse the log.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..airframe import STANDARD_GRAVITY
from ..flight import COMMAND_NAMES, FORCE_NAMES, RATE_NAMES, SIGNALS, SPEED_NAMES, UNITS, filled
from .sampling import runs
from .table import Recording, Table


class ColumnLimits(NamedTuple):
    """The unit of a column, and the numbers that it can hold.

    - `unit`: the unit of the column. `others`: units in which a log may have it, and their factors to `unit`.
    - `least`, `largest`: values beyond are impossible for any quadrotor; only a wrong unit gives them.
    - `advice`: on larger values, and, without `below`, on smaller ones too.
    - `zero`: whether 0 and negative numbers are measurements. If not, they count as not measured.
    """

    unit: str
    least: float
    largest: float
    advice: str
    below: str = ""
    others: Mapping[str, float] = MappingProxyType({})
    zero: bool = True


DEGREE, RPM = math.pi / 180, 2 * math.pi / 60  # rad, rad/s
PWM, PWM_ZERO = "PWM", 1000.0  # us; a command in this unit is (value - 1000) / 1000
_TURNING = {"deg/s": DEGREE, "rpm": RPM}
_TIME = "t is in seconds: if these are milli-, micro- or nanoseconds, divide"
_COMMAND = "commands are fractions 0..1: divide by full scale (100, 65535)"
_SPEED = "rotor speeds are in rad/s: if these are rpm, divide by 9.549"
_SIGN = "drop the sign, because rotor_spins gives the direction"
_POSITION = "positions are in metres from a point near the flight; subtract an offset"
_VELOCITY = "velocities are in m/s: if these are mm/s, divide by 1000"
_FORCE = "specific force is in m/s^2: if these are thousandths of g, multiply by 0.00980665"
_VOLTAGE = "the battery's voltage is in volts: if these are mV, divide by 1000"
_PITCH = "pitch lies within +-pi/2: if this is in degrees, divide by 57.3"
# Limits of the signals of a flight. A signal with a new unit needs a line here.
_OF_UNIT = {
    each.unit: each
    for each in (
        ColumnLimits("m", -1e6, 1e6, _POSITION, others={"cm": 0.01, "mm": 1e-3}),
        ColumnLimits("m/s", -1e3, 1e3, _VELOCITY, others={"cm/s": 0.01, "mm/s": 1e-3}),
        ColumnLimits("rad/s", -60.0, 60.0, "it looks like deg/s: divide by 57.3", others=_TURNING),
        ColumnLimits("rad", -1e4, 1e4, "it looks like degrees: divide by 57.3", others={"deg": DEGREE}),
        ColumnLimits("m/s^2", -1e3, 1e3, _FORCE, others={"g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}),
        ColumnLimits("V", -200.0, 200.0, _VOLTAGE, others={"mV": 1e-3}, zero=False),
    )
}
COLUMNS = {
    "t": ColumnLimits("s", -1e11, 1e11, _TIME, others={"ms": 1e-3, "us": 1e-6, "ns": 1e-9}),
    **dict.fromkeys(SPEED_NAMES, ColumnLimits("rad/s", 0, 1e5, _SPEED, _SIGN, others=_TURNING)),
    **dict.fromkeys(COMMAND_NAMES, ColumnLimits("of full scale", 0, 1, _COMMAND, others={"%": 0.01, PWM: 1e-3})),
    **{name: _OF_UNIT[unit] for name, unit in UNITS.items()},
}
"""The columns that a log can have: the time, the rotors, and those of the signals of a flight."""
_RIGHT_ANGLE = math.nextafter(math.pi / 2, 0)
PITCH = {"theta": ColumnLimits("rad", -_RIGHT_ANGLE, _RIGHT_ANGLE, _PITCH)}
"""The pitch of a log: one that was not read from a file may be any number."""

_RESTART = 0.1  # s; a rotor that has stopped needs longer to turn again


def dropped(t: Float[np.ndarray, " samples"], speeds: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Whether each speed is a dropout: 0, though the rotor turns too shortly before and after to have stopped."""
    out, turning, zeros = np.zeros(speeds.size, dtype=bool), np.flatnonzero(speeds > 0), np.flatnonzero(speeds == 0)
    after = np.searchsorted(turning, zeros)
    between = (after > 0) & (after < turning.size)
    zeros, after = zeros[between], after[between]
    out[zeros[t[turning[after]] - t[turning[after - 1]] < _RESTART]] = True
    return out


MAX_IMPOSSIBLE = 0.01  # the share of the values of a column that can be impossible; more are a wrong unit
MAX_SPEED_RATIO = 10.0  # the largest ratio of a rotor's speed to its 99 % quantile


def without_impossible(table: Table, limits: Mapping[str, ColumnLimits] = COLUMNS) -> Table:
    """The table without the values outside of `limits`, or `dropped`: they count as not measured.

    Raises `InputError` if a column has more than the share `MAX_IMPOSSIBLE` of such values.
    """
    columns, impossible = dict(table.columns), dict(table.impossible)
    for name, limit in limits.items():
        values, largest = columns.get(name, np.empty(0)), limit.largest
        if name in SPEED_NAMES and (values > 0).any():
            largest = min(largest, MAX_SPEED_RATIO * float(np.quantile(values[values > 0], 1 - MAX_IMPOSSIBLE)))
        beyond = (values < limit.least) | (values > largest)
        if not limit.zero and values.size:
            columns[name] = np.where(values > 0, values, np.nan)
        wrong = beyond | dropped(columns["t"], values) if name in SPEED_NAMES and values.size else beyond
        if name == "t" or not wrong.any():
            continue
        count, index = int(np.count_nonzero(beyond)), int(np.argmax(beyond if beyond.any() else wrong))
        first, every = f"{values[index]:g} {limit.unit}", np.count_nonzero(~np.isnan(values))
        if count > MAX_IMPOSSIBLE * every:
            low = values[index] < limit.least
            share = f"{count} of {every} values, more than {100 * MAX_IMPOSSIBLE:g} %"
            what = f"is {first}, beyond {limit.least if low else limit.largest:.4g} {limit.unit} ({share}); "
            advice = (low and limit.below) or table.remedy or limit.advice
            table.refuse(what + advice, index=index, column=name)
        columns[name] = np.where(wrong, np.nan, columns[name])
        before, begin = impossible.get(name, (0, f"{first} at {table.columns['t'][index]:.6g} s"))
        impossible[name] = before + int(np.count_nonzero(wrong)), begin
    return table._replace(columns=columns, impossible=impossible)


class Plausible(NamedTuple):
    """A recording in which faulty values count as not measured, and how many they are, by channel.

    - `impossible`: by channel, how many values, and the most extreme of them.
    - `clipped`: by channel, how many values are stuck at the end of the range, their share, and the end.
    """

    recording: Recording
    impossible: Mapping[str, tuple[int, float]]
    clipped: Mapping[str, tuple[int, float, float]]


def plausible(recording: Recording) -> Plausible:
    """Take out values that no sensor measured, by the other values of their channel. Rotors get the value before.

    A rotor's measured speed is taken out if it is `dropped`, too.
    """
    impossible, clipped, cleaned = {}, {}, {}
    columns = {field: [*signal.columns] for field, signal in SIGNALS.items() if not signal.is_input}
    columns["omega"] = [f"rotor {i}" for i in range(1, 5)]
    places = [(name, field, i) for field, names in columns.items() for i, name in enumerate(names)]
    for name, field, place in places:
        if getattr(recording, field) is None:
            continue
        logged = getattr(recording, field)
        column = logged.reshape(len(logged), -1)[:, place].copy()  # one at a time: a long log has 400 MB
        wrong = _among_measured(column, _isolated)
        if name.startswith("rotor") and not recording.commanded:
            wrong |= dropped(recording.time, column)
        if wrong.any():
            worst = column[wrong][np.argmax(np.abs(column[wrong]))]
            impossible[name] = int(wrong.sum()), float(worst)
            column[wrong] = np.nan
        known = np.count_nonzero(np.isfinite(column))
        for sign in (1.0, -1.0) if name in (*RATE_NAMES, *FORCE_NAMES) else ():
            stuck = _among_measured(sign * column, _stuck)
            if stuck.any():
                end, number = float(column[stuck][0]), int(stuck.sum())
                count, share, before = clipped.get(name, (0, 0.0, end))
                clipped[name] = count + number, share + number / known, max(before, end, key=abs)
                column[stuck] = np.nan
        if name in impossible or name in clipped:
            if field not in cleaned:
                cleaned[field] = logged.copy()
            cleaned[field].reshape(len(logged), -1)[:, place] = filled(column) if field == "omega" else column
    return Plausible(recording._replace(**cleaned) if cleaned else recording, impossible, clipped)


Samples = Float[np.ndarray, " samples"]
Places = Int[np.ndarray, " places"]
# The range of a channel is that from its quantile 0.005 to 0.995.
MIN_VALUES = 20  # fewer have no range


def _among_measured(values: Samples, check: Callable[[Samples], Places]) -> Bool[np.ndarray, " samples"]:
    """Whether a check finds each value. The check takes the measured values only."""
    out, known = np.zeros(values.size, dtype=bool), np.flatnonzero(np.isfinite(values))
    if known.size >= MIN_VALUES:
        out[known[check(values[known])]] = True
    return out


# A value is impossible if it lies this many times further from the median than the end of the range, and most of the
# six around it do not. Fast manoeuvres last for more than three samples.
FAR = 8.0
AROUND = np.array([-3, -2, -1, 1, 2, 3])


def _isolated(x: Samples) -> Places:
    """The values that lie far outside of the range, while most of those around them do not."""
    least, middle, most = np.quantile(x, (0.005, 0.5, 0.995))
    far = (x < middle - FAR * (middle - least)) | (x > middle + FAR * (most - middle))
    at = np.flatnonzero(far if least < most else [])
    wild = far[np.clip(at[:, None] + AROUND, 0, x.size - 1)].sum(axis=1)
    return at[wild < AROUND.size / 2]


# Values are clipped if this many are equal to the largest one, and this many times more than lie just below, within a
# share of the range. A signal without limits has a single largest value. A value that is repeated counts once.
EQUAL, TIMES, NEAR = 4, 3.0, 0.01
# With more repeated values than this, a signal is coarse, and the level below the largest counts as near. If so few
# values are most of the signal, it is at rest: they are counts of noise, and not the end of a range.
LEVELS = 10


def _stuck(x: Samples) -> Places:
    """The values that equal the largest one, if too many do to be chance."""
    none, near = np.empty(0, dtype=int), NEAR * float(np.subtract(*np.quantile(x, (0.995, 0.005))))
    top = x >= x.max() - 1e-4 * near
    if near <= 0 or top.sum() < EQUAL:
        return none
    lengths = np.diff(np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]])))
    usual = float(np.quantile(lengths, 0.9))  # samples for which a value repeats
    at_top = sum(math.ceil((end - begin) / usual) for begin, end in runs(top))
    levels, counts = np.unique(x, return_counts=True)
    if 2 * np.sort(counts)[-LEVELS:].sum() > x.size:
        return none
    levels = levels[counts > 1]
    if levels.size > LEVELS:
        near = max(near, 1.01 * float(np.median(np.diff(levels))))
    beside = np.count_nonzero(x[~top] >= x.max() - near) / usual
    return np.flatnonzero(top) if at_top >= max(EQUAL, TIMES * (beside + 1)) else none
