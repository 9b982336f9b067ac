"""ULog: the logs of PX4, decoded by pyulog. Topics, frames and commands: docs/logs.md.

Reference: `FunctionMotors::updateValues`, `MixingOutput` and `logged_topics.cpp` of PX4.
"""

import contextlib
import functools
import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._files import reading
from ..flight import ANGLE_NAMES, FORCE_NAMES, RATE_NAMES
from ..rotations import HALF_TURN, euler_angles
from .columns import column_map
from .messages import Fields, Messages, MessageSource, Names, Rotors, motor_order
from .sampling import Series, logged_rate, runs
from .table import LogFormat, LogPath, Table, fast_enough, items, read_bytes, refuse
from .values import RPM

_MAGIC = b"ULog"
_MOVING = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
_BRIDGE = "px4-ros2", "/fmu/out/"
"""The preset that names the topics of PX4's bridge to ROS 2, which are those of its logs, and how their names begin."""
_COLUMNS: tuple[Names, ...] = (RATE_NAMES, FORCE_NAMES, ("voltage",))
_TOPICS = """
    esc_status actuator_motors actuator_outputs vehicle_attitude vehicle_local_position vehicle_status
    vehicle_land_detected
""".split()
# Types of MAVLink, of PX4's control allocation and of its state that are no quadrotors. Others can be quadrotors.
_OTHER_MAV_TYPES = {1, 3, 4, 7, *range(10, 16), *range(19, 26), 29, 35}
_OTHER_AIRFRAMES, _OTHER_VEHICLES = {1, 2, 3, 4, 5, 6, 8, 10, 11, 12}, {2, 3, 4}
_ESC_SPEEDS = [f"esc[{i}].esc_rpm" for i in range(4)]
_MOTORS = range(101, 105)  # PX4's numbers of the output functions "Motor 1" to "Motor 4"
_BANKS = ("PWM_MAIN", "PWM_AUX", "PWM_EXTRA", "UAVCAN_EC")
_OTHER_BANKS = ("SIM_GZ_EC", "HIL_ACT")  # simulators, whose outputs have other units
_REMEDY = "the log is corrupt there, or a sensor failed: choose another log"


# By protocol: the values of motors' outputs at idle and at full speed, the parameters that hold others, their limits.
_PROTOCOLS: dict[str, tuple[tuple[float, float], tuple[str, ...], tuple[float, float]]] = {
    "PWM": ((1000.0, 2000.0), ("{bank}_", "PWM_"), (800.0, 2200.0)),
    "UAVCAN": ((1.0, 8191.0), ("UAVCAN_EC_",), (0.0, 8191.0)),
    "DShot": ((0.0, 1999.0), (), (0.0, 0.0)),
}
_LINKS = {4: "UAVCAN", 5: "DShot"}  # ESC_CONNECTION_TYPE_CAN, ESC_CONNECTION_TYPE_DSHOT
_DSHOT_TIMERS = range(-5, -1)  # DShot150 to DShot1200, as values of PWM_MAIN_TIM0 and so on


def read_ulog(path: LogPath) -> tuple[Table, tuple[str, ...]]:
    """Read the columns of a PX4 log, and notes on what was assumed. Raises `InputError`."""
    log = _decoded(path)
    _check_vehicle(log)
    turned = log.series("vehicle_attitude", items("q", 4))
    log.names.update(dict.fromkeys(ANGLE_NAMES, "vehicle_attitude.q"))
    found: dict[Names, Series | None] = {columns: log.fastest(columns, _sources(columns)) for columns in _COLUMNS}
    found[ANGLE_NAMES] = None if turned is None else Series(turned.t, euler_angles(turned.values) * HALF_TURN)
    found[tuple(_MOVING)] = _position(log)
    return log.table(
        found,
        _rotors(log),
        remedies=(
            "log vehicle_angular_velocity or sensor_combined (SDLOG_PROFILE)",
            "log esc_status, actuator_motors or actuator_outputs",
        ),
        is_ordered=True,
        landed=_landed(log),
        **_facts(log),
    )


ULOG = LogFormat("ULog", "PX4 ULog", lambda begin: begin.startswith(_MAGIC), read_ulog)


@functools.cache
def _sources(columns: Names) -> list[MessageSource]:
    """The topics of some columns, their fields, and the factors to our units and frame."""
    preset, begin = _BRIDGE
    given = [column_map(preset).sources[name] for name in columns]
    factors = np.array([each.factor for each in given])
    places = zip(*(each.names for each in given), strict=True)
    fields = [[name.removeprefix(begin).split(".") for name in names] for names in places]
    return [(every[0][0], [field for _, field in every], factors) for every in fields]


