"""DataFlash logs (`.BIN`) of ArduPilot's Copter. Messages, frames and settings: docs/logs.md.

A file describes its own messages: a message FMT gives the number, length, name, field types and field names of each.
Reference: `AP_Logger` and `LogStructure.h` of ArduPilot.
"""

import array
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .sampling import HALF_TURN, Series, gyro_rows, in_order, logged_rate, unwrapped
from .table import (
    LogFacts,
    LogFormat,
    Path,
    Sampling,
    Table,
    counted,
    fast_enough,
    needed,
    order_note,
    read_bytes,
    refuse,
)

_HEAD, _FMT, _FMT_LENGTH = b"\xa3\x95", 0x80, 89
_LARGEST = 1 << 30  # bytes of a file
_MOST_DAMAGE = 1000  # places: more are no log
_TYPES = {  # by letter: the type, and the unit of its last digit, 0 for texts and arrays
    **{
        letter: (code, 1.0)
        for letter, code in zip("bBhHiIqQfdgM", "i1 u1 i2 u2 i4 u4 i8 u8 f4 f8 f2 u1".split(), strict=True)
    },
    **{letter: (code, 0.01) for letter, code in zip("cCeE", "i2 u2 i4 u4".split(), strict=True)},
    **{"n": ("S4", 0.0), "N": ("S16", 0.0), "Z": ("S64", 0.0), "L": ("i4", 1e-7), "a": ("S64", 0.0)},
}
_DEGREE, _RPM = math.pi / 180, 2 * math.pi / 60
_RATES = {"GYR": ("GyrX", "GyrY", "GyrZ", 1.0), "IMU": ("GyrX", "GyrY", "GyrZ", 1.0), "RATE": ("R", "P", "Y", _DEGREE)}
_ANGLES = {name: ("Roll", "Pitch", "Yaw", _DEGREE) for name in ("ANG", "ATT")}
_VECTORS = {
    ("ax", "ay", "az"): {name: ("AccX", "AccY", "AccZ", 1.0) for name in ("ACC", "IMU")},
    ("x", "y", "z"): {name: ("PN", "PE", "PD", 1.0) for name in ("XKF1", "NKF1")},
    ("vx", "vy", "vz"): {name: ("VN", "VE", "VD", 1.0) for name in ("XKF1", "NKF1")},
}
_READ = {"PARM", "RCOU", "ESC", "BAT", *_RATES, *_ANGLES, *(name for each in _VECTORS.values() for name in each)}
_TIMES = ("SampleUS", "TimeUS")
_INSTANCES = ("I", "C", "Instance", "Inst")  # fields that number sensors, filters, motors or batteries
_FASTER = 1.1  # a message that is this much faster than another is preferred to it
_MOTOR1, _MOTOR5 = 33, 37  # output functions of motors 1 and 5
_FAST = 1 | 1 << 18  # LOG_BITMASK: fast attitude, fast IMU
_PWM = (1000.0, 2000.0)  # [us]
_REMEDY = "the log is corrupt there: download it again, or choose another"


class _Log(NamedTuple):
    """The fields of the messages by name; the parameters; the log's names of our columns; the notes."""

    path: Path
    messages: dict[str, dict[str, np.ndarray]]
    parameters: dict[str, float]
    names: dict[str, str]
    notes: list[str]

    def series(self, name: str, fields: Sequence[str], instance: int | None = None) -> Series | None:
        """Samples of fields of a message, of one instance (by default the first); `None` if they were not logged."""
        message = self.messages.get(name, {})
        time = next((name for name in _TIMES if name in message), None)
        if time is None or not message.keys() >= set(fields):
            return None
        numbers = next((message[name] for name in _INSTANCES if name in message), np.zeros(message[time].size))
        own = numbers == (numbers.min() if instance is None else instance)
        t = 1e-6 * message[time][own]
        kept = in_order(t)
        if kept is None:
            refuse(self.path, f"time runs backward in {name}: {_REMEDY}")
        if np.count_nonzero(kept) < 2:
            return None
        if not kept.all():
            self.notes.append(f"{name}: {np.count_nonzero(~kept)} late messages are ignored")
        values = np.column_stack([message[field][own][kept] for field in fields])
        return Series(t[kept], np.where(np.isfinite(values), values, np.nan))

    def fastest(self, sources: dict[str, tuple[str, str, str, float]], columns: Sequence[str]) -> Series | None:
        """The vector that was logged most often, in our unit and frame. Of equals, the first."""
        best, found = 0.0, None
        for name, (*fields, factor) in sources.items():
            series = self.series(name, fields)
            if series is not None and logged_rate(series.t) > _FASTER * best:
                best, found = logged_rate(series.t), Series(series.t, series.values * factor * HALF_TURN)
                self.names.update((c, f"{name}.{f}") for c, f in zip(columns, fields, strict=True))
        return found


