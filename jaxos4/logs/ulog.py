"""ULog: the logs of PX4. Reading needs `pip install 'jaxos4[ulog]'`.

| column | topic and field of the log | unit in the log |
| --- | --- | --- |
| `p, q, r` | the fastest of `vehicle_angular_velocity`, `sensor_combined.gyro_rad`, `sensor_gyro` | rad/s |
| `ax, ay, az` | the fastest of `sensor_combined.accelerometer_m_s2`, `vehicle_acceleration`, `sensor_accel` | m/s^2 |
| `phi, theta, psi` | `vehicle_attitude.q`: w, x, y, z, from the body to the earth | |
| `x, y, z` | `vehicle_local_position.x, y, z`, while `xy_valid` and `z_valid` | m |
| `vx, vy, vz` | `vehicle_local_position.vx, vy, vz`, while `v_xy_valid` and `v_z_valid` | m/s |
| `omega1..4` | `esc_status.esc[0..3].esc_rpm`, interpolated linearly in the square | rpm |
| `command1..4` | `actuator_motors.control[0..3]`, if `esc_status` is missing or slow | 0..1 |
| `command1..4` | `actuator_outputs.output[0..3]`, if `actuator_motors` is missing or slow | PWM, DShot or UAVCAN |
| `voltage` | `battery_status.voltage_v` | V |

A command is held until the next one, and counts as a fraction of the airframe's `max_rotor_speed`. How commands become
such fractions: `jaxos4.logs.ulog_rotors`.

**Vehicles.** A vehicle that is not a quadrotor is refused. The log's facts (`jaxos4.logs.LogFacts`) are: the rates of
logging; the rotors' positions and spins, from `CA_ROTOR0_PX` and so on; when the land detector says "on the ground".

**Time.** A sample's time is its `timestamp_sample`, or its `timestamp`. `t` is 0 at the first sample used. The samples
of the body rates are the rows; samples at other rates are brought to them (`jaxos4.logs.sampling`). Sensors that are
faster than the rows are averaged, and so is a gyro that is faster than 1 kHz.

**Frames.** PX4's body has x forward, y right, z down; its earth has x north, y east, z down. Our body has x forward,
y left, z up; our earth has x north, y west, z up. A half turn about x leads from one to the other: y, z, q, r, theta
and psi change their signs; x, p and phi do not.

**Rotors.** They keep PX4's numbers (quad X: 1 front right, 2 rear left, 3 front left, 4 rear right). The airframe's
`rotor_positions` and `rotor_spins` must have the same order. If `actuator_function`, or a parameter such as
`PWM_MAIN_FUNC1`, says which motor an output drives, the outputs are put in the order of the motors.
"""

import math

import numpy as np

from .sampling import Series, attitude_of, gyro_rows, logged_rate
from .table import LogFacts, LogFormat, Path, Sampling, Table, needed, order_note, refuse
from .ulog_file import HALF_TURN, MAGIC, Source, Topics, decoded
from .ulog_rotors import TOPICS as ROTOR_TOPICS, rotors_of

_RATES = (
    Source("vehicle_angular_velocity", ("xyz[0]", "xyz[1]", "xyz[2]")),
    Source("sensor_combined", ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]")),
    Source("sensor_gyro", ("x", "y", "z"), "CAL_GYRO"),
)
_FORCES = (
    Source("sensor_combined", ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]")),
    Source("vehicle_acceleration", ("xyz[0]", "xyz[1]", "xyz[2]")),
    Source("sensor_accel", ("x", "y", "z"), "CAL_ACC"),
)
_TOPICS = (
    *(source.topic for source in (*_RATES, *_FORCES)),
    *ROTOR_TOPICS,
    *("vehicle_attitude", "vehicle_local_position", "vehicle_status", "vehicle_land_detected", "battery_status"),
)
_ANGLES = ("phi", "theta", "psi")
_FLAGS = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
_REMEDY = "the log is corrupt there, or a sensor failed: choose another log"
_MOTORS = 12  # the most that PX4 can drive

