"""Logs of PX4."""

import struct

import numpy as np
from recorded_logs import FRD, RPM, force, message, position, quaternions, rates, speeds, ulog, velocity

T = 2500.0  # the test airframe's full scale [rad/s]
ESC = b"esc_report:uint64_t timestamp;int32_t esc_rpm;uint8_t actuator_function;uint8_t[3] _padding0;"


def grid(step, seconds=3.0, offset=0.0):
    return offset + step * np.arange(round(seconds / step))


def angular_velocity(t):
    # stamped half a millisecond after it was sampled
    rows = [(int(1e6 * (s + 5.0)), *row) for s, row in zip(t, rates(t) @ FRD, strict=True)]
    fields = "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;"
    return "vehicle_angular_velocity", fields, "QQfff", rows, t + 5e-4


def combined(t, gyro=rates, accelerometer=force):
    rows = np.column_stack([gyro(t) @ FRD, accelerometer(t) @ FRD]).tolist()
    fields = "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
    return "sensor_combined", fields, "Qffffff", rows, t


def vehicle_attitude(t):
    turn = quaternions(t, turned=True).tolist()
    return "vehicle_attitude", "uint64_t timestamp;float[4] q;", "Qffff", turn, t


def local_position(t, valid=True):
    rows = np.column_stack([position(t) @ FRD, velocity(t) @ FRD]).tolist()
    fields = "uint64_t timestamp;" + "".join(f"float {n};" for n in ("x", "y", "z", "vx", "vy", "vz"))
    rows = [(*row, valid, True) for row in rows]
    return "vehicle_local_position", fields + "bool xy_valid;bool z_valid;", "Qffffff??", rows, t


def escs(t, order=(0, 1, 2, 3), speeds=speeds):
    """ESC number i turns motor order[i]; speeds are signed by the sense of rotation."""
    signed = np.rint(speeds(t) / RPM * [1, -1, 1, -1]).astype(int).tolist()
    rows = [(4, *(x for motor in order for x in (0, row[motor], 101 + motor, 0, 0, 0))) for row in signed]
    fields = "uint64_t timestamp;uint8_t esc_count;uint8_t[7] _padding0;esc_report[4] esc;"
    return "esc_status", fields, "QB7x" + "QiBBBB" * 4, rows, t


def motors(t, command, more=0):
    rows = [(*row, *[0.5] * more, *[float("nan")] * (8 - more)) for row in command]
    return "actuator_motors", "uint64_t timestamp;float[12] control;", "Q" + "f" * 12, rows, t


def pwm(t, values, *, channels=(0, 1, 2, 3), others=0.0):
    """Sixteen outputs, of which these channels have these values."""
    rows = np.full((t.size, 16), others)
    rows[:, list(channels)] = values
    fields = "uint64_t timestamp;uint8_t noutputs;float[16] output;"
    return "actuator_outputs", fields, "QB" + "f" * 16, [(16, *row) for row in rows.tolist()], t


def parameter(name, value):
    """A parameter of the autopilot: a whole number, or a float."""
    kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
    key = f"{kind} {name}".encode()
    return message("P", bytes([len(key)]) + key + struct.pack(code, value))


def log(*topics, **parameters):
    """A ULog file of these topics, with the autopilot's parameters."""
    settings = b"".join(parameter(name, value) for name, value in parameters.items())
    return ulog(list(topics), before=message("F", ESC) + settings)


def everything(**changes):
    parts = {
        "angular": angular_velocity(grid(0.005)),
        "combined": combined(grid(0.005, offset=0.001)),
        "attitude": vehicle_attitude(grid(0.01, offset=0.002)),
        "position": local_position(grid(0.02, offset=0.003)),
        "esc": escs(grid(0.01, 3.2, offset=-0.1)),
    } | changes
    return log(*(part for part in parts.values() if part is not None))


BAD = {
    "other magic": (b"ULog\x02" + bytes(40), "Failed to parse header"),
    "header": (everything()[:12], "Header too short"),
    "nothing": (ulog([]), "no body rates"),
    "no motors": (everything(esc=None), "no rotor speeds or commands"),
    "no gyro": (everything(angular=None, combined=None), "no body rates"),
    "six motors": (
        everything(esc=None, motors=motors(grid(0.01), [[0.5] * 4] * 300, more=2)),
        "field actuator_motors.control[4]: this is no quadrotor",
    ),
    "apart": (everything(esc=escs(grid(0.01, 1.0, offset=50.0))), "not logged at the same time"),
    "newer": (
        b"ULog\x01\x12\x35\x01" + bytes(8) + message("B", bytes(8) + b"\x02" + bytes(31)),
        "Unknown incompatible flag",
    ),
    "no such message": (ulog([combined(grid(0.005))], extra=bytes(3) + b"hello"), "is corrupt"),
    "unannounced": (ulog([combined(grid(0.005))], extra=message("D", b"\x63\0" + bytes(9))), "is corrupt"),
    "no format": (ulog([], before=message("A", b"\0\0\0sensor_combined")), "is corrupt"),
}


