"""Flights in ULog files, the logs of PX4.

Read are, each from the first of the topics that is there:

- body rates: `vehicle_angular_velocity.xyz`, or `sensor_combined.gyro_rad` [rad/s]. Their samples are the rows: what
  was logged at other rates is brought to them (`jaxos4.logs._series`).
- specific force: `sensor_combined.accelerometer_m_s2`, or `vehicle_acceleration.xyz` [m/s^2].
- attitude: `vehicle_attitude.q` (w, x, y, z; from the body to the earth frame).
- position and velocity: `vehicle_local_position` `x, y, z` [m], `vx, vy, vz` [m/s], where its flags say they are valid.
- rotors: `esc_status.esc[0..3].esc_rpm` [rpm], measured, joined linearly; or commands, held: `actuator_motors.control
  [0..3]` [0..1], or `actuator_outputs.output[0..3]`, as PWM [1000..2000 us] or, where they go below 800, DShot
  [0..1999]. A command is taken for a fraction of the airframe's `max_rotor_speed`.

PX4's body has x forward, y right, z down, its earth x north, y east, z down. Ours has x forward, y left, z up, and
north, west, up, which is half a turn about x: y, z, q, r, theta and psi change their signs, x, p and phi do not.

Rotors keep PX4's numbers (of its quad X: 1 front right, 2 rear left, 3 front left, 4 rear right): the airframe's
`rotor_positions` and `rotor_spins` must be in the same order. Where `esc_status` says which motor an ESC turns
(`actuator_function`), its speeds are put in the motors' order.

A sample's time is its `timestamp_sample`, where there is one; `t` counts from the first one used.
"""

import contextlib
import io
import math
import os
from typing import NamedTuple

import numpy as np

from .._files import BROKEN
from ..errors import InputError
from ._series import Series, covered, driving, in_order, placed
from ._table import MAX_ROWS, Table, printable, refuse
from ._ulog_messages import needed_messages
from .resample import unwrap

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
_AXES = ("[0]", "[1]", "[2]")
_RATES = (("vehicle_angular_velocity", "xyz"), ("sensor_combined", "gyro_rad"))
_FORCES = (("sensor_combined", "accelerometer_m_s2"), ("vehicle_acceleration", "xyz"))
_HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: from forward, right, down to forward, left, up
_FIRST_MOTOR = 101  # PX4's number of the output function "Motor 1"
_RPM = 2 * math.pi / 60
_PWM, _DSHOT = (1000.0, 2000.0), (0.0, 1999.0)
_LEAST_PWM = 800.0
_REMEDY = "the log is broken there, or a sensor was: choose another log"

Fields = dict[str, np.ndarray]


class _Rotors(NamedTuple):
    series: Series
    measured: bool
    names: tuple[str, ...]


