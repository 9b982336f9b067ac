"""Blackbox logs of Betaflight and INAV: `.bbl` and `.BFL` files, or CSV of `blackbox_decode` or Blackbox Explorer.

| column | column of the log | unit in the log |
| --- | --- | --- |
| `t` | `time (us)`, `time (ms)`, `time (s)`, or Explorer's `time`; 0 at the first row | as named; Explorer: us |
| `p, q, r` | `gyroUnfilt[0..2]`, or `gyroADC[0..2]` | deg/s, or as named: `(deg/s)`, `(rad/s)` |
| `ax, ay, az` | `accSmooth[0..2]` | `acc_1G` for 1 g, or as named: `(g)`, `(m/s2)` |
| `omega1..4` | `eRPM[0..3]`, measured | 100 electrical revolutions a minute |
| `command1..4` | `motor[0..3]`, if there is no `eRPM` | DShot 48..2047, or PWM 1000..2000 |
| `voltage` | `vbatLatest` of Betaflight 4, INAV's `vbat` | 0.01 V |
| `phi, theta, psi` | INAV's `attitude[0..2]` | 0.1 deg |
| `x, y, z` | INAV's `navPos[0..2]` | cm |
| `vx, vy, vz` | INAV's `navVel[0..2]` | cm/s |

The unfiltered gyro is preferred: the filters of the flight controller delay the rates by some milliseconds, which the
estimators would attribute to the vehicle. Commands count as fractions of the airframe's `max_rotor_speed`.

**Settings.** A `.bbl` or `.BFL` file holds the settings, and Explorer writes them above the header of its CSV. The
reader uses `acc_1G` (0: the accelerometer is off), `motor_poles`, `motorOutput`, `maxthrottle`, `gyro_scale` and
`blackbox_high_resolution` (rates are in tenths of a deg/s). `blackbox_decode` writes no settings: they are taken from
the `.bbl` or `.BFL` file beside the CSV, if it is there (`LOG00001.02.csv`: second session of `LOG00001.BFL`). If not,
the reader assumes 14 poles and rates in deg/s, takes 1 g from the median of the accelerometer and the protocol from the
range of the commands, and notes each of these assumptions.

**Sessions.** A vehicle writes one session each time that it is armed. The sessions of a `.bbl` or `.BFL` file follow
each other in one flight, with an unmeasured second between them.

**Frames.** Gyro and accelerometer have x forward, y left, z up, as ours: roll is positive to the right, pitch nose
down, yaw counter-clockwise seen from above. (The firmware's own telemetry has the opposite signs of pitch and yaw.)
INAV's `attitude` is roll to the right, pitch nose down, and heading clockwise from north, so psi = -heading. INAV's
`navPos` is north, east, up; ours is north, west, up.

**Rotors.** They keep the log's numbers (Betaflight's quad X: 1 rear right, 2 front right, 3 rear left, 4 front left).
The airframe's `rotor_positions` and `rotor_spins` must have the same order.

Reference: the sources of blackbox-tools, blackbox-log-viewer, Betaflight and INAV.
"""

import csv
import math
import re
from typing import NamedTuple

import numpy as np

from .blackbox_raw import MAGIC, gyro_unit, is_raw, read_sessions, settings_beside
from .csv import read_table
from .table import LogFormat, Path, Table, opened, order_note, refuse

