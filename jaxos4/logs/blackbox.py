"""Blackbox logs of Betaflight, INAV and Indiflight: `.bbl`, `.BFL`, or CSV of `blackbox_decode` or Blackbox Explorer.

Columns, settings and frames: docs/logs.md. Reference: the sources of blackbox-tools, blackbox-log-viewer, Betaflight
and INAV.
"""

import contextlib
import csv
import dataclasses
import itertools
import math
import re
import struct

import numpy as np

from ..airframe import STANDARD_GRAVITY
from ..errors import counted
from ..flight import ANGLE_NAMES, COMMAND_NAMES, FORCE_NAMES, RATE_NAMES, SPEED_NAMES
from ..rotations import HALF_TURN, euler_angles
from .blackbox_frames import BadHeader, decode_frames
from .csv import read_table
from .sampling import in_order
from .table import LogFormat, LogPath, Table, items, opened, order_note, read_bytes, refuse
from .values import DEGREE, RPM

_MAGIC = b"H Product:Blackbox"
_HEADER_MARKS = ("loopIteration", "gyroADC[0]", "motor[0]")
_LONGEST_HEADER = 5000, 1 << 16  # lines of settings, and characters of one
_NONE = np.zeros(0)
_UNITS = {  # of `blackbox_decode`, behind the name of a field
    "time": {"us": 1e-6, "ms": 1e-3, "s": 1.0},
    "gyroADC": {"deg/s": DEGREE, "rad/s": 1.0},
    "accSmooth": {"g": STANDARD_GRAVITY, "m/s/s": 1.0, "m/s2": 1.0},
}
_GYROS = ("gyroUnfilt", "gyroADCafterRpm", "gyroADC")
_GYRO_SCALES = ("gyro.scale", "gyro_scale", "gyroScale")  # of Cleanflight, of its successors, in Explorer's exports
_SPEEDS = ("omegaUnfiltered", "omega", "eRPM")  # of Indiflight in rad/s
_ATTITUDES = {"quat": 4, "imuQuaternion": 3, "attitude": 3}  # of Indiflight, Betaflight, INAV: this many numbers
_POLES = 14  # of the magnets of a motor, by default
_DSHOT, _PWM = (48.0, 2047.0), (1000.0, 2000.0)
_BETWEEN = 1.0  # s; from one session to the next
_VOLTAGE, _KNOWN_UNIT = "vbatLatest", re.compile(r"Betaflight ([4-9]|\d{2,})\.")
_EXPORT = "export it as CSV by Blackbox Explorer"
_DECODE = "decode it by blackbox_decode (of blackbox-tools), and give its CSV"
_REMEDY = f"its unit is not the one that this reader assumes, or the log is corrupt: {_EXPORT}"
_RAW = (
    "time",
    *(each for name in (*_GYROS, "accSmooth") for each in items(name, 3)),
    *(each for name, count in _ATTITUDES.items() for each in items(name, count)),
    _VOLTAGE,
    *(each for name in (*_SPEEDS, "motor") for each in items(name, 8)),
)
_CONVERTED = {
    f"{name} ({unit})": (name, factor)
    for name in _RAW
    for unit, factor in _UNITS.get(name.partition("[")[0], {}).items()
}
# Sessions follow the longest one if these settings are equal.
_USED = (*_GYRO_SCALES, "acc_1G", "blackbox_high_resolution", "maxthrottle", "motorOutput", "motor_poles")