def _check_vehicle(log: Messages) -> None:
    """Refuse a vehicle that is not a quadrotor: servos and more motors would be read as rotors. Raises `InputError`."""
    status, get, motors = "vehicle_status", log.parameters.get, log.of("actuator_motors")
    more = [i for i in range(4, 12) if np.nan_to_num(motors.get(f"control[{i}]", np.zeros(1))).any()]
    others = {
        f"field {status}.is_vtol": log.of(status).get("is_vtol", np.zeros(1)).any(),
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


def _position(log: Messages) -> Series | None:
    topic = "vehicle_local_position"
    flags = {column: flag for column, flag in _MOVING.items() if flag in log.of(topic)}
    series = log.series(topic, (*_MOVING, *flags.values()))
    if series is None:
        return None
    values = series.values[:, :6] * np.tile(HALF_TURN, 2)
    for i, column in enumerate(flags):
        values[series.values[:, 6 + i] == 0, list(_MOVING).index(column)] = np.nan
    log.name(tuple(_MOVING), topic, tuple(_MOVING))
    return Series(series.t, values)


def _facts(log: Messages) -> dict[str, Any]:
    """Fields of `LogFacts` that the parameters state."""
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
    return {
        "faster": faster,
        "rotor_positions": tuple((float(x), -float(y)) for x, y in positions) if placed else None,
        "rotor_spins": tuple(math.copysign(1.0, moment) for moment in moments) if spun else None,
    }


def _landed(log: Messages) -> list[tuple[float, float]]:
    """From when to when PX4's land detector says that the vehicle touches the ground [s]."""
    topic = "vehicle_land_detected"
    states = {"landed", "maybe_landed", "ground_contact"} & log.of(topic).keys()
    series = log.series(topic, sorted(states), fewest=1)
    if series is None or not series.values.size:
        return []
    times = np.append(series.t, np.inf).tolist()  # a state holds until the next one
    return [(times[begin], times[end]) for begin, end in runs(np.asarray((series.values > 0).any(axis=1)))]


def _rotors(log: Messages) -> Rotors | None:
    """Measured speeds, the motors' commands or the outputs: the first that is fast enough, or else the fastest."""
    every = [found for find in (_speeds, _motors, _outputs) if (found := find(log)) is not None]
    rates = [logged_rate(each.series.t) for each in every]
    if not every:
        return None
    chosen = every[next((i for i, rate in enumerate(rates) if fast_enough(rate)), rates.index(max(rates)))]
    if every[0].is_measured and not chosen.is_measured:
        log.notes.append(f"measured speeds (esc_status) were logged at {rates[0]:.2g} Hz only: commands are used")
    elif not chosen.is_measured and log.series("esc_status", _ESC_SPEEDS) is not None:
        log.notes.append("esc_status holds no speed of at least one rotor: commands are used")
    return chosen


def _speeds(log: Messages) -> Rotors | None:
    series = log.series("esc_status", _ESC_SPEEDS)
    if series is None:
        return None
    functions = [int(log.latest("esc_status", f"esc[{i}].actuator_function") or 0) for i in range(4)]
    order = motor_order(functions, _MOTORS) or range(4)
    speeds = Series(series.t, np.abs(series.values)[:, order] * RPM)
    return Rotors.of(speeds, [f"esc_status.{_ESC_SPEEDS[i]}" for i in order], is_measured=True)


def _motors(log: Messages) -> Rotors | None:
    names = items("control", 4)
    series = log.series("actuator_motors", names)
    if series is None or not np.isfinite(series.values).any():
        return None
    shares = np.clip(np.nan_to_num(series.values), 0.0, 1.0)  # NaN means not armed
    curve, what = _thrust_curve(log)
    note = f"commands are actuator_motors.control, {what}"
    speeds = Series(series.t, np.sqrt(shares) if curve else shares)
    return Rotors(speeds, [f"actuator_motors.{name}" for name in names], is_measured=False, note=note)


def _outputs(log: Messages) -> Rotors | None:
    place = _bank_of_motors(log)
    if place is None:
        return None
    topic, names = "actuator_outputs", [f"output[{i}]" for i in place[1]]
    found = [log.series(topic, names, instance) for instance in log.fields.get(topic, ())]
    found = [s for s in found if s is not None and np.isfinite(s.values).all()]
    if not found:
        return None
    series = max(found, key=lambda each: float(each.values.std(axis=0).min()))
    kind, low, high = _limits(log, series.values, *place)
    shares = np.clip((series.values - low) / (high - low), 0.0, 1.0)
    curve, what = _thrust_curve(log)
    speeds = np.sqrt(curve * shares**2 + (1 - curve) * shares) if curve else shares
    note = f"commands are {topic}.output, {kind} {low.min():g}..{high.max():g}, {what}"
    return Rotors(Series(series.t, speeds), [f"{topic}.{name}" for name in names], is_measured=False, note=note)


def _thrust_curve(log: Messages) -> tuple[float, str]:
    """THR_MDL_FAC, 0 if it is not known, and its consequence for the speeds in words."""
    curve = log.parameters.get("THR_MDL_FAC", 0.0)
    if 0 < curve <= 1:
        return curve, f"taken as fractions of full-scale rotor speed by THR_MDL_FAC = {curve:.3g}"
    return 0.0, (
        "taken as fractions of full-scale rotor speed, because THR_MDL_FAC is 0: the thrust curve was not measured "
        "(the term motor of a vehicle fits it, if the accelerometer was logged)"
    )


def _bank_of_motors(log: Messages) -> tuple[str, list[int]] | None:
    """The bank of outputs that drives motors 1 to 4, and these outputs; `None`: no bank has all. Old PX4: MAIN."""
    for bank in _BANKS:
        functions = [int(log.parameters.get(f"{bank}_FUNC{output}", 0.0)) for output in range(1, 17)]
        order = motor_order(functions, _MOTORS)
        if order is not None:
            return bank, order
    unknown = not any(f"{bank}_FUNC1" in log.parameters for bank in (*_BANKS, *_OTHER_BANKS))
    return ("PWM_MAIN", [0, 1, 2, 3]) if unknown else None


def _limits(log: Messages, values: np.ndarray, bank: str, channels: list[int]) -> tuple[str, np.ndarray, np.ndarray]:
    """The protocol, and the values of each output at which its motor idles and is at full speed."""
    turning, get = values[values > 1], log.parameters.get
    _, _, (shortest, longest) = _PROTOCOLS["PWM"]  # us
    small, link = (turning < shortest).any(), _LINKS.get(int(log.latest("esc_status", "esc_connectiontype") or 0))
    timers = {get(f"{bank}_TIM{i}") for i in range(8)}
    kind = "PWM"
    if bank == "UAVCAN_EC" or (turning > longest).any() or (small and link == "UAVCAN"):
        kind = "UAVCAN"
    elif small or link == "DShot" or get("DSHOT_CONFIG", 0.0) > 0 or timers & {*_DSHOT_TIMERS}:
        kind = "DShot"
    ends, parameters, (least, most) = _PROTOCOLS[kind]
    if kind == "DShot" and 0 <= (idle := get("DSHOT_MIN", 0.0)) < 0.5:
        ends = ends[1] * idle, ends[1]

    def known(end: int, channel: int) -> float:
        """By the output's number, else of the bank, else the default."""
        names = [f"{name.format(bank=bank)}{('MIN', 'MAX')[end]}" for name in parameters]
        every = [get(f"{name}{number}") for name in names for number in (channel + 1, "")]
        return next((each for each in every if each is not None and least <= each <= most), ends[end])

    low, high = (np.array([known(end, channel) for channel in channels]) for end in (0, 1))
    return kind, *np.where(low < high, [low, high], np.array(ends)[:, None])


def _decoded(path: LogPath) -> Messages:
    """The topics that are needed. Raises `InputError`, one line, for a file that cannot be decoded."""
    try:
        from pyulog.core import ULog
    except ImportError:
        refuse(path, "reading a ULog file needs pyulog; install jaxos4[ulog]")
    content = read_bytes(path, 1 << 31)
    if content.endswith(bytes(64)):  # a loss of power leaves zeros at the end
        content = content.rstrip(b"\0")
    damage = reading(path, "cannot be decoded", "copy the log again from the vehicle")
    with damage, contextlib.redirect_stdout(io.StringIO()):
        _check_formats(ULog(_Content(content), parse_header_only=True).message_formats)
        topics = {topic for columns in _COLUMNS for topic, *_ in _sources(columns)}
        log = ULog(_Content(content), sorted(topics.union(_TOPICS)))
    if log.file_corruption:
        refuse(path, "is corrupt; copy the log again from the vehicle, or repair it")
    found: dict[str, dict[int, Fields]] = {}
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if "timestamp" in data.data:
            stamp = data.data.get("timestamp_sample", data.data["timestamp"])
            stamp = np.asarray(stamp if np.all(stamp > 0) else data.data["timestamp"], dtype=float)
            instances = found.setdefault(data.name, {})
            instances[len(instances)] = data.data | {"t": stamp / 1e6}
    changed = {name: value for _, name, value in log.changed_parameters}
    numbers = {k: v for k, v in (log.initial_parameters | changed).items() if isinstance(v, int | float)}
    return Messages(path, found, _REMEDY, parameters={k: float(v) for k, v in numbers.items() if math.isfinite(v)})


class _Content(io.BytesIO):
    """Ends a long search in a corrupt file: pyulog seeks once for each corrupt byte, and a few times if all is well."""

    seeks = 0

    def seek(self, offset: int, whence: int = 0, /) -> int:
        self.seeks += 1
        if self.seeks > 1000:
            raise EOFError("it is corrupt")
        return super().seek(offset, whence)


MAX_FIELDS, MAX_DEPTH = 1024, 3  # of a message, with those of messages in it; PX4 has about 200


def _check_formats(formats: Mapping[str, Any]) -> None:
    """Refuse formats with too many fields or levels, because pyulog makes an object of each."""

    @functools.cache
    def count(name: str, depth: int) -> int:
        if depth > MAX_DEPTH:
            raise ValueError("messages are nested too deeply")
        total = sum(
            max(size, 1) * (count(kind, depth + 1) if kind in formats else 1) for kind, size, _ in formats[name].fields
        )
        if total > MAX_FIELDS:
            raise ValueError(f"a message has more than {MAX_FIELDS} fields")
        return max(total, 1)

    for name in formats:
        count(name, 0)