_HEADER_MARKS = ("loopIteration", "gyroADC[0]", "motor[0]")
_MOST_SETTINGS = 5000  # lines above the header
_LONGEST_LINE = 1 << 16
_DEGREE, _GRAVITY = math.pi / 180, 9.80665
_POLES = 14
_COMMON_1G = (256, 512, 1024, 2048, 4096, 8192)
_TIMES = {"time (us)": 1e-6, "time (ms)": 1e-3, "time (s)": 1.0, "time": 1e-6}
_RATE_UNITS = {"": _DEGREE, " (deg/s)": _DEGREE, " (rad/s)": 1.0}
_FORCE_UNITS = {"": None, " (g)": _GRAVITY, " (m/s2)": 1.0, " (m/s/s)": 1.0}
_DSHOT, _PWM = (48.0, 2047.0), (1000.0, 2000.0)
_ANGLES = {"phi": _DEGREE / 10, "theta": _DEGREE / 10, "psi": -_DEGREE / 10}
_INAV = {  # column: column of the log, unit in our frame
    **{axis: (f"attitude[{i}]", unit) for i, (axis, unit) in enumerate(_ANGLES.items())},
    **{"x": ("navPos[0]", 0.01), "y": ("navPos[1]", -0.01), "z": ("navPos[2]", 0.01)},
    **{"vx": ("navVel[0]", 0.01), "vy": ("navVel[1]", -0.01), "vz": ("navVel[2]", 0.01)},
}
_VOLTAGES = {"vbatLatest": r"Betaflight ([4-9]|\d{2,})\.", "vbat": "INAV"}  # the firmware whose unit is known
_EXPORT = "export it as CSV by Blackbox Explorer"
_REMEDY = f"its unit is not the one that this reader assumes, or the log is corrupt: {_EXPORT}"
_KNOWN = (
    *_TIMES,
    *(f"{name}[{i}]{unit}" for name in ("gyroUnfilt", "gyroADC") for i in range(3) for unit in _RATE_UNITS),
    *(f"accSmooth[{i}]{unit}" for i in range(3) for unit in _FORCE_UNITS),
    *(name for name, _ in _INAV.values()),
    *_VOLTAGES,
    *(f"{name}[{i}]" for name in ("eRPM", "motor") for i in range(8)),
)


class _Log(NamedTuple):
    """A blackbox log: its own columns `raw` and `settings`, and our `columns`, the log's `names` of them, `notes`.

    `header`: the row of the CSV's header; `None` for a log that was not decoded.
    """

    path: Path
    header: int | None
    settings: dict[str, str]
    raw: dict[str, np.ndarray]
    columns: dict[str, np.ndarray]
    names: dict[str, str]
    notes: list[str]

    def add(self, column: str, name: str, values: np.ndarray) -> None:
        self.columns[column], self.names[column] = values, name

    def has(self, names: list[str]) -> bool:
        return all(name in self.raw for name in names)

    def setting(self, name: str, least: float, most: float) -> float | None:
        """A setting, or the last of several, if it is a number within these limits."""
        try:
            value = float(self.settings.get(name, "").split(",")[-1])
        except ValueError:
            return None
        return value if least <= value <= most else None