_ONLY = "only a quadrotor can be identified: give the log of one"
_VTOL = "a VTOL"
# Types of MAVLink (MAV_TYPE), and of PX4's control allocation (CA_AIRFRAME). Types that are missing here can be quads.
_MAV_TYPES = {
    **{1: "a fixed wing", 3: "a coaxial helicopter", 4: "a helicopter", 7: "an airship", 10: "a rover", 11: "a boat"},
    **{12: "a submarine", 13: "a hexarotor", 14: "an octorotor", 15: "a tricopter", 29: "a dodecarotor"},
    **dict.fromkeys(range(19, 26), _VTOL),
    35: "a decarotor",
}
_CA_AIRFRAMES = {
    **{1: "a fixed wing", 2: _VTOL, 3: _VTOL, 4: _VTOL, 5: "a rover", 6: "a rover", 8: "a multirotor that tilts"},
    **{10: "a helicopter", 11: "a helicopter", 12: "a coaxial helicopter"},
}
_VEHICLE_TYPES = {2: "a fixed wing", 3: "a rover", 4: "an airship"}  # of the topic vehicle_status
_GROUND = ("landed", "maybe_landed", "ground_contact")
_HIGHEST_VOLTAGE = 200.0  # [V]


def read_ulog(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a PX4 log, and notes on what was assumed. Raises `InputError`."""
    log = decoded(path, _TOPICS)
    _check_vehicle(log)
    remedy = "log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)"
    rates, gyro = needed(path, log.fastest(_RATES, ("p", "q", "r")), "body rates", remedy)
    remedy = "log esc_status, actuator_motors or actuator_outputs"
    rotors = needed(path, rotors_of(log), "rotor speeds or commands", remedy)
    prefix = "omega" if rotors.measured else "command"
    log.names.update((f"{prefix}{i + 1}", name) for i, name in enumerate(rotors.names))
    force = log.fastest(_FORCES, ("ax", "ay", "az"))
    others = {
        ("ax", "ay", "az"): None if force is None else force[0],
        _ANGLES: _attitude(log),
        tuple(_FLAGS): _position(log),
        ("voltage",): _voltage(log),
    }
    rows, columns = gyro_rows(path, rates, rotors.series, measured=rotors.measured, others=others)
    log.notes.extend([rotors.note] if rotors.note else [])
    log.notes.append(order_note(rotors.names[0]))
    facts = _facts(log, rows, Sampling(rotors.topic, rotors.rate), Sampling(gyro, logged_rate(rates.t)))
    return Table(path, columns, first_row=None, names=log.names, remedy=_REMEDY, facts=facts), tuple(log.notes)


ULOG = LogFormat("ULog", "PX4 ULog", lambda begin: begin.startswith(MAGIC[:4]), read_ulog)


def _attitude(log: Topics) -> Series | None:
    series = log.series("vehicle_attitude", tuple(f"q[{i}]" for i in range(4)))
    if series is None:
        return None
    log.names.update(dict.fromkeys(_ANGLES, "vehicle_attitude.q"))
    angles = attitude_of(series.t, series.values)
    return Series(series.t, angles.values * HALF_TURN)


def _position(log: Topics) -> Series | None:
    columns = tuple(_FLAGS)
    logged = log.fields("vehicle_local_position")
    flags = {column: flag for column, flag in _FLAGS.items() if flag in logged}
    series = log.series("vehicle_local_position", (*columns, *flags.values()))
    if series is None:
        return None
    values = series.values[:, :6] * np.tile(HALF_TURN, 2)
    for i, column in enumerate(flags):
        values[series.values[:, 6 + i] == 0, columns.index(column)] = np.nan
    log.names.update((name, f"vehicle_local_position.{name}") for name in columns)
    return Series(series.t, values)


def _check_vehicle(log: Topics) -> None:
    """Refuse a vehicle that is not a quadrotor: servos and more motors would be read as rotors. Raises `InputError`."""
    status, parameter = "vehicle_status", log.parameters.get
    if log.fields(status).get("is_vtol", np.zeros(1)).any():
        _refuse(log, _VTOL, f"{status}.is_vtol")
    system = log.latest(status, "system_type")
    for value, kinds, name, place in (
        (system, _MAV_TYPES, f"{status}.system_type", "field"),
        (parameter("MAV_TYPE"), _MAV_TYPES, "MAV_TYPE", "parameter"),
        (log.latest(status, "vehicle_type"), _VEHICLE_TYPES, f"{status}.vehicle_type", "field"),
        (parameter("CA_AIRFRAME"), _CA_AIRFRAMES, "CA_AIRFRAME", "parameter"),
    ):
        if value is not None and int(value) in kinds:
            _refuse(log, kinds[int(value)], name, place)
    rotors = int(parameter("CA_ROTOR_COUNT", 0.0))
    if rotors not in (0, 4):
        _refuse(log, f"a vehicle with {rotors} rotors", "CA_ROTOR_COUNT", "parameter")
    motors = log.fields("actuator_motors")
    others = [i for i in range(4, _MOTORS) if np.nan_to_num(motors.get(f"control[{i}]", np.zeros(1))).any()]
    if others:
        _refuse(log, f"a vehicle that drives {4 + len(others)} motors", f"actuator_motors.control[{others[0]}]")


def _refuse(log: Topics, what: str, name: str, kind: str = "field") -> None:
    refuse(log.path, f"this is {what}; {_ONLY}", column=name, kind=kind)


def _facts(log: Topics, rows: np.ndarray, motors: Sampling, gyro: Sampling) -> LogFacts:
    """The facts of the log; `rows`: the times of the flight's samples [s], in the log's time."""
    positions = [[log.parameters.get(f"CA_ROTOR{i}_P{axis}", math.nan) for axis in "XY"] for i in range(4)]
    moments = [log.parameters.get(f"CA_ROTOR{i}_KM", math.nan) for i in range(4)]
    known = log.parameters.get("CA_ROTOR_COUNT") == 4
    # PX4's y points to the right. Generic airframes say 1 m, because only the directions of the rotors matter to PX4.
    placed = known and np.isfinite(positions).all() and not np.isin(np.abs(positions), (0.0, 1.0)).all()
    spun = known and all(moment != 0 and math.isfinite(moment) for moment in moments)
    cells = (log.latest("battery_status", "cell_count"), log.parameters.get("BAT1_N_CELLS"))
    cells = next((int(each) for each in (*cells, log.parameters.get("BAT_N_CELLS")) if each and each > 0), None)
    return LogFacts(
        motors,
        gyro,
        faster=_faster(log),
        landed=_landed(log, rows),
        rotor_positions=tuple((float(x), -float(y)) for x, y in positions) if placed else None,
        rotor_spins=tuple(math.copysign(1.0, moment) for moment in moments) if spun else None,
        cells=cells,
    )


def _voltage(log: Topics) -> Series | None:
    """The battery's voltage [V]."""
    for name in ("voltage_v", "voltage_filtered_v"):
        series = log.series("battery_status", (name,))
        if series is not None:
            log.names["voltage"] = f"battery_status.{name}"
            possible = (series.values > 0) & (series.values < _HIGHEST_VOLTAGE)
            return Series(series.t, np.where(possible, series.values, np.nan))
    return None


def _landed(log: Topics, rows: np.ndarray) -> tuple[tuple[float, float], ...]:
    """When PX4's land detector says that the vehicle touches the ground [s], from the first row on."""
    names = [name for name in _GROUND if name in log.fields("vehicle_land_detected")]
    series = log.series("vehicle_land_detected", names) if names else None
    if series is None:
        return ()
    on_ground = (series.values > 0).any(axis=1)
    begins, ends = series.t, np.append(series.t[1:], np.inf)  # a state holds until the next one
    begins, ends = np.maximum(begins, rows[0])[on_ground], np.minimum(ends, rows[-1])[on_ground]
    found: list[tuple[float, float]] = []
    for begin, end in zip((begins - rows[0]).tolist(), (ends - rows[0]).tolist(), strict=True):
        if end < begin:
            continue
        if found and begin <= found[-1][1]:
            begin = found.pop()[0]
        found.append((begin, end))
    return tuple(found)


def _faster(log: Topics) -> str:
    """Advice to make PX4 log faster. Reference: `logged_topics.cpp` of PX4, `add_high_rate_topics`."""
    profile, high_rate = int(log.parameters.get("SDLOG_PROFILE", 1.0)), 16
    if profile & high_rate:
        return "log esc_status or actuator_motors at full rate (logger_topics.txt on the card), and fly again"
    return f"set SDLOG_PROFILE to {profile | high_rate} (which includes {high_rate}, 'high rate'), and fly again"