def backward():
    """A log whose first samples of sensor_combined come late."""
    content = bytearray(everything(angular=None))
    stamps = [i for i in range(len(content) - 11) if content[i : i + 3] == b"\x22\x00D"][:60]
    for at in stamps:
        content[at + 5 : at + 13] = struct.pack("<Q", 9_000_000_000 - at)
    return bytes(content)


BAD["backward"] = (backward(), "time runs backward")


def nested(width, depth):
    """Formats that hold `width` ** `depth` fields."""
    formats = [f"m{i}:m{i + 1}[{width}] inner;" for i in range(depth)]
    formats += [f"m{depth}:float x;", f"sensor_combined:uint64_t timestamp;m0[{width}] inner;"]
    return b"".join(message("F", text.encode()) for text in formats)


def announced(formats):
    """A log of these formats and a topic without samples."""
    return ulog([], before=formats + message("A", b"\0\0\0sensor_combined"))


BOMBS = {  # formats that announce much
    "wide": message("F", b"sensor_combined:uint64_t timestamp;float[65535] a;float[65535] b;"),
    "nested": nested(100, 3),
    "deep": nested(1, 60),
    "endless": message("F", b"sensor_combined:uint64_t timestamp;sensor_combined[2] inner;"),
    "empty arrays": message("F", b"sensor_combined:uint64_t timestamp;sensor_combined[0] inner;"),
    "long": b"\xff\xff\x01" * 2000,
}


def states(topic, times, **fields):
    """A topic of whole numbers, such as vehicle_status: for each field, its value at each time."""
    layout = "uint64_t timestamp;" + "".join(f"uint8_t {name};" for name in fields)
    return topic, layout, "Q" + "B" * len(fields), list(zip(*fields.values(), strict=True)), np.asarray(times)


def battery(t, volts):
    rows = [(float(each), 4) for each in np.broadcast_to(volts, t.shape)]
    return "battery_status", "uint64_t timestamp;float voltage_v;uint8_t cell_count;", "QfB", rows, t


def thrusts(t):
    """The shares of thrust that the controller asks for."""
    return 0.4 + 0.05 * np.arange(4) + 0.2 * np.sin(np.outer(t, [1.0, 1.3, 0.7, 1.9]))


def signals(thrust, curve):
    """The motors' signals, by PX4's own formula for the positive root of f u^2 + (1 - f) u = thrust."""
    if curve == 0:
        return thrust
    return -(1 - curve) / (2 * curve) + np.sqrt((1 - curve) ** 2 / (4 * curve**2) + thrust / curve)


SMALL = log(
    combined(grid(0.02, 0.6)),
    vehicle_attitude(grid(0.04, 0.6)),
    local_position(grid(0.1, 0.6)),
    escs(grid(0.05, 0.7, offset=-0.05)),
    motors(grid(0.1, 0.6), [[0.5] * 4] * 6),
    states("vehicle_status", [0.0, 0.3], is_vtol=[0, 0], vehicle_type=[1, 1], system_type=[2, 2]),
    states("vehicle_land_detected", [0.0, 0.3], landed=[1, 0], maybe_landed=[1, 0]),
    battery(grid(0.2, 0.6), 15.0),
    **{"THR_MDL_FAC": 0.3, "CA_ROTOR_COUNT": 4},
)
ROTORS = escs(grid(0.01, 3.4, offset=-0.2))
OTHERS = {
    "vtol": ([states("vehicle_status", [0.0, 1.0], is_vtol=[0, 1])], {}, "field vehicle_status.is_vtol"),
    "plane": ([states("vehicle_status", [0.0], vehicle_type=[2])], {}, "field vehicle_status.vehicle_type"),
    "hexarotor": ([states("vehicle_status", [0.0], system_type=[13])], {}, "field vehicle_status.system_type"),
    "type": ([], {"MAV_TYPE": 22}, "parameter MAV_TYPE"),
    "frame": ([], {"CA_AIRFRAME": 3}, "parameter CA_AIRFRAME"),
    "rotors": ([], {"CA_ROTOR_COUNT": 6}, "parameter CA_ROTOR_COUNT"),
}
REMEDY = ": this is no quadrotor; give the log of a quadrotor."
BAD |= {
    name: (log(combined(grid(0.005)), ROTORS, *topics, **parameters), place + REMEDY)
    for name, (topics, parameters, place) in OTHERS.items()
}
