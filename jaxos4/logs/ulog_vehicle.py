"""What a ULog file says of its vehicle: its type, the positions and spins of its rotors, its battery, the ground."""

import math

import numpy as np

from .facts import LogFacts
from .series import Series
from .table import refuse
from .ulog_topics import Topics

TOPICS = ("vehicle_status", "vehicle_land_detected", "battery_status")
MOTORS = 12  # the most that PX4 can drive

_REMEDY = "only a quadrotor can be identified: give the log of one"
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


def check_vehicle(log: Topics) -> None:
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
    others = [i for i in range(4, MOTORS) if np.nan_to_num(motors.get(f"control[{i}]", np.zeros(1))).any()]
    if others:
        _refuse(log, f"a vehicle that drives {4 + len(others)} motors", f"actuator_motors.control[{others[0]}]")


def _refuse(log: Topics, what: str, name: str, kind: str = "field") -> None:
    refuse(log.path, f"this is {what}; {_REMEDY}", column=name, kind=kind)


def vehicle_facts(log: Topics, rows: np.ndarray) -> LogFacts:
    """What the log says of the vehicle; `rows`: the times of the flight's samples [s], in the log's time."""
    positions = [[log.parameters.get(f"CA_ROTOR{i}_P{axis}", math.nan) for axis in "XY"] for i in range(4)]
    moments = [log.parameters.get(f"CA_ROTOR{i}_KM", math.nan) for i in range(4)]
    known = log.parameters.get("CA_ROTOR_COUNT") == 4
    # PX4's y points to the right. Generic airframes say 1 m, because only the directions of the rotors matter to PX4.
    placed = known and np.isfinite(positions).all() and not np.isin(np.abs(positions), (0.0, 1.0)).all()
    spun = known and all(moment != 0 and math.isfinite(moment) for moment in moments)
    cells = (log.latest("battery_status", "cell_count"), log.parameters.get("BAT1_N_CELLS"))
    cells = next((int(each) for each in (*cells, log.parameters.get("BAT_N_CELLS")) if each and each > 0), None)
    return LogFacts(
        faster=_faster(log),
        landed=_landed(log, rows),
        rotor_positions=tuple((float(x), -float(y)) for x, y in positions) if placed else None,
        rotor_spins=tuple(math.copysign(1.0, moment) for moment in moments) if spun else None,
        cells=cells,
    )


def voltage(log: Topics) -> Series | None:
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
    """What to do so that PX4 logs faster. Reference: `logged_topics.cpp` of PX4, `add_high_rate_topics`."""
    profile, high_rate = int(log.parameters.get("SDLOG_PROFILE", 1.0)), 16
    if profile & high_rate:
        return "log esc_status or actuator_motors at full rate (logger_topics.txt on the card), and fly again"
    return f"set SDLOG_PROFILE to {profile | high_rate} (which includes {high_rate}, 'high rate'), and fly again"