def read_ardupilot(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a log of ArduPilot, and notes on what was assumed. Raises `InputError`."""
    log = _decoded(path)
    outputs = _outputs(log)
    mask = int(log.parameters.get("LOG_BITMASK", 0)) | _FAST
    setting = f"set LOG_BITMASK to {mask} (with fast attitude and fast IMU)"
    rates = needed(path, log.fastest(_RATES, ("p", "q", "r")), "body rates", setting)
    remedy = "add 1024 (RC output) to LOG_BITMASK, and use ESC telemetry by bidirectional DShot"
    rotors, measured = needed(path, _rotors(log, outputs), "rotor speeds or commands", remedy)
    angles = log.fastest(_ANGLES, ("phi", "theta", "psi"))
    others: dict[tuple[str, ...], Series | None] = {("voltage",): log.series("BAT", ("Volt",))}
    others |= {names: log.fastest(sources, names) for names, sources in _VECTORS.items()}
    others["phi", "theta", "psi"] = None if angles is None else unwrapped(angles.t, angles.values)
    log.names["voltage"] = "BAT.Volt"
    first = log.names["omega1" if measured else "command1"]
    log.notes.append(order_note(first))
    dshot = "log rotor speeds at 100 Hz by ESC telemetry of bidirectional DShot (SERVO_BLH_BDMASK = 15)"
    facts = LogFacts(
        Sampling(first.partition(".")[0], logged_rate(rotors.t)),
        Sampling(log.names["p"].partition(".")[0], logged_rate(rates.t)),
        f"{dshot}, because RCOU is always at 10 Hz, {setting}, and fly again",
    )
    table = Table(path, {}, first_row=None, names=log.names, remedy=_REMEDY, facts=facts)
    return gyro_rows(table, rates, rotors, measured=measured, others=others)[1], tuple(log.notes)


ARDUPILOT = LogFormat(
    "ArduPilot", "ArduPilot DataFlash log", lambda begin: begin.startswith(_HEAD + bytes([_FMT])), read_ardupilot
)


def _outputs(log: _Log) -> list[int]:
    """The outputs of motors 1 to 4, counted from 0. Refuses a vehicle that is not a quadrotor. Raises `InputError`."""
    get = log.parameters.get
    functions = [int(get(f"SERVO{number}_FUNCTION", 0)) for number in range(1, 33)]
    if get("FRAME_CLASS", 1.0) not in (0.0, 1.0) or _MOTOR5 in functions:
        refuse(log.path, "FRAME_CLASS or SERVO5_FUNCTION: this is no quadrotor; give the log of a quadrotor")
    motors = range(_MOTOR1, _MOTOR5)
    return [functions.index(motor) for motor in motors] if set(motors) <= set(functions) else [0, 1, 2, 3]


def _rotors(log: _Log, outputs: list[int]) -> tuple[Series, bool] | None:
    """Speeds [rad/s], or commands [0..1] if they were not measured, or only rarely; and whether they are measured."""
    every = [log.series("ESC", ("RPM",), output) for output in outputs]
    escs = [each for each in every if each is not None and (each.values > 0).any()]
    commands = log.series("RCOU", [f"C{output + 1}" for output in outputs])
    if len(escs) == len(outputs):
        t = escs[0].t
        values = [np.interp(t, each.t, np.nan_to_num(each.values[:, 0])) * _RPM for each in escs]
        speeds, rate = Series(t, np.abs(np.column_stack(values))), logged_rate(t)
        if commands is None or fast_enough(rate) or rate >= logged_rate(commands.t):
            log.names.update((f"omega{i}", f"ESC.RPM of output {o + 1}") for i, o in enumerate(outputs, start=1))
            return speeds, True
        log.notes.append(f"measured speeds (ESC) were logged at {rate:.2g} Hz only: commands are used")
    if commands is None:
        return None
    get = log.parameters.get
    low, high = (get(f"MOT_PWM_{end}", 0.0) or default for end, default in zip(("MIN", "MAX"), _PWM, strict=True))
    low, high = (low, high) if low < high else _PWM
    log.names.update((f"command{i}", f"RCOU.C{output + 1}") for i, output in enumerate(outputs, start=1))
    log.notes.append(f"commands are RCOU, PWM {low:g}..{high:g}, taken as fractions of full-scale rotor speed")
    return Series(commands.t, np.clip((commands.values - low) / (high - low), 0.0, 1.0)), False


def _decoded(path: Path) -> _Log:
    """The messages that are read. Raises `InputError` for a file that cannot be decoded."""
    content, at, notes = read_bytes(path, _LARGEST), 0, []
    sizes, layouts = {_FMT: _FMT_LENGTH}, {}
    places = {number: array.array("q") for number in range(256)}
    end, damaged = len(content), 0
    while at + 3 <= end:
        number = content[at + 2]
        size = sizes.get(number, 0)
        following = at + size
        whole = 0 < size and following <= end and content.startswith(_HEAD, at)
        if not whole or not content.startswith(_HEAD[: end - following], following):
            following = content.find(_HEAD, at + 1)
            damaged += following > 0
            if damaged > _MOST_DAMAGE:
                refuse(path, f"is damaged in more than {_MOST_DAMAGE} places; {_REMEDY}")
            at = following if following > 0 else end
            continue
        if number == _FMT:
            kind, sizes[kind], *layouts[kind] = _layout(content[at + 3 : following])
        places[number].append(at)
        at = following
    if damaged:
        notes.append(
            f"the log is damaged in {counted(damaged, 'place')}; what follows up to the next message is ignored"
        )
    data, messages, parameters = np.frombuffer(content, dtype=np.uint8), {}, {}
    for kind, (name, layout, units) in layouts.items():
        begin = np.asarray(places[kind], dtype=np.int64)
        if layout is None or not begin.size or name not in _READ:
            continue
        records = data[begin[:, None] + np.arange(layout.itemsize)].reshape(-1).view(layout)
        with np.errstate(all="ignore"):  # a damaged float need not be finite
            messages[name] = {f: records[f].astype(float) * unit for f, unit in units.items() if unit}
        if name == "PARM" and {"Name", "Value"} <= units.keys():
            names = (each.decode(errors="replace") for each in records["Name"].astype("S64").tolist())
            parameters = {n: x for n, x in zip(names, messages[name]["Value"].tolist(), strict=True) if abs(x) < 1e9}
    return _Log(path, messages, parameters, {}, notes)


def _layout(body: bytes) -> tuple[int, int, str, np.dtype | None, dict[str, float]]:
    """The number, length and name of the messages that a message FMT describes, and their layout.

    The layout is `None` if it is not known. Last, by field, the unit of its last digit; 0 for a text.
    """
    name, letters, fields = (body[a:b].rstrip(b"\0").decode(errors="replace") for a, b in ((2, 6), (6, 22), (22, 86)))
    labels, unknown = fields.split(","), (body[0], body[1], name, None, {})
    if not len(labels) == len(letters) == len({*labels}) or "" in labels or not {*letters} <= _TYPES.keys():
        return unknown
    parts = [(label, f"<{_TYPES[letter][0]}") for label, letter in zip(labels, letters, strict=True)]
    layout = np.dtype([(" head", "S3"), *parts])
    units = {label: _TYPES[letter][1] for label, letter in zip(labels, letters, strict=True)}
    return (body[0], body[1], name, layout, units) if layout.itemsize == body[1] else unknown
