"""ULog: the logs of PX4. Reading needs `pip install 'jaxos4[ulog]'`.

| column | topic and field of the log | unit in the log |
| --- | --- | --- |
| `p, q, r` | `vehicle_angular_velocity.xyz`, or `sensor_combined.gyro_rad` | rad/s |
| `ax, ay, az` | `sensor_combined.accelerometer_m_s2`, or `vehicle_acceleration.xyz` | m/s^2 |
| `phi, theta, psi` | `vehicle_attitude.q`: w, x, y, z, from the body to the earth | |
| `x, y, z` | `vehicle_local_position.x, y, z`, while `xy_valid` and `z_valid` | m |
| `vx, vy, vz` | `vehicle_local_position.vx, vy, vz`, while `v_xy_valid` and `v_z_valid` | m/s |
| `omega1..4` | `esc_status.esc[0..3].esc_rpm`, interpolated linearly in the square | rpm |
| `command1..4` | `actuator_motors.control[0..3]`, if there is no `omega1..4` | 0..1 |
| `command1..4` | `actuator_outputs.output[0..3]`, if there is no `actuator_motors` | PWM or DShot |

Outputs are DShot (0..1999) if one of them lies between 1 and 800, and PWM (1000..2000 us) otherwise. A command is held
until the next one, and counts as a fraction of the airframe's `max_rotor_speed`.

**Time.** A sample's time is its `timestamp_sample`, or its `timestamp`. `t` is 0 at the first sample used. The samples
of the body rates are the rows; samples at other rates are brought to them (`jaxos4.logs.series`).

**Frames.** PX4's body has x forward, y right, z down; its earth has x north, y east, z down. Our body has x forward,
y left, z up; our earth has x north, y west, z up. A half turn about x leads from one to the other: y, z, q, r, theta
and psi change their signs; x, p and phi do not.

**Rotors.** They keep PX4's numbers (quad X: 1 front right, 2 rear left, 3 front left, 4 rear right). The airframe's
`rotor_positions` and `rotor_spins` must have the same order. If `actuator_function` says which motor an ESC drives,
the speeds are put in the order of the motors.
"""

import contextlib
import io
import math
import os
from typing import NamedTuple

import numpy as np

from .._files import BROKEN
from ..errors import InputError
from .series import Series, at_rows, euler_angles, gyro_rows, in_order, unwrapped
from .table import LogFormat, Path, Table, printable, refuse
from .ulog_messages import MAGIC, needed_messages

TOPICS = (
    "vehicle_angular_velocity",
    "sensor_combined",
    "vehicle_acceleration",
    "vehicle_attitude",
    "vehicle_local_position",
    "esc_status",
    "actuator_motors",
    "actuator_outputs",
)
_RATES = (("vehicle_angular_velocity", "xyz"), ("sensor_combined", "gyro_rad"))
_FORCES = (("sensor_combined", "accelerometer_m_s2"), ("vehicle_acceleration", "xyz"))
_FLAGS = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
_HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: from forward, right, down to forward, left, up
_FIRST_MOTOR = 101  # PX4's number of the output function "Motor 1"
_RPM = 2 * math.pi / 60
_PWM, _DSHOT = (1000.0, 2000.0), (0.0, 1999.0)
_LEAST_PWM = 800.0
_REMEDY = "the log is corrupt there, or a sensor failed: choose another log"

Fields = dict[str, np.ndarray]


class _Rotors(NamedTuple):
    series: Series
    measured: bool
    names: tuple[str, ...]


