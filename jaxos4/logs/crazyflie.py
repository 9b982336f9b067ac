"""Logs of the Crazyflie's micro-SD card, versions 1 and 2.

| column | variable of the log | unit in the log |
| --- | --- | --- |
| `p, q, r` | `gyro.x, y, z` | deg/s |
| `ax, ay, az` | `acc.x, y, z` | g |
| `phi, theta, psi` | `stateEstimate.roll, pitch, yaw`, or `stateEstimate.qw, qx, qy, qz` | deg |
| `x, y, z` | `stateEstimate.x, y, z` | m |
| `vx, vy, vz` | `stateEstimate.vx, vy, vz` | m/s |
| `omega1..4` | `rpm.m1..m4`, measured, interpolated linearly in the square | rpm |
| `voltage` | `pm.vbat` | V |
| `command1..4` | `motor.m1..m4`, or `pwm.m1_pwm..m4_pwm`, if there is no `omega1..4` | 0..65535 |

Any event may hold a variable; if several do, the one with the most samples is used. A command is held until the next
one, and counts as a fraction of the airframe's `max_rotor_speed`. `t` is 0 at the first sample used. The samples of
the body rates are the rows; samples at other rates are brought to them (`jaxos4.logs.series`).

**Frames.** The body has x forward, y left, z up, as ours, and rates follow the right hand. `stateEstimate.pitch` is
positive nose up, so theta is its negative. The quaternion needs no correction.

**Rotors.** They keep the firmware's numbers (1 front right, 2 rear right, 3 rear left, 4 front left). The airframe's
`rotor_positions` and `rotor_spins` must have the same order.

**File.** All numbers are little-endian. A file starts with 0xBC, the version and the number of event types (16 bits
each). For each type follow its number (16 bits), its name, the number of its variables (16 bits), and their names
with their types, as `gyro.x(f)`; all names end with a zero. Then come the events: number of the type, time stamp
(version 1: 32 bits, ms; version 2: 64 bits, us), values. A CRC-32 of the file ends it, unless power was lost.

Reference: the usdlog tools and the micro-SD deck of the Crazyflie firmware.
"""

import array
import math
import re
import struct
import zlib
from typing import NamedTuple, NoReturn

import numpy as np

from .facts import LogFacts, Sampling, logged_rate
from .series import Series, at_rows, euler_angles, gyro_rows, in_order, unwrapped
from .table import LogFormat, Path, Table, opened_bytes, quoted, refuse

