"""DataFlash logs (`.BIN`) of ArduPilot's Copter. Messages, frames and settings: docs/logs.md.

A file describes its messages: a message FMT gives the number, length and name of a kind, and its types and fields.
Reference: `AP_Logger` and `LogStructure.h` of ArduPilot.
"""

import array

import numpy as np

from ..errors import counted
from ..flight import ANGLE_NAMES, FORCE_NAMES, RATE_NAMES
from ..rotations import HALF_TURN
from .messages import Fields, Messages, Rotors, motor_order, records
from .sampling import Series, logged_rate
from .table import LogFormat, LogPath, Table, fast_enough, read_bytes, refuse
from .values import DEGREE, RPM

_HEAD, _FMT, _FMT_LENGTH = b"\xa3\x95", 0x80, 89
_TYPES = {  # by letter: the type, and the unit of its last digit, 0 for texts and arrays
    **{
        letter: (code, 1.0)
        for letter, code in zip("bBhHiIqQfdgM", "i1 u1 i2 u2 i4 u4 i8 u8 f4 f8 f2 u1".split(), strict=True)
    },
    **{letter: (code, 0.01) for letter, code in zip("cCeE", "i2 u2 i4 u4".split(), strict=True)},
    **{"n": ("S4", 0.0), "N": ("S16", 0.0), "Z": ("S64", 0.0), "L": ("i4", 1e-7), "a": ("S64", 0.0)},
}
_GYRO, _ACCELEROMETER, _ROLL = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ"), ("Roll", "Pitch", "Yaw")
_SOURCES = {
    RATE_NAMES: [("GYR", _GYRO, HALF_TURN), ("IMU", _GYRO, HALF_TURN), ("RATE", ("R", "P", "Y"), DEGREE * HALF_TURN)],
    ANGLE_NAMES: [("ANG", _ROLL, DEGREE * HALF_TURN), ("ATT", _ROLL, DEGREE * HALF_TURN)],
    FORCE_NAMES: [("ACC", _ACCELEROMETER, HALF_TURN), ("IMU", _ACCELEROMETER, HALF_TURN)],
    ("x", "y", "z"): [(name, ("PN", "PE", "PD"), HALF_TURN) for name in ("XKF1", "NKF1")],
    ("vx", "vy", "vz"): [(name, ("VN", "VE", "VD"), HALF_TURN) for name in ("XKF1", "NKF1")],
    ("voltage",): [("BAT", ("Volt",), 1.0)],
}
_READ = {"PARM", "RCOU", "ESC", *(kind for sources in _SOURCES.values() for kind, *_ in sources)}
_TIMES = ("SampleUS", "TimeUS")
_INSTANCES = ("I", "C", "Instance", "Inst")  # fields that number sensors, filters, motors or batteries
_MOTORS, _MOTOR5 = range(33, 37), 37  # output functions
_FAST = 1 | 1 << 18  # LOG_BITMASK: fast attitude, fast IMU
_MAX_BYTES, _MAX_DAMAGE = 1 << 30, 1000  # of a log; in places
_REMEDY = "the log is corrupt there: download it again, or choose another"


def read_ardupilot(path: LogPath) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a log of ArduPilot, and notes on what was assumed. Raises `InputError`."""
    log = _decoded(path)
    get = log.parameters.get
    functions = [int(get(f"SERVO{number}_FUNCTION", 0)) for number in range(1, 33)]
    if get("FRAME_CLASS", 1.0) not in (0.0, 1.0) or _MOTOR5 in functions:
        refuse(path, "FRAME_CLASS or SERVO5_FUNCTION: this is no quadrotor; give the log of a quadrotor")
    outputs = motor_order(functions, _MOTORS) or [0, 1, 2, 3]
    setting = f"set LOG_BITMASK to {int(get('LOG_BITMASK', 0)) | _FAST} (with fast attitude and fast IMU)"
    dshot = "log rotor speeds at 100 Hz by ESC telemetry of bidirectional DShot (SERVO_BLH_BDMASK = 15)"
    return log.table(
        {columns: log.fastest(columns, sources) for columns, sources in _SOURCES.items()},
        _rotors(log, outputs),
        remedies=(setting, "add 1024 (RC output) to LOG_BITMASK, and use ESC telemetry by bidirectional DShot"),
        is_ordered=True,
        faster=f"{dshot}, because RCOU is always at 10 Hz, {setting}, and fly again",
    )


def _recognises(begin: bytes) -> bool:
    """Whether a log describes itself as one of ArduPilot; PX4's old logs have another word for columns."""
    return begin.startswith(_HEAD + bytes([_FMT])) and b"Labels" not in begin[:_FMT_LENGTH]


