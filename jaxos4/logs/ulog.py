"""ULog: the logs of PX4. Topics, frames and commands: docs/logs.md.

Reference: `FunctionMotors::updateValues`, `MixingOutput` and `logged_topics.cpp` of PX4.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .sampling import HALF_TURN, Series, attitude, gyro_rows, logged_rate, unwrapped
from .table import LIMITS, LogFacts, LogFormat, Path, Sampling, Table, fast_enough, needed, order_note, refuse
from .ulog_file import MAGIC, Topics, decoded

_RATES = {"vehicle_angular_velocity": "xyz", "sensor_combined": "gyro_rad"}
_FORCES = {"sensor_combined": "accelerometer_m_s2", "vehicle_acceleration": "xyz"}
_TOPICS = (
    *(*_RATES, *_FORCES),
    *("esc_status", "actuator_motors", "actuator_outputs"),
    *("vehicle_attitude", "vehicle_local_position", "vehicle_status", "vehicle_land_detected", "battery_status"),
)
_ANGLES = ("phi", "theta", "psi")
_FLAGS = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
_REMEDY = "the log is corrupt there, or a sensor failed: choose another log"
_MOTORS = 12  # the most that PX4 can drive
# Types of MAVLink, of PX4's control allocation and of its state that are no quadrotors. Others can be quadrotors.
_OTHER_MAV_TYPES = {1, 3, 4, 7, *range(10, 16), *range(19, 26), 29, 35}
_OTHER_AIRFRAMES, _OTHER_VEHICLES = {1, 2, 3, 4, 5, 6, 8, 10, 11, 12}, {2, 3, 4}
_GROUND = ("landed", "maybe_landed", "ground_contact")
_FIRST_MOTOR = 101  # PX4's number of the output function "Motor 1"
_RPM = 2 * math.pi / 60
_OUTPUTS, _TIMERS = 16, 8  # of one driver
_BANKS = ("PWM_MAIN", "PWM_AUX", "PWM_EXTRA", "UAVCAN_EC")
_OTHER_BANKS = ("SIM_GZ_EC", "HIL_ACT")  # simulators, whose outputs have other units
_LEAST_PWM, _HIGHEST_PWM = 800.0, 2200.0  # [us]
_PWM, _DSHOT, _UAVCAN = (1000.0, 2000.0), 1999.0, (1.0, 8191.0)
_CAN, _DSHOT_LINK = 4, 5  # ESC_CONNECTION_TYPE_CAN, ESC_CONNECTION_TYPE_DSHOT
_DSHOT_TIMERS = range(-5, -1)  # DShot150 to DShot1200, as values of PWM_MAIN_TIM0 and so on


def read_ulog(path: Path) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a PX4 log, and notes on what was assumed. Raises `InputError`."""
    log = decoded(path, _TOPICS)
    _check_vehicle(log)
    remedy = "log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)"
    rates, gyro = needed(path, log.fastest(_RATES, ("p", "q", "r")), "body rates", remedy)
    remedy = "log esc_status, actuator_motors or actuator_outputs"
    rotors = needed(path, _rotors(log), "rotor speeds or commands", remedy)
    names = [f"{rotors.topic}.{field}" for field in rotors.fields]
    prefix = "omega" if rotors.measured else "command"
    log.names.update((f"{prefix}{i}", name) for i, name in enumerate(names, start=1))
    force = log.fastest(_FORCES, ("ax", "ay", "az"))
    others = {
        ("ax", "ay", "az"): None if force is None else force[0],
        _ANGLES: _attitude(log),
        tuple(_FLAGS): _position(log),
        ("voltage",): _voltage(log),
    }
    table = Table(path, {}, first_row=None, names=log.names, remedy=_REMEDY)
    rows, table = gyro_rows(table, rates, rotors.series, measured=rotors.measured, others=others)
    log.notes.extend(filter(None, (rotors.note, order_note(names[0]))))
    sampling = {"motors": Sampling(rotors.topic, rotors.rate), "gyro": Sampling(gyro, logged_rate(rates.t))}
    facts = _facts(log, rows)._replace(**sampling)
    return table._replace(facts=facts), tuple(log.notes)