_MAGIC = b"\xbc"
_MOST_TYPES, _MOST_VARIABLES = 64, 256
_LARGEST = 1 << 28  # bytes of a file: an hour at 1 kHz
_AT_ONCE = 1 << 20
_VARIABLE = re.compile(rb"([\x21-\x27\x2a-\x7e]{1,80})\(([bBhHiIqQefd])\)")
_DEGREE, _GRAVITY, _RPM, _FULL = math.pi / 180, 9.80665, 2 * math.pi / 60, 65535.0
_RATES = {"p": ("gyro.x", _DEGREE), "q": ("gyro.y", _DEGREE), "r": ("gyro.z", _DEGREE)}
_OTHERS = {  # each is read by itself
    **{name: (f"acc.{name[1]}", _GRAVITY) for name in ("ax", "ay", "az")},
    **{name: (f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")},
    "voltage": ("pm.vbat", 1.0),
}
_ANGLES = {
    "phi": ("stateEstimate.roll", _DEGREE),
    "theta": ("stateEstimate.pitch", -_DEGREE),
    "psi": ("stateEstimate.yaw", _DEGREE),
}
_QUATERNION = {axis: (f"stateEstimate.q{axis}", 1.0) for axis in "wxyz"}
_REMEDY = "the log is corrupt there: copy it again from the card, or choose another"
_AGAIN = "copy it again from the card"
_OFTEN = "raise the frequency of these variables in the deck's config.txt, and fly again"

Variables = dict[str, tuple[np.ndarray, np.ndarray]]


class _Type(NamedTuple):
    number: int
    variables: tuple[str, ...]
    layout: np.dtype


def read_crazyflie(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a Crazyflie's log, and notes on what was assumed. Raises `InputError`."""
    content = bytearray()
    with opened_bytes(path) as file:
        while part := file.read(_AT_ONCE):
            content += part
            if len(content) > _LARGEST:
                refuse(path, f"has more than {_LARGEST:,} bytes, far more than one flight; cut the log into flights")
    notes: list[str] = []
    events = sorted(_events(path, bytes(content), notes), key=lambda event: event[0].size)
    variables = {name: (t, column) for t, columns in events for name, column in columns.items()}
    names: dict[str, str] = {}
    rates = _series(variables, _RATES, names)
    if rates is None:
        refuse(path, "holds no body rates; add gyro.x, gyro.y and gyro.z to the deck's config.txt")
    rotors, measured = _rotors(path, variables, names)
    rows, columns = gyro_rows(path, rates, rotors, measured=measured)
    for name, source in _OTHERS.items():
        series = _series(variables, {name: source}, names)
        if series is not None:
            columns[name] = at_rows(rows, series)[:, 0]
    attitude = _attitude(variables, names)
    if attitude is not None:
        columns.update(zip(_ANGLES, at_rows(rows, attitude).T, strict=True))
    if not measured:
        notes.append(f"commands are {names['command1']}.., taken as fractions of full-scale rotor speed")
    motors = Sampling(names["omega1" if measured else "command1"], logged_rate(rotors.t))
    facts = LogFacts(motors, Sampling(names["p"], logged_rate(rates.t)), _OFTEN)
    return Table(path, columns, first_row=None, names=names, remedy=_REMEDY, facts=facts), tuple(notes)


CRAZYFLIE = LogFormat("Crazyflie", "Crazyflie micro-SD log", lambda begin: begin.startswith(_MAGIC), read_crazyflie)


def _events(path: Path, content: bytes, notes: list[str]) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Times [s] and variables of each event type. An incomplete event at the end is ignored."""
    header = _Header(path, content)
    types, version = header.types()
    valid = len(content) >= header.at + 4 and zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
    end = len(content) - 4 if valid else len(content)
    places, ignored = _places(path, content, types, header.at, end, valid=valid)
    if not valid:
        cut = f"and its last {ignored} bytes are not a complete event" if ignored else "but ends with a complete event"
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
            notes.append(f"{np.count_nonzero(~kept)} late events are ignored")
        with np.errstate(all="ignore"):
            values = [records[f"v{i}"][kept].astype(float) for i in range(len(each.variables))]
        values = [np.where(np.isfinite(v), v, np.nan) for v in values]
        out.append((t[kept], dict(zip(each.variables, values, strict=True))))
    if not out:
        refuse(path, "holds no events; a flight needs at least two")
    return out


class _Header:
    """Reads the header of a file. `at` is the number of bytes read."""

    def __init__(self, path: Path, content: bytes):
        self.path, self.content, self.at = path, content, 0

    def types(self) -> tuple[list[_Type], int]:
        """The event types, and the version."""
        if len(self.content) < 5:
            self._cut()
        self.at = 1
        version, count = self._short(), self._short()
        if version not in (1, 2):
            refuse(self.path, f"is of version {version}, not 1 or 2; update jaxos4, or give another log")
        if not 0 < count <= _MOST_TYPES:
            self._corrupt(f"announces {count} event types")
        types: list[_Type] = []
        for _ in range(count):
            number = self._short()
            self._text()
            names, kinds = self._variables()
            if number in [each.number for each in types] or len(set(names)) < len(names):
                self._corrupt("names an event type or a variable twice")
            stamp = "<u4" if version == 1 else "<u8"
            fields = [("number", "<u2"), ("t", stamp), *((f"v{i}", f"<{kind}") for i, kind in enumerate(kinds))]
            types.append(_Type(number, tuple(names), np.dtype(fields)))
        return types, version

    def _variables(self) -> tuple[list[str], list[str]]:
        """The names of an event's variables, and their types in numpy's words."""
        count = self._short()
        if count > _MOST_VARIABLES:
            self._corrupt(f"announces {count} variables in an event")
        names, kinds = [], []
        for _ in range(count):
            text = self._text()
            parts = _VARIABLE.fullmatch(text)
            if parts is None:
                self._corrupt(f"has a variable {quoted(text.decode(errors='replace'))} without a known type")
            names.append(parts[1].decode())
            kinds.append("f2" if parts[2] == b"e" else np.dtype(parts[2].decode()).str[1:])
        return names, kinds

    def _short(self) -> int:
        if self.at + 2 > len(self.content):
            self._cut()
        self.at += 2
        return struct.unpack_from("<H", self.content, self.at - 2)[0]

    def _text(self) -> bytes:
        begin, end = self.at, self.content.find(b"\0", self.at, self.at + 256)
        if end < 0:
            self._cut()
        self.at = end + 1
        return self.content[begin:end]

    def _cut(self) -> NoReturn:
        refuse(self.path, f"ends within its header, or is corrupt; {_AGAIN}")

    def _corrupt(self, what: str) -> NoReturn:
        refuse(self.path, f"{what}: it is corrupt; {_AGAIN}")


def _places(
    path: Path, content: bytes, types: list[_Type], begin: int, end: int, *, valid: bool
) -> tuple[dict[int, array.array], int]:
    """The position of each event by its type, and the number of bytes after the last complete event."""
    sizes = {each.number: each.layout.itemsize for each in types}
    places = {number: array.array("q") for number in sizes}
    at = begin
    while at + 2 <= end:
        number = content[at] | content[at + 1] << 8
        size = sizes.get(number)
        if size is None:
            if not valid and end - at <= 4:  # a wrong checksum
                break
            refuse(path, f"is corrupt at byte {at}: no event begins there; {_AGAIN}")
        if at + size > end:
            break
        places[number].append(at)
        at += size
    return places, end - at


def _series(variables: Variables, wanted: dict[str, tuple[str, float]], names: dict[str, str]) -> Series | None:
    """The columns `wanted` (variable and factor), if one event holds them all."""
    found = [variables.get(variable) for variable, _ in wanted.values()]
    times = [each[0] for each in found if each is not None]
    if len(times) < len(found) or any(t is not times[0] for t in times):
        return None
    values = [variables[variable][1] * factor for variable, factor in wanted.values()]
    names.update((column, variable) for column, (variable, _) in wanted.items())
    return Series(times[0], np.column_stack(values))


def _rotors(path: Path, variables: Variables, names: dict[str, str]) -> tuple[Series, bool]:
    """Rotor speeds [rad/s] or commands [0..1], and whether they are measured speeds."""
    for variable, factor in (("rpm.m{}", _RPM), ("motor.m{}", 1 / _FULL), ("pwm.m{}_pwm", 1 / _FULL)):
        measured = factor == _RPM
        prefix = "omega" if measured else "command"
        found: dict[str, str] = {}
        series = _series(variables, {f"{prefix}{i}": (variable.format(i), factor) for i in range(1, 5)}, found)
        if series is None or (measured and not (series.values > 0).any(axis=0).all()):
            continue
        finite = np.isfinite(series.values).all(axis=1)
        if np.count_nonzero(finite) < 2:
            continue
        names.update(found)
        values = series.values[finite]
        return Series(series.t[finite], values if measured else np.clip(values, 0.0, 1.0)), measured
    refuse(path, "holds no rotor speeds or commands; add motor.m1 to motor.m4, or rpm.m1 to rpm.m4, to config.txt")


def _attitude(variables: Variables, names: dict[str, str]) -> Series | None:
    series = _series(variables, _ANGLES, names)
    if series is not None:
        return unwrapped(series.t, series.values)
    series = _series(variables, _QUATERNION, {})
    if series is not None:
        names.update(dict.fromkeys(_ANGLES, "stateEstimate.q"))
        return unwrapped(series.t, euler_angles(series.values))
    return None