ARDUPILOT = LogFormat("ArduPilot", "ArduPilot DataFlash log", _recognises, read_ardupilot)


def _rotors(log: Messages, outputs: list[int]) -> Rotors | None:
    """Measured speeds; or commands, if speeds were not logged, or too rarely."""
    every = {f"ESC.RPM of output {output + 1}": log.series("ESC", ("RPM",), output) for output in outputs}
    escs = {name: each for name, each in every.items() if each is not None and (each.values > 0).any()}
    commands = log.series("RCOU", [f"C{output + 1}" for output in outputs])
    if len(escs) == len(outputs):
        t = next(iter(escs.values())).t
        rate = logged_rate(t)
        if commands is None or fast_enough(rate) or rate >= logged_rate(commands.t):
            values = [log.speeds_at(t, each, name) * RPM for name, each in escs.items()]
            return Rotors(Series(t, np.abs(np.column_stack(values))), [*escs], is_measured=True)
        log.notes.append(f"measured speeds (ESC) were logged at {rate:.2g} Hz only: commands are used")
    if commands is None:
        return None
    get = log.parameters.get
    low, high = get("MOT_PWM_MIN") or 1000.0, get("MOT_PWM_MAX") or 2000.0  # [us]
    low, high = (low, high) if low < high else (1000.0, 2000.0)
    shares = Series(commands.t, np.clip((commands.values - low) / (high - low), 0.0, 1.0))
    note = f"commands are RCOU, PWM {low:g}..{high:g}, taken as fractions of full-scale rotor speed"
    return Rotors(shares, [f"RCOU.C{output + 1}" for output in outputs], is_measured=False, note=note)


def _decoded(path: LogPath) -> Messages:
    """The messages that are read. Raises `InputError` for a file that is too large, or too damaged."""
    content, at, notes = read_bytes(path, _MAX_BYTES), 0, []
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
            if damaged > _MAX_DAMAGE:
                refuse(path, f"is damaged in more than {_MAX_DAMAGE} places; {_REMEDY}")
            at = following if following > 0 else end
            continue
        if number == _FMT:
            kind, sizes[kind], *layouts[kind] = _layout(content[at + 3 : following])
        places[number].append(at)
        at = following
    if damaged:
        what = "what follows up to the next message is ignored"
        notes.append(f"the log is damaged in {counted(damaged, 'place')}; {what}")
    messages, parameters = {}, {}
    for kind, (name, layout, units) in layouts.items():
        if layout is None or not places[kind] or name not in _READ:
            continue
        found = records(content, places[kind], layout)
        with np.errstate(all="ignore"):  # a damaged float need not be finite
            fields = {f: found[f].astype(float) * unit for f, unit in units.items() if unit}
        messages[name] = _instances(fields)
        if name == "PARM" and "Name" in units and "Value" in fields:  # a text is no field
            names = (each.decode(errors="replace") for each in found["Name"].astype("S64").tolist())
            parameters = {n: x for n, x in zip(names, fields["Value"].tolist(), strict=True) if abs(x) < 1e9}
    return Messages(path, messages, _REMEDY, notes, parameters=parameters)


def _instances(fields: Fields) -> dict[int, Fields]:
    """The fields of each sensor, filter, motor or battery by its number; none without a time."""
    time = next((fields[name] for name in _TIMES if name in fields), None)
    if time is None:
        return {}
    number = next((fields[name] for name in _INSTANCES if name in fields), np.zeros(time.size))
    every, numbers = {**fields, "t": 1e-6 * time}, np.unique(number[np.isfinite(number)])[:256]
    return {int(own): {name: values[number == own] for name, values in every.items()} for own in numbers}


def _layout(body: bytes) -> tuple[int, int, str, np.dtype | None, dict[str, float]]:
    """The number, length, name and layout (`None`: unknown) of a message by its FMT, and units of last digits."""
    name, letters, fields = (body[a:b].rstrip(b"\0").decode(errors="replace") for a, b in ((2, 6), (6, 22), (22, 86)))
    labels, unknown = fields.split(","), (body[0], body[1], name, None, {})
    if not len(labels) == len(letters) == len({*labels}) or "" in labels or not {*letters} <= _TYPES.keys():
        return unknown
    typed = [(label, f"<{_TYPES[letter][0]}") for label, letter in zip(labels, letters, strict=True)]
    layout = np.dtype([(" head", "S3"), *typed])
    units = {label: _TYPES[letter][1] for label, letter in zip(labels, letters, strict=True)}
    return (body[0], body[1], name, layout, units) if layout.itemsize == body[1] else unknown