Settings = dict[str, str]
Columns = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class _Log:
    """A blackbox log: its columns `raw` and its `settings`; our `columns` and their `names` in the log; `notes`.

    - `header`: the row of the CSV's header; `None` for a log that was not decoded.
    - `converted`: the whole name ("gyroADC[0] (deg/s)") and the unit of columns that `blackbox_decode` has converted.
    """

    path: LogPath
    settings: Settings
    raw: Columns
    header: int | None = None
    converted: dict[str, tuple[str, float]] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    columns: Columns = dataclasses.field(default_factory=dict)
    names: dict[str, str] = dataclasses.field(default_factory=dict)

    def add(self, names: dict[str, str], factor: float) -> None:
        """Add columns, by the log's names of them. `factor`: of raw values."""
        for column, name in names.items():
            self.names[column], unit = self.converted.get(name, (name, factor))
            self.columns[column] = self.raw[name] * unit

    def setting(self, name: str, least: float, most: float) -> float | None:
        """A setting, or the last of several, if it is a number within these limits. 0x: the bits of a float."""
        text = self.settings.get(name, "").split(",")[-1].strip()
        try:
            bits = re.fullmatch("0x([0-9a-fA-F]{8})", text)
            value = struct.unpack(">f", bytes.fromhex(bits[1]))[0] if bits else float(text)
        except ValueError:
            return None
        return value if least <= value <= most else None


