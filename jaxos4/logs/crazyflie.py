"""Flights in the binary logs that a Crazyflie writes to its micro-SD card, versions 1 and 2.

A file is, little-endian: 0xBC; version and number of event types (16 bit each); for each type its number (16 bit), its
name, the number of its variables (16 bit) and their names, all ended by a zero, with the type in the end, as
`gyro.x(f)`; then events, each the type's number, a time stamp (version 1: 32 bit, milliseconds; 2: 64 bit,
microseconds) and the values; then a CRC-32 of all before. Where power was lost, the checksum is missing.

Read are, from whichever event holds them:

- body rates `gyro.x, y, z` [deg/s]: their samples are the rows. Others are brought to them (`jaxos4.logs._series`).
- specific force `acc.x, y, z` [g].
- attitude `stateEstimate.roll, pitch, yaw` [deg], or `stateEstimate.qx, qy, qz, qw`.
- position and velocity `stateEstimate.x, y, z` [m], `stateEstimate.vx, vy, vz` [m/s].
- rotors: `rpm.m1..m4` [rpm], measured; or commands `motor.m1..m4`, or `pwm.m1_pwm..m4_pwm` [0..65535], held, taken
  for fractions of the airframe's `max_rotor_speed`.

The body has x forward, y left, z up, as ours, and rates follow the right hand. `stateEstimate.pitch` does not: it is
positive nose up, the firmware's legacy, so that theta is its negative; the quaternion needs no such correction.

Rotors keep the firmware's numbers (1 front right, 2 rear right, 3 rear left, 4 front left): the airframe's
`rotor_positions` and `rotor_spins` must be in the same order. `t` counts from the first sample used.

Reference: the usdlog tools and the micro-SD deck of the Crazyflie firmware.
"""

import array
import math
import os
import re
import struct
import zlib
from typing import NamedTuple

import numpy as np

from ._series import Series, covered, driving, in_order, placed
from ._table import MAX_ROWS, Table, opened_bytes, printable, quoted, refuse
from .resample import unwrap

