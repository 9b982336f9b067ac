"""Logs of the Crazyflie's micro-SD card: versions 1 and 2, and the format of 2019. Variables and frames: docs/logs.md.

Reference: the usdlog tools and the micro-SD deck of the Crazyflie firmware.
"""

import array
import re
import zlib

import numpy as np

from ..airframe import STANDARD_GRAVITY
from ..errors import counted, quoted
from ..flight import ANGLE_NAMES, COMMAND_NAMES, FORCE_NAMES, RATE_NAMES, SPEED_NAMES
from .messages import Fields, Messages, Rotors, records
from .sampling import Series
from .table import LogFormat, LogPath, Table, read_bytes, refuse
from .values import DEGREE, RPM

_MAGIC = b"\xbc"
_PAIR = re.compile(rb"(..)(..)", re.DOTALL)
_TYPE = re.compile(rb"(..)([^\0]{0,255})\0(..)", re.DOTALL)
_NAME = re.compile(rb"([^\0]{0,255})\0")
_VARIABLE = re.compile(rb"([\x21-\x27\x2a-\x7e]{1,80})\(([bBhHiIqQefd])\)")  # name, and letter of its type in NumPy
_SETS = re.compile(rb"(.)(tick\(I\),(?:[\x20-\x27\x2a\x2b\x2d-\x7e]{1,80}\([bBhHiIqQefd]\),){1,255})", re.DOTALL)
_FULL = 65535.0
_MAX_TYPES, _MAX_VARIABLES = 64, 256  # of events, and of one event; more are damage
_SOURCES = {
    RATE_NAMES: ([f"gyro.{axis}" for axis in "xyz"], DEGREE),
    ANGLE_NAMES: ([f"stateEstimate.{name}" for name in ("roll", "pitch", "yaw")], DEGREE * np.array([1, -1, 1])),
    # These are read one by one.
    **{(name,): ([f"acc.{name[1]}"], STANDARD_GRAVITY) for name in FORCE_NAMES},
    **{(name,): ([f"stateEstimate.{name}"], 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")},
    ("voltage",): (["pm.vbat"], 1.0),
}
_ROTORS = (("rpm.m{}", True, RPM), ("motor.m{}", False, 1 / _FULL), ("pwm.m{}_pwm", False, 1 / _FULL))
_AGAIN = "copy it again from the card"
_REMEDY = f"the log is corrupt there: {_AGAIN}, or choose another"
_DAMAGED = f"it is corrupt; {_AGAIN}"

Types = dict[int, tuple[str, np.dtype]]
"""By the number of a type of events: its name and layout."""


def read_crazyflie(path: LogPath) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a Crazyflie's log, and notes on what was assumed. Raises `InputError`."""
    notes: list[str] = []
    content = read_bytes(path, 1 << 28)  # an hour at 1 kHz
    events = _sets(path, content, notes) if content[:1] != _MAGIC else _events(path, content, notes)
    if not events:
        refuse(path, "holds no events; a flight needs at least two")
    log = Messages(path, events, _REMEDY, notes, prefixed=False)
    return log.table(
        {columns: log.fastest(columns, [(event, *source) for event in events]) for columns, source in _SOURCES.items()},
        _rotors(log),
        remedies=(
            "add gyro.x, gyro.y and gyro.z to the deck's config.txt",
            "add motor.m1 to motor.m4, or rpm.m1 to rpm.m4, to config.txt",
        ),
        faster="raise the frequency of these variables in the deck's config.txt, and fly again",
    )


CRAZYFLIE = LogFormat(
    "Crazyflie",
    "Crazyflie micro-SD log",
    lambda begin: begin.startswith(_MAGIC) or _SETS.match(begin) is not None,
    read_crazyflie,
)


def _rotors(log: Messages) -> Rotors | None:
    for variable, is_measured, factor in _ROTORS:
        names = [variable.format(i) for i in range(1, 5)]
        sources = [(event, names, factor) for event in log.fields]  # all four in one event
        series = log.fastest(SPEED_NAMES if is_measured else COMMAND_NAMES, sources)
        if series is None:
            continue
        series = series if is_measured else Series(series.t, np.clip(series.values, 0.0, 1.0))
        if (rotors := Rotors.of(series, names, is_measured=is_measured)) is not None:
            return rotors
    return None


def _events(path: LogPath, content: bytes, notes: list[str]) -> dict[str, dict[int, Fields]]:
    """The events of versions 1 and 2, by the names of their types."""
    types, version, at = _types(path, content)
    valid = len(content) >= at + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    places, end = {number: array.array("q") for number in types}, len(content) - 4 * valid
    sizes = {number: layout.itemsize for number, (_, layout) in types.items()}
    while at + 2 <= end:
        number = content[at] | content[at + 1] << 8
        if number not in sizes and (valid or end - at > 4):  # else a wrong checksum
            refuse(path, f"is corrupt at byte {at}: no event begins there; {_AGAIN}")
        if at + sizes.get(number, end) > end:
            break
        places[number].append(at)
        at += sizes[number]
    if not valid:
        ignored = end - at
        cut = f"and its last {ignored} bytes are not a complete event" if ignored else "but ends with a complete event"
        notes.append(f"the log has no valid checksum, {cut}: it was cut while it was written, or is corrupt")
    found: dict[str, dict[int, Fields]] = {}
    for number, (name, layout) in types.items():
        if len(places[number]) > 1:
            events = records(content, places[number], layout)
            fields = {each: events[each] for each in layout.names or () if each[0] != " "}
            found.setdefault(name, {})[number] = fields | {"t": events[" t"] * (1e-3 if version == 1 else 1e-6)}
    return found


def _sets(path: LogPath, content: bytes, notes: list[str]) -> dict[str, dict[int, Fields]]:
    """The one event of the format of 2019: names, then blocks of data sets, each with the inverse of its CRC-32."""
    match = _SETS.match(content)
    found = [] if match is None else [_VARIABLE.fullmatch(text.strip()) for text in match[2].split(b",")[:-1]]
    fields = [(each[1].decode(), f"<{each[2].decode()}") for each in found if each]
    if match is None or not len(found) == len(fields) == len(dict(fields)) == match[1][0]:
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
    rows = np.frombuffer(b"".join(good), layout)
    sets = {name: rows[name] for name, _ in fields} | {"t": rows["tick"] * 1e-3}
    return {"its data sets": {0: sets}} if rows.size > 1 else {}


def _types(path: LogPath, content: bytes) -> tuple[Types, int, int]:
    """The types of events, the version, and the number of bytes of the header. Raises `InputError`."""
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
    if not 0 < count <= _MAX_TYPES:
        refuse(path, f"announces {count} event types: {_DAMAGED}")
    types: Types = {}
    for _ in range(count):
        number, name, size = take(_TYPE)
        number, size = int.from_bytes(number, "little"), int.from_bytes(size, "little")
        if size > _MAX_VARIABLES:
            refuse(path, f"announces {size} variables in an event: {_DAMAGED}")
        fields = [(" number", "<u2"), (" t", "<u4" if version == 1 else "<u8")]  # no variable begins with a blank
        for _ in range(size):
            (text,) = take(_NAME)
            variable = _VARIABLE.fullmatch(text)
            if variable is None:
                shown = quoted(text.decode(errors="replace"))
                refuse(path, f"has a variable {shown} without a known type: {_DAMAGED}")
            fields.append((variable[1].decode(), f"<{variable[2].decode()}"))
        if number in types or len(dict(fields)) < len(fields):
            refuse(path, f"names an event type or a variable twice: {_DAMAGED}")
        types[number] = quoted(name.decode(errors="replace")), np.dtype(fields)
    return types, version, at