def read_blackbox(path: LogPath) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a blackbox log, and notes on what was assumed. Raises `InputError`."""
    with opened(path, "rb") as file:
        is_raw = file.seekable() and file.read(len(_MAGIC)) == _MAGIC
    if is_raw:
        log = _decoded(path)
    else:
        settings, skip = _settings_above(path)
        columns = read_table(path, (*_RAW, *_CONVERTED), skip=skip, missing=("NaN", "nan")).columns
        logged = {name: column for name, column in columns.items() if not np.isnan(column).all()}
        converted = {own: (name, unit) for name, (own, unit) in _CONVERTED.items() if name in logged}
        raw = logged | {own: logged[name] for own, (name, _) in converted.items()}
        log = _Log(path, settings, raw, skip + 1, converted)
    raw, first_row = log.raw, None if log.header is None else log.header + 1
    if "time" not in raw:
        refuse(path, "there is no time: export the column 'time (us)'", row=log.header)
    raw["time"] = raw["time"] - np.nan_to_num(raw["time"][0])
    log.add({"t": "time"}, 1e-6)
    _add_rates(log)
    _add_rotors(log)
    _add_force(log)
    _add_attitude(log)
    newer = any(log.names.get(name, "").startswith(("omega", "quat")) for name in ("omega1", "phi"))
    if newer and np.median(_finite(log.columns.get("az", _NONE))) < 0:  # Indiflight: forward, right, down
        log.columns.update((name, -log.columns[name]) for name in ("q", "r", "ay", "az"))
        what = "the specific force in flight points down: gyro and accelerometer count as forward, right, down"
        log.notes.append(what)
    if _VOLTAGE in raw and _KNOWN_UNIT.match(log.settings.get("Firmware revision", "")):
        log.add({"voltage": _VOLTAGE}, 1.0)
        log.columns["voltage"] /= 100
    log.notes.append(order_note(log.names.get("omega1", log.names.get("command1", ""))))
    return Table(path, log.columns, first_row=first_row, names=log.names, remedy=_REMEDY), tuple(log.notes)


def _recognises(begin: bytes) -> bool:
    lines = begin.decode("utf-8-sig", errors="replace").splitlines()
    return begin.startswith(_MAGIC) or any(_is_header(line) for line in lines[: _LONGEST_HEADER[0]])


BLACKBOX = LogFormat("blackbox", "blackbox", _recognises, read_blackbox)


def _is_header(line: str) -> bool:
    return any(mark in line for mark in _HEADER_MARKS) and line.count(",") > 2


def _settings_above(path: LogPath) -> tuple[Settings, int]:
    """The settings above the header, and the number of their lines."""
    settings: Settings = {}
    with opened(path) as file:
        for number in range(_LONGEST_HEADER[0]):
            line = file.readline(_LONGEST_HEADER[1])
            if _is_header(line):
                return settings, number
            if not line:
                break
            with contextlib.suppress(csv.Error):
                name, *values = next(csv.reader([line.rstrip("\n")]), ()) or ("",)  # of a blank line, csv makes []
                if values:
                    settings.setdefault(name.strip(), ",".join(values).strip())
    refuse(path, f"has no header of a blackbox log; decode it by blackbox_decode, or {_EXPORT}")


def _decoded(path: LogPath) -> _Log:
    """A `.bbl` or `.BFL` file: all sessions, one after the other. Raises `InputError`."""
    notes: list[str] = []
    found: list[tuple[Settings, Columns]] = []
    content = read_bytes(path, 1 << 29)  # more than an hour of flight
    places = [match.start() for match in re.finditer(_MAGIC, content)]
    for number, (begin, end) in enumerate(itertools.pairwise([*places, len(content)]), start=1):
        settings, columns, remark = _session(content[begin:end])
        if remark:
            notes.append((f"session {number}: " if len(places) > 1 else "") + remark)
        if columns is not None:
            found.append((settings, columns))
    if not found:
        why = f" ({notes[0]})" if notes else ""
        refuse(path, f"no frame of it can be decoded{why}: it is corrupt, or of another kind; {_DECODE}")
    longest = max(found, key=lambda each: each[1]["time"][-1])[0]
    same = [columns for settings, columns in found if all(settings.get(u) == longest.get(u) for u in _USED)]
    if len(same) < len(found):
        other = f"{len(found) - len(same)} of {len(found)}"
        notes.append(f"{other} sessions are ignored: their settings are not those of the longest one")
    if len(same) > 1:
        lengths = ", ".join(f"{columns['time'][-1] / 1e6:.1f}" for columns in same)
        notes.append(f"{len(same)} sessions, of {lengths} s, follow each other with {_BETWEEN:g} s between them")
    begin = 0.0
    for columns in same:
        columns["time"] += begin
        begin = columns["time"][-1] + 1e6 * _BETWEEN
    joined = {name: np.concatenate([columns[name] for columns in same]) for name in set.intersection(*map(set, same))}
    return _Log(path, longest, joined, notes=notes)


def _session(content: bytes) -> tuple[Settings, Columns | None, str]:
    """The settings and the columns of one session with the time from 0, or `None`, and a remark on what is lost.

    Its header ends before a line that has no `H `, or is not text.
    """
    settings, at = {}, 0
    while content.startswith(b"H ", at):
        stop = content.find(b"\n", at, at + _LONGEST_HEADER[1])
        line = content[at:stop]
        if stop < 0 or not line.isascii():
            break
        name, _, value = line[2:].decode().partition(":")
        settings.setdefault(name.strip(), value.strip())
        at = stop + 1
    try:
        columns, damaged, ended = decode_frames(settings, content[at:], _RAW)
    except BadHeader as error:
        return settings, None, f"{error}: it is ignored"
    later = in_order(columns["time"])
    if later is None or np.count_nonzero(later) < 2:
        return settings, None, "holds no frames that can be decoded: it is ignored"
    damage = f"is damaged in {counted(damaged, 'place')}; what follows up to the next complete frame is ignored"
    end = "has no end: it was cut while it was written, or is corrupt"
    remarks = [damage] * (damaged > 0) + [end] * (not ended)
    return settings, {name: column[later] for name, column in columns.items()}, "; ".join(remarks)


def _add_rates(log: _Log) -> None:
    field = next((name for name in _GYROS if log.raw.keys() >= {*items(name, 3)}), None)
    if field is None:
        refuse(log.path, "there are no body rates, gyroADC[0..2] or gyroUnfilt[0..2]; log the gyro", row=log.header)
    names = dict(zip(RATE_NAMES, items(field, 3), strict=True))
    if not log.settings and names["p"] not in log.converted:
        fine = "with blackbox_high_resolution its unit is 0.1 deg/s; give the .bbl or .BFL file"
        log.notes.append(f"{field} is taken as deg/s: {fine}")
    unit = DEGREE  # of one count; the setting is in deg/s, or, of Baseflight and in exports, in rad/us
    for name in reversed(_GYRO_SCALES):  # the first name has precedence
        if (scale := log.setting(name, 1e-3, 10)) is not None:
            unit = scale * DEGREE
        elif (scale := log.setting(name, 1e-11, 1e-6)) is not None:
            unit = scale * 1e6
    log.add(names, unit / (10.0 if log.setting("blackbox_high_resolution", 1, 1) else 1.0))


def _add_rotors(log: _Log) -> None:
    raw = log.raw
    more = (each for name in (*_SPEEDS, "motor") for each in items(name, 8)[4:])
    if any(np.ptp(_finite(raw[name])) > 0 for name in more if name in raw):
        refuse(log.path, "has more than four motors; give the log of a quadrotor", row=log.header)
    every = {field: items(field, 4) for field in (*_SPEEDS, "motor")}
    commands = every.pop("motor")
    turning = (f for f, names in every.items() if all((_finite(raw.get(name, _NONE)) > 0).any() for name in names))
    if (field := next(turning, None)) is not None:
        poles = log.setting("motor_poles", 2, 100)
        if field == "eRPM" and poles is None:
            log.notes.append(f"eRPM is turned into speeds with {_POLES} motor poles, the default: check the vehicle")
        unit = 100 / ((poles or _POLES) / 2) * RPM if field == "eRPM" else 1.0
        log.add(dict(zip(SPEED_NAMES, every[field], strict=True)), unit)
        return
    for name in commands:
        if name not in raw:
            what = "is missing; log the motors, or eRPM (bidirectional DShot)"
            refuse(log.path, what, row=log.header, column=name)
    # The ends of the protocol, and not the idle command.
    values = _finite(np.concatenate([raw[name] for name in commands]))
    full = log.setting("motorOutput", 1, 65535) or log.setting("maxthrottle", 1, 65535) or 0.0
    dshot = (values[values > 0] < _PWM[0]).any() or max(values.max(), full) > _PWM[1]
    low, high = _DSHOT if dshot else _PWM
    what = f"commands are motor[0..3] from {low:g} to {high:g}, taken as fractions of full-scale rotor speed"
    log.notes.append(what + ("" if log.settings else "; the protocol is assumed from their range"))
    log.add(dict(zip(COMMAND_NAMES, commands, strict=True)), 1.0)
    log.columns.update((name, np.clip((log.columns[name] - low) / (high - low), 0.0, 1.0)) for name in COMMAND_NAMES)


def _add_force(log: _Log) -> None:
    names = items("accSmooth", 3)
    if not log.raw.keys() >= set(names):
        return
    if log.setting("acc_1G", 0, 0) is not None or not any(np.ptp(_finite(log.raw[name])) for name in names):
        log.notes.append("the accelerometer is off (accSmooth does not change): switch it on, thrust is then checked")
        return
    one = log.setting("acc_1G", 1, 65535)
    if one is None and names[0] not in log.converted:
        median = float(np.nanmedian(np.sqrt(sum(log.raw[name] ** 2 for name in names))))
        one = min((256, 512, 1024, 2048, 4096, 8192), key=lambda g: abs(math.log(g / max(median, 1e-9))))
        log.notes.append(f"accSmooth is taken as {one} units for 1 g, because its median is {median:.4g}")
    log.add(dict(zip(FORCE_NAMES, names, strict=True)), STANDARD_GRAVITY / (one or 1))


def _add_attitude(log: _Log) -> None:
    """Roll, pitch and yaw, if the log holds an attitude. That of Indiflight has y to the right and z down."""
    for field, count in _ATTITUDES.items():
        names = items(field, count)
        if log.raw.keys() >= {*names} and any(np.ptp(_finite(log.raw[name])) for name in names):
            break
    else:
        return
    values = np.column_stack([log.raw[name] for name in names])
    if field == "quat":
        angles = euler_angles(values) * HALF_TURN
    elif field == "imuQuaternion":
        vector = values / 0x7FFF
        angles = euler_angles(np.column_stack([np.sqrt(np.maximum(1 - (vector**2).sum(axis=1), 0.0)), vector]))
    else:
        angles = values * DEGREE / 10 * [1, 1, -1]
    log.names.update(dict.fromkeys(ANGLE_NAMES, field))
    log.columns.update(zip(ANGLE_NAMES, angles.T, strict=True))


def _finite(values: np.ndarray) -> np.ndarray:
    finite = values[np.isfinite(values)]
    return finite if finite.size else np.zeros(1)