class _Log(NamedTuple):
    """The decoded topics, each with its instances; the log's names of our columns; the notes."""

    path: Path
    topics: dict[str, list[Fields]]
    names: dict[str, str]
    notes: list[str]

    def series(self, topic: str, fields: tuple[str, ...], instance: int = 0) -> Series | None:
        """Samples of the fields of a topic, or None if one of them was not logged."""
        raw = self.topics.get(topic, [])[instance : instance + 1]
        if not raw or not all(name in raw[0] for name in fields):
            return None
        stamp = raw[0].get("timestamp_sample", raw[0]["timestamp"])
        stamp = np.asarray(stamp if np.all(stamp > 0) else raw[0]["timestamp"], dtype=float)
        kept = in_order(stamp)
        if kept is None:
            refuse(self.path, f"time runs backward in {topic}: it is corrupt; copy the log again from the vehicle")
        if not kept.all():
            self.notes.append(f"{topic}: {np.count_nonzero(~kept)} late samples are ignored")
        with np.errstate(all="ignore"):  # a damaged float need not be finite
            values = np.column_stack([np.asarray(raw[0][name], dtype=float)[kept] for name in fields])
        return Series(stamp[kept] / 1e6, np.where(np.isfinite(values), values, np.nan))

    def vector(self, sources: tuple[tuple[str, str], ...], columns: tuple[str, ...]) -> Series | None:
        """The first of the sources (topic, field) that was logged, in our frame."""
        for topic, field in sources:
            fields = tuple(f"{field}[{i}]" for i in range(3))
            series = self.series(topic, fields)
            if series is not None and np.isfinite(series.values).any():
                self.names.update((c, f"{topic}.{f}") for c, f in zip(columns, fields, strict=True))
                return Series(series.t, series.values * _HALF_TURN)
        return None