ULOG = LogFormat("ULog", "PX4 ULog", lambda begin: begin.startswith(MAGIC[:4]), read_ulog)


def _check_vehicle(log: Topics) -> None:
    """Refuse a vehicle that is not a quadrotor: servos and more motors would be read as rotors. Raises `InputError`."""
    status, get, motors = "vehicle_status", log.parameters.get, log.fields("actuator_motors")
    more = [i for i in range(4, _MOTORS) if np.nan_to_num(motors.get(f"control[{i}]", np.zeros(1))).any()]
    others = {
        f"field {status}.is_vtol": log.fields(status).get("is_vtol", np.zeros(1)).any(),
        f"field {status}.system_type": log.latest(status, "system_type") in _OTHER_MAV_TYPES,
        f"field {status}.vehicle_type": log.latest(status, "vehicle_type") in _OTHER_VEHICLES,
        "parameter MAV_TYPE": get("MAV_TYPE") in _OTHER_MAV_TYPES,
        "parameter CA_AIRFRAME": get("CA_AIRFRAME") in _OTHER_AIRFRAMES,
        "parameter CA_ROTOR_COUNT": get("CA_ROTOR_COUNT", 0.0) not in (0.0, 4.0),
        f"field actuator_motors.control[{more[0] if more else 4}]": bool(more),
    }
    for place, other in others.items():
        if other:
            refuse(log.path, f"{place}: this is no quadrotor; give the log of a quadrotor")


def _attitude(log: Topics) -> Series | None:
    series = log.series("vehicle_attitude", [f"q[{i}]" for i in range(4)])
    if series is None:
        return None
    log.names.update(dict.fromkeys(_ANGLES, "vehicle_attitude.q"))
    return Series(series.t, unwrapped(series.t, attitude(series.values)).values * HALF_TURN)


def _position(log: Topics) -> Series | None:
    topic = "vehicle_local_position"
    flags = {column: flag for column, flag in _FLAGS.items() if flag in log.fields(topic)}
    series = log.series(topic, (*_FLAGS, *flags.values()))
    if series is None:
        return None
    values = series.values[:, :6] * np.tile(HALF_TURN, 2)
    for i, column in enumerate(flags):
        values[series.values[:, 6 + i] == 0, list(_FLAGS).index(column)] = np.nan
    log.names.update((name, f"{topic}.{name}") for name in _FLAGS)
    return Series(series.t, values)


def _voltage(log: Topics) -> Series | None:
    series = log.series("battery_status", ("voltage_v",))
    if series is None:
        return None
    log.names["voltage"] = "battery_status.voltage_v"
    possible = (series.values > 0) & (series.values < LIMITS["voltage"].largest)
    return Series(series.t, np.where(possible, series.values, np.nan))


def _facts(log: Topics, rows: np.ndarray) -> LogFacts:
    """The facts of the log; `rows`: the times of the flight's samples [s], in the log's time."""
    get = log.parameters.get
    positions = [[get(f"CA_ROTOR{i}_P{axis}", math.nan) for axis in "XY"] for i in range(4)]
    moments = [get(f"CA_ROTOR{i}_KM", math.nan) for i in range(4)]
    known = get("CA_ROTOR_COUNT") == 4
    # PX4's y points to the right. Generic airframes say 1 m, because only the directions of the rotors matter to PX4.
    placed = known and np.isfinite(positions).all() and not np.isin(np.abs(positions), (0.0, 1.0)).all()
    spun = known and all(moment != 0 and math.isfinite(moment) for moment in moments)
    profile, high_rate = int(get("SDLOG_PROFILE", 1.0)), 16  # `add_high_rate_topics`
    faster = f"set SDLOG_PROFILE to {profile | high_rate} (which includes {high_rate}, 'high rate'), and fly again"
    if profile & high_rate:
        faster = "log esc_status or actuator_motors at full rate (logger_topics.txt on the card), and fly again"
    return LogFacts(
        faster=faster,
        landed=_landed(log, rows),
        rotor_positions=tuple((float(x), -float(y)) for x, y in positions) if placed else None,
        rotor_spins=tuple(math.copysign(1.0, moment) for moment in moments) if spun else None,
    )