def read_ulog(path: str | os.PathLike[str]) -> tuple[Table, tuple[str, ...]]:
    """The columns of a PX4 log, and what was done to it; this module's docstring tells what is read.

    **Raises:** `InputError`, one line: file, topic and field, what is wrong and what to do.
    """
    shown = printable(os.fspath(path))
    notes: list[str] = []
    topics = _decoded(path, notes)
    names: dict[str, str] = {}
    rates = _vector(shown, topics, _RATES, ("p", "q", "r"), names, notes)
    if rates is None:
        refuse(shown, "holds no body rates; log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)")
    rotors = _rotors(shown, topics, notes)
    if rotors is None:
        refuse(shown, "holds no rotor speeds or commands; log esc_status, actuator_motors or actuator_outputs")
    inside = covered(rates.t, rotors.series.t)
    if np.count_nonzero(inside) < 2:
        refuse(shown, "rates and motors were not logged at the same time; record both in one flight")
    rates = Series(rates.t[inside], rates.values[inside])
    if rates.t.size > MAX_ROWS:
        refuse(shown, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
    rows = rates.t
    columns: dict[str, np.ndarray] = {"t": rows - rows[0]}
    columns.update(zip(("p", "q", "r"), (rates.values * _HALF_TURN).T, strict=True))
    driven = driving(rows, rotors.series, measured=rotors.measured)
    prefix = "omega" if rotors.measured else "command"
    for i, column in enumerate(driven.T):
        columns[f"{prefix}{i + 1}"] = column
        names[f"{prefix}{i + 1}"] = rotors.names[i]
    force = _vector(shown, topics, _FORCES, ("ax", "ay", "az"), names, notes)
    if force is not None:
        columns.update(zip(("ax", "ay", "az"), (placed(rows, force) * _HALF_TURN).T, strict=True))
    columns.update(_attitude(shown, topics, rows, names, notes))
    columns.update(_position(shown, topics, rows, names, notes))
    notes.append(
        f"rotors keep the log's numbers ({rotors.names[0]} is rotor 1): rotor_positions and rotor_spins must be in "
        "the same order"
    )
    return Table(shown, columns, first_row=None, names=names, remedy=_REMEDY), tuple(notes)


def _decoded(path: str | os.PathLike[str], notes: list[str]) -> dict[str, list[Fields]]:
    """The topics by name, each with its instances."""
    shown = printable(os.fspath(path))
    needed = needed_messages(path, TOPICS)
    if needed.left_out:
        notes.append(f"the log was cut while it was written: its last {needed.left_out} bytes are left out")
    try:
        from pyulog.core import ULog
        from pyulog.exceptions import ULogException
    except ImportError:
        raise InputError(f"{shown}: a ULog needs pyulog to be read; install jaxos4[ulog].") from None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(io.BytesIO(needed.content))
    except (*BROKEN, ULogException) as error:
        refuse(shown, f"cannot be decoded ({type(error).__name__}); copy the log again from the vehicle")
    if log.file_corruption:
        refuse(shown, "is corrupt: a message is not of its topic's size; copy the log again from the vehicle")
    topics: dict[str, list[Fields]] = {}
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if "timestamp" in data.data:
            topics.setdefault(data.name, []).append(data.data)
    return topics


def _times(path: str, topic: str, fields: Fields, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] that increase, and which samples they are of."""
    stamp = fields.get("timestamp_sample", fields["timestamp"])
    stamp = np.asarray(stamp if np.all(stamp > 0) else fields["timestamp"], dtype=float)
    kept = in_order(stamp)
    if kept is None:
        refuse(path, f"time runs backward in {topic}: it is corrupt; copy the log again from the vehicle")
    if not kept.all():
        notes.append(f"{topic}: {np.count_nonzero(~kept)} samples that came late are left out")
    return stamp[kept] / 1e6, np.flatnonzero(kept)


def _columns(fields: Fields, names: tuple[str, ...], index: np.ndarray) -> np.ndarray | None:
    if not all(name in fields for name in names):
        return None
    with np.errstate(all="ignore"):  # a damaged number need not be one
        values = np.column_stack([np.asarray(fields[name], dtype=float)[index] for name in names])
    return np.where(np.isfinite(values), values, np.nan)


def _vector(
    path: str,
    topics: dict[str, list[Fields]],
    sources: tuple[tuple[str, str], ...],
    columns: tuple[str, ...],
    names: dict[str, str],
    notes: list[str],
) -> Series | None:
    """The first of `sources` (topic, field) that was logged."""
    for topic, field in sources:
        fields = tuple(field + axis for axis in _AXES)
        for instance in topics.get(topic, [])[:1]:
            t, index = _times(path, topic, instance, notes)
            values = _columns(instance, fields, index)
            if values is not None and np.isfinite(values).any():
                names.update((c, f"{topic}.{f}") for c, f in zip(columns, fields, strict=True))
                return Series(t, values)
    return None


def _rotors(path: str, topics: dict[str, list[Fields]], notes: list[str]) -> _Rotors | None:
    for read in (_esc_speeds, _motor_commands, _outputs):
        rotors = read(path, topics, notes)
        if rotors is not None:
            return rotors
    return None


def _esc_speeds(path: str, topics: dict[str, list[Fields]], notes: list[str]) -> _Rotors | None:
    names = tuple(f"esc[{i}].esc_rpm" for i in range(4))
    for fields in topics.get("esc_status", [])[:1]:
        t, index = _times(path, "esc_status", fields, notes)
        values = _columns(fields, names, index)
        if values is None or t.size < 2:
            return None
        if not (np.abs(values) > 0).any(axis=0).all():
            notes.append("esc_status holds no speed of some rotor: commands are used")
            return None
        functions = [np.unique(fields.get(f"esc[{i}].actuator_function", np.zeros(1))) for i in range(4)]
        motors = [int(f[-1]) - _FIRST_MOTOR for f in functions]
        order = np.argsort(motors) if sorted(motors) == [0, 1, 2, 3] else np.arange(4)
        measured = np.isfinite(values).all(axis=1)
        series = Series(t[measured], np.abs(values[measured])[:, order] * _RPM)
        if series.t.size > 1:
            return _Rotors(series, True, tuple(f"esc_status.{names[i]}" for i in order))
    return None


def _motor_commands(path: str, topics: dict[str, list[Fields]], notes: list[str]) -> _Rotors | None:
    names = tuple(f"control[{i}]" for i in range(4))
    for fields in topics.get("actuator_motors", [])[:1]:
        t, index = _times(path, "actuator_motors", fields, notes)
        values = _columns(fields, names, index)
        if values is None or t.size < 2 or not np.isfinite(values).any():
            return None
        others = [i for i in range(4, 12) if np.nan_to_num(fields.get(f"control[{i}]", np.zeros(1))).any()]
        if others:
            refuse(
                path, f"actuator_motors drives {4 + len(others)} motors; this library knows four: no quadrotor's log"
            )
        notes.append("commands are actuator_motors.control, taken for fractions of full-scale rotor speed")
        series = Series(t, np.clip(np.nan_to_num(values), 0.0, 1.0))  # NaN: not armed
        return _Rotors(series, False, tuple(f"actuator_motors.{name}" for name in names))
    return None


def _outputs(path: str, topics: dict[str, list[Fields]], notes: list[str]) -> _Rotors | None:
    names = tuple(f"output[{i}]" for i in range(4))
    found: list[tuple[float, Series]] = []
    for fields in topics.get("actuator_outputs", []):
        t, index = _times(path, "actuator_outputs", fields, notes)
        values = _columns(fields, names, index)
        if values is not None and t.size > 1 and np.isfinite(values).all():
            found.append((float(values.std(axis=0).min()), Series(t, values)))
    if not found:
        return None
    series = max(found, key=lambda each: each[0])[1]
    turning = series.values[series.values > 1]
    kind, (low, high) = ("DShot", _DSHOT) if (turning < _LEAST_PWM).any() else ("PWM", _PWM)
    notes.append(
        f"commands are actuator_outputs.output, {kind} {low:g}..{high:g}, taken for fractions of full-scale rotor speed"
    )
    series = Series(series.t, np.clip((series.values - low) / (high - low), 0.0, 1.0))
    return _Rotors(series, False, tuple(f"actuator_outputs.{name}" for name in names))


def _attitude(
    path: str, topics: dict[str, list[Fields]], rows: np.ndarray, names: dict[str, str], notes: list[str]
) -> dict[str, np.ndarray]:
    for fields in topics.get("vehicle_attitude", [])[:1]:
        t, index = _times(path, "vehicle_attitude", fields, notes)
        q = _columns(fields, tuple(f"q[{i}]" for i in range(4)), index)
        if q is None:
            break
        with np.errstate(all="ignore"):
            w, x, y, z = (q / np.sqrt((q**2).sum(axis=1, keepdims=True))).T
        phi = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        theta = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        psi = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        angles = np.column_stack([unwrap(phi)[0], -theta, unwrap(-psi)[0]])
        names.update(dict.fromkeys(("phi", "theta", "psi"), "vehicle_attitude.q"))
        return dict(zip(("phi", "theta", "psi"), placed(rows, Series(t, angles)).T, strict=True))
    return {}


def _position(
    path: str, topics: dict[str, list[Fields]], rows: np.ndarray, names: dict[str, str], notes: list[str]
) -> dict[str, np.ndarray]:
    columns = ("x", "y", "z", "vx", "vy", "vz")
    for fields in topics.get("vehicle_local_position", [])[:1]:
        t, index = _times(path, "vehicle_local_position", fields, notes)
        values = _columns(fields, columns, index)
        if values is None:
            break
        flags = ("xy_valid", "xy_valid", "z_valid", "v_xy_valid", "v_xy_valid", "v_z_valid")
        for i, flag in enumerate(flags):
            if flag in fields:
                values[np.asarray(fields[flag])[index] == 0, i] = np.nan
        names.update((name, f"vehicle_local_position.{name}") for name in columns)
        values *= np.tile(_HALF_TURN, 2)
        return dict(zip(columns, placed(rows, Series(t, values)).T, strict=True))
    return {}