def read_ulog(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a PX4 log, and notes on what was assumed. Raises `InputError`."""
    log = _decoded(path)
    rates = log.vector(_RATES, ("p", "q", "r"))
    if rates is None:
        refuse(path, "holds no body rates; log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)")
    rotors = _esc_speeds(log) or _motor_commands(log) or _outputs(log)
    if rotors is None:
        refuse(path, "holds no rotor speeds or commands; log esc_status, actuator_motors or actuator_outputs")
    rows, columns = gyro_rows(path, rates, rotors.series, measured=rotors.measured)
    prefix = "omega" if rotors.measured else "command"
    log.names.update((f"{prefix}{i + 1}", name) for i, name in enumerate(rotors.names))
    others = {
        ("ax", "ay", "az"): log.vector(_FORCES, ("ax", "ay", "az")),
        ("phi", "theta", "psi"): _attitude(log),
        tuple(_FLAGS): _position(log),
    }
    for names, series in others.items():
        if series is not None:
            columns.update(zip(names, at_rows(rows, series).T, strict=True))
    what = f"rotors keep the log's numbers ({rotors.names[0]} is rotor 1)"
    log.notes.append(f"{what}: rotor_positions and rotor_spins must be in the same order")
    return Table(path, columns, first_row=None, names=log.names, remedy=_REMEDY), tuple(log.notes)


ULOG = LogFormat("ULog", "PX4 ULog", lambda begin: begin.startswith(MAGIC[:4]), read_ulog)


def _decoded(path: Path) -> _Log:
    content, cut = needed_messages(path, TOPICS)
    notes = [f"the log ends abruptly: its last {cut} bytes are ignored"] if cut else []
    try:
        from pyulog.core import ULog
        from pyulog.exceptions import ULogException
    except ImportError:
        name = printable(os.fspath(path))
        raise InputError(f"{name}: reading a ULog file needs pyulog; install jaxos4[ulog].") from None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            decoded = ULog(io.BytesIO(content))
    except (*BROKEN, ULogException) as error:
        refuse(path, f"cannot be decoded ({type(error).__name__}); copy the log again from the vehicle")
    if decoded.file_corruption:
        refuse(path, "is corrupt: a message does not have its topic's size; copy the log again from the vehicle")
    topics: dict[str, list[Fields]] = {}
    for data in sorted(decoded.data_list, key=lambda data: data.multi_id):
        if "timestamp" in data.data:
            topics.setdefault(data.name, []).append(data.data)
    return _Log(path, topics, {}, notes)


def _esc_speeds(log: _Log) -> _Rotors | None:
    names = tuple(f"esc[{i}].esc_rpm" for i in range(4))
    series = log.series("esc_status", names)
    if series is None or series.t.size < 2:
        return None
    if not (np.abs(series.values) > 0).any(axis=0).all():
        log.notes.append("esc_status holds no speed of at least one rotor: commands are used")
        return None
    fields = log.topics["esc_status"][0]
    functions = [np.unique(fields.get(f"esc[{i}].actuator_function", np.zeros(1))) for i in range(4)]
    motors = [int(f[-1]) - _FIRST_MOTOR for f in functions]
    order = np.argsort(motors) if sorted(motors) == [0, 1, 2, 3] else np.arange(4)
    measured = np.isfinite(series.values).all(axis=1)
    if np.count_nonzero(measured) < 2:
        return None
    speeds = Series(series.t[measured], np.abs(series.values[measured])[:, order] * _RPM)
    return _Rotors(speeds, True, tuple(f"esc_status.{names[i]}" for i in order))


def _motor_commands(log: _Log) -> _Rotors | None:
    names = tuple(f"control[{i}]" for i in range(4))
    series = log.series("actuator_motors", names)
    if series is None or series.t.size < 2 or not np.isfinite(series.values).any():
        return None
    fields = log.topics["actuator_motors"][0]
    others = [i for i in range(4, 12) if np.nan_to_num(fields.get(f"control[{i}]", np.zeros(1))).any()]
    if others:
        refuse(log.path, f"actuator_motors drives {4 + len(others)} motors; give the log of a quadrotor")
    log.notes.append("commands are actuator_motors.control, taken as fractions of full-scale rotor speed")
    commands = Series(series.t, np.clip(np.nan_to_num(series.values), 0.0, 1.0))  # NaN means not armed
    return _Rotors(commands, False, tuple(f"actuator_motors.{name}" for name in names))


def _outputs(log: _Log) -> _Rotors | None:
    names = tuple(f"output[{i}]" for i in range(4))
    instances = range(len(log.topics.get("actuator_outputs", [])))
    found = [log.series("actuator_outputs", names, i) for i in instances]
    found = [s for s in found if s is not None and s.t.size > 1 and np.isfinite(s.values).all()]
    if not found:
        return None
    series = max(found, key=lambda each: float(each.values.std(axis=0).min()))
    turning = series.values[series.values > 1]
    kind, (low, high) = ("DShot", _DSHOT) if (turning < _LEAST_PWM).any() else ("PWM", _PWM)
    what = f"{kind} {low:g}..{high:g}, taken as fractions of full-scale rotor speed"
    log.notes.append(f"commands are actuator_outputs.output, {what}")
    series = Series(series.t, np.clip((series.values - low) / (high - low), 0.0, 1.0))
    return _Rotors(series, False, tuple(f"actuator_outputs.{name}" for name in names))


def _attitude(log: _Log) -> Series | None:
    series = log.series("vehicle_attitude", tuple(f"q[{i}]" for i in range(4)))
    if series is None:
        return None
    log.names.update(dict.fromkeys(("phi", "theta", "psi"), "vehicle_attitude.q"))
    return unwrapped(series.t, euler_angles(series.values) * _HALF_TURN)


def _position(log: _Log) -> Series | None:
    columns = tuple(_FLAGS)
    logged = log.topics.get("vehicle_local_position", [{}])[0]
    flags = {column: flag for column, flag in _FLAGS.items() if flag in logged}
    series = log.series("vehicle_local_position", (*columns, *flags.values()))
    if series is None:
        return None
    values = series.values[:, :6] * np.tile(_HALF_TURN, 2)
    for i, column in enumerate(flags):
        values[series.values[:, 6 + i] == 0, columns.index(column)] = np.nan
    log.names.update((name, f"vehicle_local_position.{name}") for name in columns)
    return Series(series.t, values)
