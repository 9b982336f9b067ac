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
of the body rates are the rows; samples at other rates are brought to them (`jaxos4.logs.series`). Sensors that are
faster than the rows are averaged, and so is a gyro that is faster than 1 kHz.

**Frames.** PX4's body has x forward, y right, z down; its earth has x north, y east, z down. Our body has x forward,
y left, z up; our earth has x north, y west, z up. A half turn about x leads from one to the other: y, z, q, r, theta
and psi change their signs; x, p and phi do not.

**Rotors.** They keep PX4's numbers (quad X: 1 front right, 2 rear left, 3 front left, 4 rear right). The airframe's
`rotor_positions` and `rotor_spins` must have the same order. If `actuator_function`, or a parameter such as
`PWM_MAIN_FUNC1`, says which motor an output drives, the outputs are put in the order of the motors.
"""

import numpy as np

from . import ulog_rotors, ulog_vehicle
from .facts import Sampling, logged_rate
from .series import Series, at_rows, euler_angles, gyro_rows, unwrapped
from .table import LogFormat, Path, Table, refuse
from .ulog_messages import MAGIC
from .ulog_rotors import rotors_of
from .ulog_topics import HALF_TURN, Source, Topics, decoded
from .ulog_vehicle import check_vehicle, vehicle_facts, voltage

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
TOPICS = (
    *(source.topic for source in (*_RATES, *_FORCES)),
    *("vehicle_attitude", "vehicle_local_position"),
    *ulog_rotors.TOPICS,
    *ulog_vehicle.TOPICS,
)
_FLAGS = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
_REMEDY = "the log is corrupt there, or a sensor failed: choose another log"


def read_ulog(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a PX4 log, and notes on what was assumed. Raises `InputError`."""
    log = decoded(path, TOPICS)
    check_vehicle(log)
    found = log.fastest(_RATES, ("p", "q", "r"))
    if found is None:
        refuse(path, "holds no body rates; log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)")
    rates, gyro = found
    rotors = rotors_of(log)
    if rotors is None:
        refuse(path, "holds no rotor speeds or commands; log esc_status, actuator_motors or actuator_outputs")
    rows, columns = gyro_rows(path, rates, rotors.series, measured=rotors.measured)
    prefix = "omega" if rotors.measured else "command"
    log.names.update((f"{prefix}{i + 1}", name) for i, name in enumerate(rotors.names))
    forces = log.fastest(_FORCES, ("ax", "ay", "az"))
    others = {
        ("ax", "ay", "az"): None if forces is None else forces[0],
        ("phi", "theta", "psi"): _attitude(log),
        tuple(_FLAGS): _position(log),
        ("voltage",): voltage(log),
    }
    for names, series in others.items():
        if series is not None:
            columns.update(zip(names, at_rows(rows, series).T, strict=True))
    if rotors.note:
        log.notes.append(rotors.note)
    what = f"rotors keep the log's numbers ({rotors.names[0]} is rotor 1)"
    log.notes.append(f"{what}: rotor_positions and rotor_spins must be in the same order")
    facts = vehicle_facts(log, rows)._replace(
        motors=Sampling(rotors.topic, rotors.rate), gyro=Sampling(gyro, logged_rate(rates.t))
    )
    return Table(path, columns, first_row=None, names=log.names, remedy=_REMEDY, facts=facts), tuple(log.notes)


ULOG = LogFormat("ULog", "PX4 ULog", lambda begin: begin.startswith(MAGIC[:4]), read_ulog)


def _attitude(log: Topics) -> Series | None:
    series = log.series("vehicle_attitude", tuple(f"q[{i}]" for i in range(4)))
    if series is None:
        return None
    log.names.update(dict.fromkeys(("phi", "theta", "psi"), "vehicle_attitude.q"))
    return unwrapped(series.t, euler_angles(series.values) * HALF_TURN)


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
