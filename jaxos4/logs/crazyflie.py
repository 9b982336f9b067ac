"""Logs of the Crazyflie's micro-SD card: versions 1 and 2, and that of 2019. Variables, frames, file: docs/logs.md.

Reference: the usdlog tools and the micro-SD deck of the Crazyflie firmware.
"""

import array
import math
import re
import zlib

import numpy as np

from ..airframe import STANDARD_GRAVITY
from .sampling import Series, gyro_rows, in_order, logged_rate, unwrapped
from .table import LogFacts, LogFormat, Path, Sampling, Table, counted, needed, quoted, read_bytes, refuse

_MAGIC = b"\xbc"
_MOST_TYPES, _MOST_VARIABLES = 64, 256
_LARGEST = 1 << 28  # bytes of a file: an hour at 1 kHz
_PAIR = re.compile(rb"(..)(..)", re.DOTALL)
_TYPE = re.compile(rb"(..)[^\0]{0,255}\0(..)", re.DOTALL)
_NAME = re.compile(rb"([^\0]{0,255})\0")
_VARIABLE = re.compile(rb"([\x21-\x27\x2a-\x7e]{1,80})\(([bBhHiIqQefd])\)")
_SETS = re.compile(rb"(.)(tick\(I\),(?:[\x20-\x27\x2a\x2b\x2d-\x7e]{1,80}\([bBhHiIqQefd]\),){1,255})", re.DOTALL)
_DEGREE, _RPM, _FULL = math.pi / 180, 2 * math.pi / 60, 65535.0
_RATES = {"p": ("gyro.x", _DEGREE), "q": ("gyro.y", _DEGREE), "r": ("gyro.z", _DEGREE)}
_OTHERS = {  # each is read by itself
    **{name: (f"acc.{name[1]}", STANDARD_GRAVITY) for name in ("ax", "ay", "az")},
    **{name: (f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")},
    "voltage": ("pm.vbat", 1.0),
}
_ANGLES = {
    "phi": ("stateEstimate.roll", _DEGREE),
    "theta": ("stateEstimate.pitch", -_DEGREE),
    "psi": ("stateEstimate.yaw", _DEGREE),
}
_ROTORS = (("omega", "rpm.m{}", _RPM), ("command", "motor.m{}", 1 / _FULL), ("command", "pwm.m{}_pwm", 1 / _FULL))
_AGAIN = "copy it again from the card"
_REMEDY = f"the log is corrupt there: {_AGAIN}, or choose another"
_OFTEN = "raise the frequency of these variables in the deck's config.txt, and fly again"
_NO_VARIABLES = (" number", " t", "tick")
_DAMAGED = f"it is corrupt; {_AGAIN}"

Variables = dict[str, tuple[np.ndarray, np.ndarray]]
Types = dict[int, np.dtype]
Samples = tuple[str, np.ndarray, np.ndarray]


def read_crazyflie(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a Crazyflie's log, and notes on what was assumed. Raises `InputError`."""
    notes: list[str] = []
    names: dict[str, str] = {}
    variables = _variables(path, notes)
    remedy = "add gyro.x, gyro.y and gyro.z to the deck's config.txt"
    rates = needed(path, _series(variables, _RATES, names), "body rates", remedy)
    remedy = "add motor.m1 to motor.m4, or rpm.m1 to rpm.m4, to config.txt"
    rotors, first = needed(path, _rotors(variables, names), "rotor speeds or commands", remedy)
    angles = _series(variables, _ANGLES, names)
    others = {tuple(_ANGLES): None if angles is None else unwrapped(angles.t, angles.values)}
    others |= {(name,): _series(variables, {name: source}, names) for name, source in _OTHERS.items()}
    if first == "command1":
        notes.append(f"commands are {names[first]}.., taken as fractions of full-scale rotor speed")
    motors, gyro = (Sampling(names[name], logged_rate(each.t)) for name, each in ((first, rotors), ("p", rates)))
    table = Table(path, {}, first_row=None, names=names, remedy=_REMEDY, facts=LogFacts(motors, gyro, _OFTEN))
    return gyro_rows(table, rates, rotors, measured=first == "omega1", others=others)[1], tuple(notes)


CRAZYFLIE = LogFormat(
    "Crazyflie",
    "Crazyflie micro-SD log",
    lambda begin: begin.startswith(_MAGIC) or _SETS.match(begin) is not None,
    read_crazyflie,
)


def _variables(path: Path, notes: list[str]) -> Variables:
    """Times [s] and values of each variable, from the event that holds the most of its samples."""
    content = read_bytes(path, _LARGEST)
    found = _sets(path, content, notes) if content[:1] != _MAGIC else _events(path, content, notes)
    if not found:
        refuse(path, "holds no events; a flight needs at least two")
    return {name: (t, values) for name, t, values in sorted(found, key=lambda each: each[1].size)}


def _events(path: Path, content: bytes, notes: list[str]) -> list[Samples]:
    """The variables of the events of versions 1 and 2."""
    types, version, at = _types(path, content)
    valid = len(content) >= at + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    places, ignored = _places(path, content[: -4 if valid else None], types, at, valid=valid)
    if not valid:
        cut = f"and its last {ignored} bytes are not a complete event" if ignored else "but ends with a complete event"
        notes.append(f"the log has no valid checksum, {cut}: it was cut while it was written, or is corrupt")
    data, found = np.frombuffer(content, dtype=np.uint8), []
    for number, layout in types.items():
        at = np.asarray(places[number], dtype=np.int64)
        if at.size < 2:
            continue
        records = data[at[:, None] + np.arange(layout.itemsize)].reshape(-1).view(layout)
        found += _samples(path, records, records[" t"] * (1e-3 if version == 1 else 1e-6), notes)
    return found


def _samples(path: Path, records: np.ndarray, t: np.ndarray, notes: list[str]) -> list[Samples]:
    """The variables of records at the times `t` [s]. Raises `InputError`."""
    kept = in_order(t)
    if kept is None:
        refuse(path, f"time runs backward from one event to the next: {_DAMAGED}")
    if not kept.all():
        notes.append(f"{np.count_nonzero(~kept)} late events are ignored")
    t, found = t[kept], []
    for name in (name for name in records.dtype.names or () if name not in _NO_VARIABLES):
        with np.errstate(all="ignore"):
            values = records[name][kept].astype(float)
        found.append((name, t, np.where(np.isfinite(values), values, np.nan)))
    return found


def _sets(path: Path, content: bytes, notes: list[str]) -> list[Samples]:
    """The variables of the format of 2019: names, then blocks of data sets, each with the inverse of its CRC-32."""
    match = _SETS.match(content)
    parts = [] if match is None else [_VARIABLE.fullmatch(text.strip()) for text in match[2].split(b",")[:-1]]
    fields = [(part[1].decode(), "<f2" if part[2] == b"e" else f"<{part[2].decode()}") for part in parts if part]
    if match is None or not len(parts) == len(fields) == len(dict(fields)) == match[1][0]:
        refuse(path, f"does not describe its variables: {_DAMAGED}")
    layout, at, good, bad = np.dtype(fields), match.end() + 4, [], 0
    while at < len(content):
        end = at + 1 + content[at] * layout.itemsize
        whole = zlib.crc32(content[at:end]) ^ 0xFFFFFFFF == int.from_bytes(content[end : end + 4], "little")
        good += [content[at + 1 : end]] * whole
        bad += not whole
        at = end + 4
    if bad:
        notes.append(f"{counted(bad, 'block')} of the log with a wrong checksum are ignored: they are cut or corrupt")
    records = np.frombuffer(b"".join(good), layout)
    return _samples(path, records, records["tick"] * 1e-3, notes) if records.size > 1 else []


def _types(path: Path, content: bytes) -> tuple[Types, int, int]:
    """The layout of each type of events by its number, the version, and the number of bytes of the header."""
    at = 1

    def take(pattern: re.Pattern[bytes]) -> tuple[bytes, ...]:
        nonlocal at
        match = pattern.match(content, at)
        if match is None:
            refuse(path, f"ends within its header, or is corrupt; {_AGAIN}")
        at = match.end()
        return match.groups()

    version, count = (int.from_bytes(each, "little") for each in take(_PAIR))
    if version not in (1, 2):
        refuse(path, f"is of version {version}, not 1 or 2; update jaxos4, or give another log")
    if not 0 < count <= _MOST_TYPES:
        refuse(path, f"announces {count} event types: {_DAMAGED}")
    types: Types = {}
    for _ in range(count):
        number, size = (int.from_bytes(each, "little") for each in take(_TYPE))
        if size > _MOST_VARIABLES:
            refuse(path, f"announces {size} variables in an event: {_DAMAGED}")
        fields = [(" number", "<u2"), (" t", "<u4" if version == 1 else "<u8")]  # no variable begins with a blank
        for _ in range(size):
            (text,) = take(_NAME)
            parts = _VARIABLE.fullmatch(text)
            if parts is None:
                shown = quoted(text.decode(errors="replace"))
                refuse(path, f"has a variable {shown} without a known type: {_DAMAGED}")
            fields.append((parts[1].decode(), "<f2" if parts[2] == b"e" else f"<{parts[2].decode()}"))
        if number in types or len(dict(fields)) < len(fields):
            refuse(path, f"names an event type or a variable twice: {_DAMAGED}")
        types[number] = np.dtype(fields)
    return types, version, at


def _places(path: Path, content: bytes, types: Types, at: int, *, valid: bool) -> tuple[dict[int, array.array], int]:
    """The position of each event by its type, and the number of bytes after the last complete event."""
    places, end = {number: array.array("q") for number in types}, len(content)
    sizes = {number: layout.itemsize for number, layout in types.items()}
    while at + 2 <= end:
        number = content[at] | content[at + 1] << 8
        if number not in sizes and (valid or end - at > 4):  # else a wrong checksum
            refuse(path, f"is corrupt at byte {at}: no event begins there; {_AGAIN}")
        if at + sizes.get(number, end) > end:
            break
        places[number].append(at)
        at += sizes[number]
    return places, end - at


def _series(variables: Variables, wanted: dict[str, tuple[str, float]], names: dict[str, str]) -> Series | None:
    """The columns `wanted` (variable and factor), if one event holds them all."""
    found = [variables[variable] for variable, _ in wanted.values() if variable in variables]
    if len(found) < len(wanted) or any(t is not found[0][0] for t, _ in found):
        return None
    names |= {column: variable for column, (variable, _) in wanted.items()}
    return Series(found[0][0], np.column_stack([variables[name][1] * factor for name, factor in wanted.values()]))


def _rotors(variables: Variables, names: dict[str, str]) -> tuple[Series, str] | None:
    """Rotor speeds [rad/s] or commands [0..1], and the name of the first column."""
    for prefix, variable, factor in _ROTORS:
        found: dict[str, str] = {}
        series = _series(variables, {f"{prefix}{i}": (variable.format(i), factor) for i in range(1, 5)}, found)
        measured = prefix == "omega"
        if series is None or (measured and not (series.values > 0).any(axis=0).all()):
            continue
        finite = np.isfinite(series.values).all(axis=1)
        if np.count_nonzero(finite) > 1:
            names |= found
            values = series.values[finite]
            return Series(series.t[finite], values if measured else np.clip(values, 0.0, 1.0)), f"{prefix}1"
    return None