def read_blackbox(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a blackbox log, and notes on what was assumed. Raises `InputError`."""
    log, first_row = _decoded(path) if is_raw(path) else _csv(path)
    raw = log.raw
    time = next((name for name in _TIMES if name in raw), None)
    if time is None:
        refuse(path, "there is no time: export the column 'time (us)'", row=log.header)
    log.add("t", time, (raw[time] - np.nan_to_num(raw[time][0])) * _TIMES[time])
    _add_rates(log)
    _add_rotors(log)
    _add_force(log)
    for column, (name, unit) in _INAV.items():
        if name in raw:
            log.add(column, name, raw[name] * unit)
    for name, firmware in _VOLTAGES.items():
        if name in raw and re.match(firmware, log.settings.get("Firmware revision", "")):
            log.add("voltage", name, raw[name] / 100)
    log.notes.append(order_note(log.names.get("omega1", log.names.get("command1", ""))))
    return Table(path, log.columns, first_row=first_row, names=log.names, remedy=_REMEDY), tuple(log.notes)


def _decoded(path: Path) -> tuple[_Log, None]:
    """A `.bbl` or `.BFL` file."""
    raw, settings, notes = read_sessions(path, _KNOWN)
    return _Log(path, None, settings, raw, {}, {}, notes), None


def _csv(path: Path) -> tuple[_Log, int | None]:
    """A CSV, with the settings above its header, or with those of the `.bbl` or `.BFL` file beside it."""
    settings, skip = _settings(path)
    notes = []
    if not settings:
        settings, beside = settings_beside(path)
        notes += [f"settings are taken from {beside} beside it"] * bool(settings)
    table = read_table(path, _KNOWN, skip=skip, missing=("NaN", "nan"))
    raw = {name: column for name, column in table.columns.items() if not np.isnan(column).all()}
    return _Log(path, skip + 1, settings, raw, {}, {}, notes), table.first_row


def _recognises(begin: bytes) -> bool:
    lines = begin.decode("utf-8-sig", errors="replace").splitlines()
    return begin.startswith(MAGIC) or any(_is_header(line) for line in lines[:_MOST_SETTINGS])


BLACKBOX = LogFormat("blackbox", "blackbox", _recognises, read_blackbox)


def _is_header(line: str) -> bool:
    return any(mark in line for mark in _HEADER_MARKS) and line.count(",") > 2


def _settings(path: Path) -> tuple[dict[str, str], int]:
    """The settings above the header, and the number of their lines."""
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
    refuse(path, f"has no header of a blackbox log; decode it by blackbox_decode, or {_EXPORT}")


def _add_rates(log: _Log) -> None:
    for field in ("gyroUnfilt", "gyroADC"):
        for unit, factor in _RATE_UNITS.items():
            names = [f"{field}[{i}]{unit}" for i in range(3)]
            if not log.has(names):
                continue
            if unit == "":
                factor *= gyro_unit(log.settings) / (10.0 if log.setting("blackbox_high_resolution", 1, 1) else 1.0)
            if unit == "" and not log.settings:
                log.notes.append(
                    f"{field} is taken as deg/s: with blackbox_high_resolution its unit is 0.1 deg/s; give the .bbl or "
                    ".BFL file, or keep it beside this one"
                )
            for column, name in zip("pqr", names, strict=True):
                log.add(column, name, log.raw[name] * factor)
            return
    refuse(log.path, "there are no body rates, gyroADC[0..2] or gyroUnfilt[0..2]; log the gyro", row=log.header)


def _add_rotors(log: _Log) -> None:
    raw, others = log.raw, [f"{field}[{i}]" for field in ("eRPM", "motor") for i in range(4, 8)]
    if any(name in raw and np.ptp(_finite(raw[name])) > 0 for name in others):
        refuse(log.path, "has more than four motors; give the log of a quadrotor", row=log.header)
    speeds, commands = ([f"{field}[{i}]" for i in range(4)] for field in ("eRPM", "motor"))
    if log.has(speeds) and all((_finite(raw[name]) > 0).any() for name in speeds):
        poles = log.setting("motor_poles", 2, 100)
        if poles is None:
            log.notes.append(f"eRPM is turned into speeds with {_POLES} motor poles, the default: check the vehicle")
        for i, name in enumerate(speeds):
            log.add(f"omega{i + 1}", name, raw[name] * (100 / ((poles or _POLES) / 2) * 2 * math.pi / 60))
        return
    for name in commands:
        if name not in raw:
            what = "is missing; log the motors, or eRPM (bidirectional DShot)"
            refuse(log.path, what, row=log.header, column=name)
    low, high = _ends(np.column_stack([raw[name] for name in commands]), log)
    what = f"commands are motor[0..3] from {low:g} to {high:g}, taken as fractions of full-scale rotor speed"
    log.notes.append(what + ("" if log.settings else "; the protocol is assumed from their range"))
    for i, name in enumerate(commands):
        log.add(f"command{i + 1}", name, np.clip((raw[name] - low) / (high - low), 0.0, 1.0))


def _ends(values: np.ndarray, log: _Log) -> tuple[float, float]:
    """The commands at rest and at full speed: the ends of the protocol, and not the idle command."""
    finite = _finite(values)
    full = log.setting("motorOutput", 1, 65535) or log.setting("maxthrottle", 1, 65535) or 0.0
    dshot = (finite[finite > 0] < _PWM[0]).any() or max(finite.max(initial=0), full) > _PWM[1]
    return _DSHOT if dshot else _PWM


def _add_force(log: _Log) -> None:
    for unit, factor in _FORCE_UNITS.items():
        names = [f"accSmooth[{i}]{unit}" for i in range(3)]
        if not log.has(names):
            continue
        if log.setting("acc_1G", 0, 0) is not None or not any(np.ptp(_finite(log.raw[name])) for name in names):
            what = "the accelerometer is off (accSmooth does not change): switch it on, thrust is then checked"
            log.notes.append(what)
            return
        if factor is None:
            one = log.setting("acc_1G", 1, 65535)
            if one is None:
                median = float(np.nanmedian(np.sqrt(sum(log.raw[name] ** 2 for name in names))))
                one = min(_COMMON_1G, key=lambda g: abs(math.log(g / max(median, 1e-9))))
                log.notes.append(f"accSmooth is taken as {one} units for 1 g, because its median is {median:.4g}")
            factor = _GRAVITY / one
        for column, name in zip(("ax", "ay", "az"), names, strict=True):
            log.add(column, name, log.raw[name] * factor)
        return


def _finite(values: np.ndarray) -> np.ndarray:
    finite = values[np.isfinite(values)]
    return finite if finite.size else np.zeros(1)
