"""Flights in blackbox logs of Betaflight and INAV, as CSV: by `blackbox_decode`, or exported by Blackbox Explorer.

Read are:

- time: `time (us)` (or `(ms)`, `(s)`); Explorer's `time` is in microseconds. `t` counts from the first row.
- body rates: `gyroUnfilt[0..2]`, or where it was not logged `gyroADC[0..2]` [deg/s, or as the name says: `(deg/s)`,
  `(rad/s)`]. The unfiltered signal is preferred: the flight controller's filters delay by some milliseconds, which
  would be taken for a lag of the vehicle.
- specific force: `accSmooth[0..2]`, in `acc_1G` units a g (or `(g)`, `(m/s2)` in the name).
- rotors: `eRPM[0..3]`, measured, in units of 100 electrical revolutions a minute; otherwise commands `motor[0..3]`
  from the idle to the full end of their protocol (DShot 48..2047 or PWM 1000..2000), taken for fractions of the
  airframe's `max_rotor_speed`.
- INAV: `attitude[0..2]` [0.1 deg], `navPos[0..2]` [cm], `navVel[0..2]` [cm/s].

Explorer writes the log's settings above the header: `acc_1G`, `motor_poles`, `motorOutput`, `minthrottle`,
`maxthrottle`, `blackbox_high_resolution` (rates are ten times finer) are taken from there. `blackbox_decode` writes
none: then 14 poles, 1 g from the accelerometer's median, the protocol from the commands' range, and coarse rates are
assumed, and it is said.

The gyro and the accelerometer have x forward, y left, z up, as ours: roll is positive to the right, pitch nose down,
yaw counter-clockwise seen from above (the firmware's own telemetry negates pitch and yaw to forward, right, down).
INAV's `attitude` is roll to the right, pitch nose down, and heading clockwise from north: psi = -heading. Its `navPos`
is north, east, up: ours is north, west, up.

Rotors keep the log's order (Betaflight's quad X: 1 rear right, 2 front right, 3 rear left, 4 front left): the
airframe's `rotor_positions` and `rotor_spins` must be in the same order.

Reference: the sources of blackbox-tools, blackbox-log-viewer, Betaflight and INAV.
"""

import csv
import math
import os
from collections.abc import Mapping

import numpy as np

from ._table import Table, opened, printable, read_table, refuse

_HEADER_MARKS = ("loopIteration", "gyroADC[0]", "motor[0]")
_MOST_SETTINGS = 5000  # lines above the header
_LONGEST_LINE = 1 << 16
_DEGREE = math.pi / 180
_GRAVITY = 9.80665
_POLES = 14
_COMMON_1G = (256, 512, 1024, 2048, 4096, 8192)
_TIMES = {"time (us)": 1e-6, "time (ms)": 1e-3, "time (s)": 1.0, "time": 1e-6}
_RATE_UNITS = {"": _DEGREE, " (deg/s)": _DEGREE, " (rad/s)": 1.0}
_FORCE_UNITS = {"": None, " (g)": _GRAVITY, " (m/s2)": 1.0, " (m/s/s)": 1.0}
_DSHOT, _PWM = (48.0, 2047.0), (1000.0, 2000.0)
_REMEDY = "the units are not those this reader takes them for, or the log is broken: export it by Blackbox Explorer"
_PLAIN = tuple(f"{name}[{i}]" for name in ("attitude", "navPos", "navVel") for i in range(3))
_ROTORS = tuple(f"{name}[{i}]" for name in ("eRPM", "motor") for i in range(8))
_KNOWN = (
    *_TIMES,
    *(f"{name}[{i}]{unit}" for name in ("gyroUnfilt", "gyroADC") for i in range(3) for unit in _RATE_UNITS),
    *(f"accSmooth[{i}]{unit}" for i in range(3) for unit in _FORCE_UNITS),
    *_PLAIN,
    *_ROTORS,
)