MAGIC = b"\xbc"
_MOST_TYPES, _MOST_VARIABLES = 64, 256
_LARGEST = 1 << 28  # bytes, of a file: an hour at 1 kHz
_AT_ONCE = 1 << 20
_VARIABLE = re.compile(rb"([\x21-\x27\x2a-\x7e]{1,80})\(([bBhHiIqQefd])\)")
_DEGREE, _GRAVITY, _RPM, _FULL = math.pi / 180, 9.80665, 2 * math.pi / 60, 65535.0
_RATES = {"p": ("gyro.x", _DEGREE), "q": ("gyro.y", _DEGREE), "r": ("gyro.z", _DEGREE)}
_FORCES = {"ax": ("acc.x", _GRAVITY), "ay": ("acc.y", _GRAVITY), "az": ("acc.z", _GRAVITY)}
_TRANSLATION = {name: (f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")}
_ANGLES = {
    "phi": ("stateEstimate.roll", _DEGREE),
    "theta": ("stateEstimate.pitch", -_DEGREE),
    "psi": ("stateEstimate.yaw", _DEGREE),
}
_QUATERNION = tuple(f"stateEstimate.q{axis}" for axis in "wxyz")
_REMEDY = "the log is corrupt there: copy it again from the card, or choose another"
_AGAIN = "copy it again from the card"


class _Type(NamedTuple):
    number: int
    variables: tuple[str, ...]
    layout: np.dtype


def read_crazyflie(path: str | os.PathLike[str]) -> tuple[Table, tuple[str, ...]]:
    """The columns of a Crazyflie's log, and what was done to it; this module's docstring tells what is read.

    **Raises:** `InputError`, one line: file, variable, what is wrong and what to do.
    """
    shown = printable(os.fspath(path))
    with opened_bytes(path) as file:
        content = bytearray()
        while part := file.read(_AT_ONCE):
            content += part
            if len(content) > _LARGEST:
                refuse(shown, f"has more than {_LARGEST:,} bytes; a flight's log on a card is far smaller: give that")
    notes: list[str] = []
    events = sorted(
        _events(shown, bytes(content), notes), key=lambda event: event[0].size
    )  # of two, the faster is read
    variables = {name: (t, column) for t, columns in events for name, column in columns.items()}
    names: dict[str, str] = {}
    rates = _series(variables, _RATES, names)
    if rates is None:
        refuse(shown, "holds no body rates; add gyro.x, gyro.y and gyro.z to the deck's config.txt")
    driven, prefix = _rotors(shown, variables, names)
    inside = covered(rates.t, driven.t)
    if np.count_nonzero(inside) < 2:
        refuse(shown, "rates and motors were not logged at the same time; record both in one flight")
    rows = rates.t[inside]
    if rows.size > MAX_ROWS:
        refuse(shown, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
    columns = {"t": rows - rows[0], **dict(zip(_RATES, rates.values[inside].T, strict=True))}
    speeds = driving(rows, driven, measured=prefix == "omega")
    columns.update((f"{prefix}{i + 1}", column) for i, column in enumerate(speeds.T))
    for name, source in (*_FORCES.items(), *_TRANSLATION.items()):
        wanted = {name: source}
        series = _series(variables, wanted, names)
        if series is not None:
            columns.update(zip(wanted, placed(rows, series).T, strict=True))
    attitude = _attitude(variables, names)
    if attitude is not None:
        columns.update(zip(_ANGLES, placed(rows, attitude).T, strict=True))
    if prefix == "command":
        notes.append(f"commands are {names['command1']}.., taken for fractions of full-scale rotor speed")
    return Table(shown, columns, first_row=None, names=names, remedy=_REMEDY), tuple(notes)


def _events(path: str, content: bytes, notes: list[str]) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Times [s] and variables of each event type, whole events only."""
    types, begin, version = _types(path, content)
    sound = len(content) >= begin + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    end = len(content) - 4 if sound else len(content)
    places, left_out = _places(path, content, types, begin, end, sound=sound)
    if not sound:
        cut = f"and its last {left_out} bytes are no whole event" if left_out else "but ends with a whole event"
        notes.append(f"the log has no valid checksum, {cut}: it was cut while it was written, or is corrupt")
    data = np.frombuffer(content, dtype=np.uint8)
    scale = 1e-3 if version == 1 else 1e-6
    out = []
    for each in types:
        at = np.asarray(places[each.number], dtype=np.int64)
        if at.size < 2:
            continue
        records = data[at[:, None] + np.arange(each.layout.itemsize)].reshape(-1).view(each.layout)
        t = records["t"].astype(float) * scale
        kept = in_order(t)
        if kept is None:
            refuse(path, f"time runs backward from one event to the next: it is corrupt; {_AGAIN}")
        if not kept.all():
            notes.append(f"{np.count_nonzero(~kept)} events that came late are left out")
        with np.errstate(all="ignore"):
            values = [records[f"v{i}"][kept].astype(float) for i in range(len(each.variables))]
        values = [np.where(np.isfinite(v), v, np.nan) for v in values]
        out.append((t[kept], dict(zip(each.variables, values, strict=True))))
    if not out:
        refuse(path, "holds no events; a flight needs at least two")
    return out


def _types(path: str, content: bytes) -> tuple[list[_Type], int, int]:
    """The event types, where the events begin, and the version."""
    if len(content) < 5:
        refuse(path, f"ends within its header; {_AGAIN}")
    version, count = struct.unpack_from("<HH", content, 1)
    if content[:1] != MAGIC or version not in (1, 2):
        shown = f"is of version {version}" if content[:1] == MAGIC else "does not begin as a Crazyflie's log"
        refuse(path, f"{shown}; versions 1 and 2 are read: update jaxos4, or give another log")
    if not 0 < count <= _MOST_TYPES:
        refuse(path, f"announces {count} event types: it is corrupt; {_AGAIN}")
    types: list[_Type] = []
    at = 5
    for _ in range(count):
        number, at = _short(path, content, at)
        _, at = _text(path, content, at)
        variables, at = _short(path, content, at)
        if variables > _MOST_VARIABLES:
            refuse(path, f"announces {variables} variables in an event: it is corrupt; {_AGAIN}")
        names, kinds = [], []
        for _ in range(variables):
            text, at = _text(path, content, at)
            parts = _VARIABLE.fullmatch(text)
            if parts is None:
                shown = quoted(text.decode(errors="replace"))
                refuse(path, f"has a variable {shown} that is none: it is corrupt; {_AGAIN}")
            names.append(parts[1].decode())
            kinds.append("f2" if parts[2] == b"e" else np.dtype(parts[2].decode()).str[1:])
        if number in [each.number for each in types] or len(set(names)) < len(names):
            refuse(path, f"names an event type or a variable twice: it is corrupt; {_AGAIN}")
        stamp = "<u4" if version == 1 else "<u8"
        fields = [("number", "<u2"), ("t", stamp), *((f"v{i}", f"<{kind}") for i, kind in enumerate(kinds))]
        types.append(_Type(number, tuple(names), np.dtype(fields)))
    return types, at, version


def _places(
    path: str, content: bytes, types: list[_Type], begin: int, end: int, *, sound: bool
) -> tuple[dict[int, array.array], int]:
    """Where the events of each type begin, and how many bytes at the end are no whole one."""
    sizes = {each.number: each.layout.itemsize for each in types}
    places = {number: array.array("q") for number in sizes}
    at = begin
    while at + 2 <= end:
        number = content[at] | content[at + 1] << 8
        size = sizes.get(number)
        if size is None:
            if not sound and end - at <= 4:  # a checksum that is wrong
                break
            refuse(path, f"is corrupt at byte {at}: no event begins there; {_AGAIN}")
        if at + size > end:
            break
        places[number].append(at)
        at += size
    return places, end - at


def _short(path: str, content: bytes, at: int) -> tuple[int, int]:
    if at + 2 > len(content):
        refuse(path, f"ends within its header; {_AGAIN}")
    return content[at] | content[at + 1] << 8, at + 2


def _text(path: str, content: bytes, at: int) -> tuple[bytes, int]:
    end = content.find(b"\0", at, at + 256)
    if end < 0:
        refuse(path, f"ends within its header, or is corrupt; {_AGAIN}")
    return content[at:end], end + 1


def _series(
    variables: dict[str, tuple[np.ndarray, np.ndarray]], wanted: dict[str, tuple[str, float]], names: dict[str, str]
) -> Series | None:
    """The columns `wanted` (variable and factor), where all were logged by one event."""
    found = [variables.get(variable) for variable, _ in wanted.values()]
    times = [each[0] for each in found if each is not None]
    if len(times) < len(found) or any(t is not times[0] for t in times):
        return None
    values = [variables[variable][1] * factor for variable, factor in wanted.values()]
    names.update((column, variable) for column, (variable, _) in wanted.items())
    return Series(times[0], np.column_stack(values))


def _rotors(
    path: str, variables: dict[str, tuple[np.ndarray, np.ndarray]], names: dict[str, str]
) -> tuple[Series, str]:
    """Rotor speeds or commands, and the prefix of their columns."""
    sources = (("omega", "rpm.m{}", _RPM), ("command", "motor.m{}", 1 / _FULL), ("command", "pwm.m{}_pwm", 1 / _FULL))
    for prefix, variable, factor in sources:
        found: dict[str, str] = {}
        wanted = {f"{prefix}{i}": (variable.format(i), factor) for i in range(1, 5)}
        series = _series(variables, wanted, found)
        if series is None or (prefix == "omega" and not (series.values > 0).any(axis=0).all()):
            continue
        measured = np.isfinite(series.values).all(axis=1)
        series = Series(series.t[measured], series.values[measured])
        if series.t.size < 2:
            continue
        names.update(found)
        return (series if prefix == "omega" else Series(series.t, np.clip(series.values, 0.0, 1.0))), prefix
    refuse(path, "holds no rotor speeds or commands; add motor.m1 to motor.m4, or rpm.m1 to rpm.m4, to config.txt")


def _attitude(variables: dict[str, tuple[np.ndarray, np.ndarray]], names: dict[str, str]) -> Series | None:
    series = _series(variables, _ANGLES, names)
    if series is not None:
        angles = series.values
    else:
        series = _series(variables, {name: (name, 1.0) for name in _QUATERNION}, {})
        if series is None:
            return None
        with np.errstate(all="ignore"):
            w, x, y, z = (series.values / np.sqrt((series.values**2).sum(axis=1, keepdims=True))).T
        phi = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        theta = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        angles = np.column_stack([phi, theta, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])
        names.update(dict.fromkeys(_ANGLES, "stateEstimate.q"))
    return Series(series.t, np.column_stack([unwrap(angles[:, 0])[0], angles[:, 1], unwrap(angles[:, 2])[0]]))