def _landed(log: Topics, rows: np.ndarray) -> tuple[tuple[float, float], ...]:
    """When PX4's land detector says that the vehicle touches the ground [s], from the first row on."""
    names = [name for name in _GROUND if name in log.fields("vehicle_land_detected")]
    series = log.series("vehicle_land_detected", names) if names else None
    if series is None:
        return ()
    changes = np.flatnonzero(np.diff((series.values > 0).any(axis=1), prepend=False, append=False))
    times = np.append(series.t, np.inf)[changes]  # a state holds until the next one
    begins, ends = np.maximum(times[::2], rows[0]) - rows[0], np.minimum(times[1::2], rows[-1]) - rows[0]
    return tuple((a, b) for a, b in zip(begins.tolist(), ends.tolist(), strict=True) if a <= b)


class _Rotors(NamedTuple):
    """Speeds [rad/s] or commands [0..1] of the four rotors, their topic and fields, and what was assumed."""

    series: Series
    topic: str
    fields: Sequence[str]
    note: str = ""

    @property
    def measured(self) -> bool:
        return self.topic == "esc_status"

    @property
    def rate(self) -> float:
        return logged_rate(self.series.t)


def _rotors(log: Topics) -> _Rotors | None:
    """Measured speeds, or the motors' commands, or the outputs: the first that was logged often enough.

    If none was, the one that was logged most often.
    """
    every = [found for find in (_speeds, _motors, _outputs) if (found := find(log)) is not None]
    rarely = max(every, key=lambda each: each.rate, default=None)
    chosen = next((each for each in every if fast_enough(each.rate)), rarely)
    if chosen is not None and every[0].measured and not chosen.measured:
        log.notes.append(f"measured speeds (esc_status) were logged at {every[0].rate:.2g} Hz only: commands are used")
    return chosen


def _speeds(log: Topics) -> _Rotors | None:
    names = [f"esc[{i}].esc_rpm" for i in range(4)]
    series = log.series("esc_status", names)
    if series is None or series.t.size < 2:
        return None
    if not (np.abs(series.values) > 0).any(axis=0).all():
        log.notes.append("esc_status holds no speed of at least one rotor: commands are used")
        return None
    functions = [int(log.latest("esc_status", f"esc[{i}].actuator_function") or 0) for i in range(4)]
    order = _motor_order(functions) or range(4)
    measured = np.isfinite(series.values).all(axis=1)
    if np.count_nonzero(measured) < 2:
        return None
    speeds = Series(series.t[measured], np.abs(series.values[measured])[:, order] * _RPM)
    return _Rotors(speeds, "esc_status", [names[i] for i in order])


def _motors(log: Topics) -> _Rotors | None:
    names = [f"control[{i}]" for i in range(4)]
    series = log.series("actuator_motors", names)
    if series is None or series.t.size < 2 or not np.isfinite(series.values).any():
        return None
    shares = np.clip(np.nan_to_num(series.values), 0.0, 1.0)  # NaN means not armed
    curve, what = _thrust_curve(log)
    note = f"commands are actuator_motors.control, {what}"
    return _Rotors(Series(series.t, np.sqrt(shares) if curve else shares), "actuator_motors", names, note)