def is_blackbox(start: str) -> bool:
    """Whether a file that begins so is a blackbox log in CSV."""
    return any(_is_header(line) for line in start.splitlines()[:_MOST_SETTINGS])


def read_blackbox(path: str | os.PathLike[str]) -> tuple[Table, tuple[str, ...]]:
    """The columns of a blackbox log, and what was assumed of it; this module's docstring tells what is read.

    **Raises:** `InputError`, one line: file, row, column, what is wrong and what to do.
    """
    shown = printable(os.fspath(path))
    settings, skip = _settings(path, shown)
    table = read_table(path, _KNOWN, skip=skip, missing=("NaN", "nan"))
    raw = {name: column for name, column in table.columns.items() if not np.isnan(column).all()}
    notes: list[str] = []
    columns: dict[str, np.ndarray] = {}
    names: dict[str, str] = {}
    time = next((name for name in _TIMES if name in raw), None)
    if time is None:
        refuse(shown, "there is no time: export the column 'time (us)'")
    columns["t"], names["t"] = (raw[time] - np.nan_to_num(raw[time][0])) * _TIMES[time], time
    _add_rates(shown, raw, settings, columns, names, notes)
    _add_rotors(table, raw, settings, columns, names, notes)
    _add_force(raw, settings, columns, names, notes)
    for i, (name, sign) in enumerate((("phi", 1), ("theta", 1), ("psi", -1))):
        if f"attitude[{i}]" in raw:
            columns[name], names[name] = sign * raw[f"attitude[{i}]"] * 0.1 * _DEGREE, f"attitude[{i}]"
    for i, (name, sign) in enumerate((("x", 1), ("y", -1), ("z", 1))):
        for field, column in (("navPos", name), ("navVel", f"v{name}")):
            if f"{field}[{i}]" in raw:
                columns[column], names[column] = sign * raw[f"{field}[{i}]"] / 100, f"{field}[{i}]"
    notes.append(
        f"rotors keep the log's order ({names.get('omega1', names.get('command1'))} is rotor 1): rotor_positions and "
        "rotor_spins must be in the same order"
    )
    table = table._replace(columns=columns, unknown=(), names=names, remedy=_REMEDY)
    return table, tuple(notes)


def _is_header(line: str) -> bool:
    return any(mark in line for mark in _HEADER_MARKS) and line.count(",") > 2


def _settings(path: str | os.PathLike[str], shown: str) -> tuple[dict[str, str], int]:
    """What stands above the header, and how many lines that is."""
    settings: dict[str, str] = {}
    with opened(path) as file:
        for number in range(_MOST_SETTINGS):
            line = file.readline(_LONGEST_LINE)
            if _is_header(line):
                return settings, number
            if not line:
                break
            try:
                cells = next(csv.reader([line.rstrip("\n")]), [])
            except csv.Error:
                continue
            if len(cells) > 1:
                settings.setdefault(cells[0].strip(), ",".join(cells[1:]).strip())
    refuse(shown, "has no header of a blackbox log; decode it by blackbox_decode, or export it by Blackbox Explorer")


def _number(settings: Mapping[str, str], name: str, least: float, most: float) -> float | None:
    """A setting that is a number and can be one of its kind."""
    try:
        value = float(settings.get(name, ""))
    except ValueError:
        return None
    return value if least <= value <= most else None


def _add_rates(
    path: str,
    raw: dict[str, np.ndarray],
    settings: Mapping[str, str],
    columns: dict[str, np.ndarray],
    names: dict[str, str],
    notes: list[str],
) -> None:
    for field in ("gyroUnfilt", "gyroADC"):
        for unit, factor in _RATE_UNITS.items():
            fields = [f"{field}[{i}]{unit}" for i in range(3)]
            if not all(name in raw for name in fields):
                continue
            fine = 10.0 if unit == "" and _number(settings, "blackbox_high_resolution", 1, 1) else 1.0
            if unit == "" and not settings:
                notes.append(
                    f"{field} is taken for deg/s: with blackbox_high_resolution it would be ten times that, and only "
                    "Blackbox Explorer's export says so"
                )
            for column, name in zip("pqr", fields, strict=True):
                columns[column], names[column] = raw[name] * factor / fine, name
            return
    refuse(path, "holds no body rates: gyroADC[0..2] or gyroUnfilt[0..2] is missing; log the gyro")