def _outputs(log: Topics) -> _Rotors | None:
    place = _bank_of_motors(log)
    if place is None:
        return None
    names = [f"output[{i}]" for i in place[1]]
    found = [log.series("actuator_outputs", names, i) for i in range(len(log.topics.get("actuator_outputs", [])))]
    found = [s for s in found if s is not None and s.t.size > 1 and np.isfinite(s.values).all()]
    if not found:
        return None
    series = max(found, key=lambda each: float(each.values.std(axis=0).min()))
    kind, low, high = _limits(log, series.values, *place)
    shares = np.clip((series.values - low) / (high - low), 0.0, 1.0)
    curve, what = _thrust_curve(log)
    speeds = np.sqrt(curve * shares**2 + (1 - curve) * shares) if curve else shares
    note = f"commands are actuator_outputs.output, {kind} {low.min():g}..{high.max():g}, {what}"
    return _Rotors(Series(series.t, speeds), "actuator_outputs", names, note)


def _thrust_curve(log: Topics) -> tuple[float, str]:
    """THR_MDL_FAC, 0 if it is not known, and what follows for the speeds."""
    curve = log.parameters.get("THR_MDL_FAC", 0.0)
    if 0 < curve <= 1:
        return curve, f"taken as fractions of full-scale rotor speed by THR_MDL_FAC = {curve:.3g}"
    return 0.0, (
        "taken as fractions of full-scale rotor speed, because THR_MDL_FAC is 0: the thrust curve was not measured "
        "(the term motor of a vehicle fits it, if the accelerometer was logged)"
    )


def _bank_of_motors(log: Topics) -> tuple[str, list[int]] | None:
    """The beginning of the parameters' names of the outputs of motors 1 to 4, and these outputs.

    None if the log says which motor an output drives, but no driver has all four motors. Old PX4: the first of MAIN.
    """
    for bank in _BANKS:
        order = _motor_order([int(log.parameters.get(f"{bank}_FUNC{i + 1}", 0.0)) for i in range(_OUTPUTS)])
        if order is not None:
            return bank, order
    unknown = not any(f"{bank}_FUNC1" in log.parameters for bank in (*_BANKS, *_OTHER_BANKS))
    return ("PWM_MAIN", [0, 1, 2, 3]) if unknown else None


def _motor_order(functions: list[int]) -> list[int] | None:
    """The places of motors 1 to 4 among the outputs with these functions; None if one of them is missing."""
    motors = range(_FIRST_MOTOR, _FIRST_MOTOR + 4)
    return [functions.index(motor) for motor in motors] if set(motors) <= set(functions) else None


def _limits(log: Topics, values: np.ndarray, bank: str, channels: list[int]) -> tuple[str, np.ndarray, np.ndarray]:
    """The protocol, and the values of each output at which its motor idles and is at full speed."""
    turning, get = values[values > 1], log.parameters.get
    small, link = (turning < _LEAST_PWM).any(), log.latest("esc_status", "esc_connectiontype")
    timers = {get(f"{bank}_TIM{i}") for i in range(_TIMERS)}
    kind, names, possible, default = "PWM", [f"{bank}_", "PWM_"], (_LEAST_PWM, _HIGHEST_PWM), _PWM
    if bank == "UAVCAN_EC" or (turning > _HIGHEST_PWM).any() or (small and link == _CAN):
        kind, names, possible, default = "UAVCAN", ["UAVCAN_EC_"], (0.0, 8191.0), _UAVCAN
    elif small or link == _DSHOT_LINK or get("DSHOT_CONFIG", 0.0) > 0 or timers & set(_DSHOT_TIMERS):
        least = get("DSHOT_MIN", 0.0)
        kind, names, default = "DShot", [], (_DSHOT * least if 0 <= least < 0.5 else 0.0, _DSHOT)

    def known(end: int, channel: int) -> float:
        """By the output's number, else of the bank, else the default."""
        every = [get(f"{name}{('MIN', 'MAX')[end]}{number}") for name in names for number in (channel + 1, "")]
        return next((each for each in every if each is not None and possible[0] <= each <= possible[1]), default[end])

    low, high = (np.array([known(end, channel) for channel in channels]) for end in (0, 1))
    right = low < high
    return kind, np.where(right, low, default[0]), np.where(right, high, default[1])