def _add_rotors(
    table: Table,
    raw: dict[str, np.ndarray],
    settings: Mapping[str, str],
    columns: dict[str, np.ndarray],
    names: dict[str, str],
    notes: list[str],
) -> None:
    for field in ("eRPM", "motor"):
        if any(f"{field}[{i}]" in raw and np.ptp(_seen(raw[f"{field}[{i}]"])) > 0 for i in range(4, 8)):
            refuse(table.path, "has more than four motors; this library knows four: no quadrotor's log")
    speeds, commands = ([f"{field}[{i}]" for i in range(4)] for field in ("eRPM", "motor"))
    if all(name in raw and (_seen(raw[name]) > 0).any() for name in speeds):
        poles = _number(settings, "motor_poles", 2, 100)
        if poles is None:
            notes.append(f"eRPM is turned into speeds with {_POLES} motor poles, the default: check the vehicle's")
        factor = 100 / ((poles or _POLES) / 2) * 2 * math.pi / 60
        for i, name in enumerate(speeds):
            columns[f"omega{i + 1}"], names[f"omega{i + 1}"] = raw[name] * factor, name
        return
    lacking = next((name for name in commands if name not in raw), None)
    if lacking is not None:
        refuse(table.path, f"there is no {lacking} in it; log the motors, or eRPM (bidirectional DShot)")
    values = np.column_stack([raw[name] for name in commands])
    low, high = _ends(values, settings)
    notes.append(
        f"commands are motor[0..3] from {low:g} to {high:g}, taken for fractions of full-scale rotor speed"
        + ("" if settings else "; the ends are told by their range")
    )
    for i, name in enumerate(commands):
        columns[f"command{i + 1}"] = np.clip((values[:, i] - low) / (high - low), 0.0, 1.0)
        names[f"command{i + 1}"] = name


def _ends(values: np.ndarray, settings: Mapping[str, str]) -> tuple[float, float]:
    """What stands for a rotor at rest and at full speed: the protocol's ends, not those of idle."""
    seen = _seen(values)
    high = settings.get("motorOutput", "").split(",")[-1]
    full = _number({"high": high}, "high", 1, 65535) or _number(settings, "maxthrottle", 1, 65535)
    if (seen[seen > 0] < _PWM[0]).any() or seen.max(initial=0) > _PWM[1] or (full or 0) > _PWM[1]:
        return _DSHOT
    return _PWM


def _add_force(
    raw: dict[str, np.ndarray],
    settings: Mapping[str, str],
    columns: dict[str, np.ndarray],
    names: dict[str, str],
    notes: list[str],
) -> None:
    for unit, factor in _FORCE_UNITS.items():
        fields = [f"accSmooth[{i}]{unit}" for i in range(3)]
        if not all(name in raw for name in fields):
            continue
        if factor is None:
            one = _number(settings, "acc_1G", 1, 65535)
            if one is None:
                median = float(np.nanmedian(np.sqrt(sum(raw[name] ** 2 for name in fields))))
                one = min(_COMMON_1G, key=lambda g: abs(math.log(g / max(median, 1e-9))))
                notes.append(f"accSmooth is taken for {one} units a g, as its median of {median:.4g} suggests")
            factor = _GRAVITY / one
        for column, name in zip(("ax", "ay", "az"), fields, strict=True):
            columns[column], names[column] = raw[name] * factor, name
        return


def _seen(values: np.ndarray) -> np.ndarray:
    seen = values[np.isfinite(values)]
    return seen if seen.size else np.zeros(1)
