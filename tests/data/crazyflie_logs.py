"""Logs of a Crazyflie."""

import struct

import numpy as np
from recorded_logs import (
    GRAVITY,
    RPM,
    attitude,
    commands,
    crazyflie,
    crazyflie_2019,
    force,
    position,
    rates,
    speeds,
    velocity,
)

GYRO = ["gyro.x(f)", "gyro.y(f)", "gyro.z(f)", "acc.x(f)", "acc.y(f)", "acc.z(f)"]
STATE = [f"stateEstimate.{name}(f)" for name in ("roll", "pitch", "yaw", "x", "y", "z", "vx", "vy", "vz")]
MOTORS = [f"motor.m{i}(H)" for i in range(1, 5)]
RPMS = [f"rpm.m{i}(H)" for i in range(1, 5)]


def sensors(t):
    return np.column_stack([np.rad2deg(rates(t)), force(t) / GRAVITY])


def angles(t):
    """The firmware's angles in degrees, from where the nose and the left wing point: pitch is the nose's, upward."""
    nose, left = attitude(t)[:, :, 0], attitude(t)[:, :, 1]
    up = np.arcsin(nose[:, 2])
    right = np.arctan2(left[:, 2], np.sqrt(1 - nose[:, 2] ** 2 - left[:, 2] ** 2))
    return np.rad2deg(np.column_stack([right, up, np.arctan2(nose[:, 1], nose[:, 0])]))


def state(t):
    return np.column_stack([angles(t), position(t), velocity(t)])


def ratios(t):
    return np.rint(65535 * commands(t))


def one_event(t, **options):
    values = np.column_stack([sensors(t), state(t), np.rint(speeds(t) / RPM)])
    return crazyflie([("fixedFrequency", GYRO + STATE + RPMS, t, values)], **options)


T = 0.004 * np.arange(750) + 3.0
HEADER = struct.pack("<BHH", 0xBC, 2, 1) + b"\0\0fixedFrequency\0"
BAD = {
    "one byte": (b"\xbc", "ends within its header"),
    "other version": (b"\xbc\x07\0\x01\0", "is of version 7"),
    "no types": (b"\xbc\x02\0\0\0", "announces 0 event types"),
    "many types": (b"\xbc\x02\0\xff\xff", "announces 65535 event types"),
    "many variables": (HEADER + b"\xff\xff", "announces 65535 variables"),
    "no type": (HEADER + b"\x01\0gyro.x\0" + bytes(60), "'gyro.x' without a known type"),
    "no name": (HEADER + b"\x01\0" + b"g" * 500, "ends within its header, or is corrupt"),
    "twice": (HEADER + b"\x02\0a.b(f)\0a.b(f)\0", "twice"),
    "no event": (HEADER + b"\x01\0a.b(f)\0" + b"\x07\0" + bytes(60), "no event begins there"),
    "nothing": (crazyflie([("e", GYRO, np.zeros(0), np.zeros((0, 6)))]), "holds no events"),
    "no gyro": (crazyflie([("e", MOTORS, T, ratios(T))]), "holds no body rates"),
    "no motors": (crazyflie([("e", GYRO, T, sensors(T))]), "holds no rotor speeds or commands"),
    "apart": (crazyflie([("e", GYRO, T, sensors(T)), ("m", MOTORS, T + 60, ratios(T))]), "not logged at the same time"),
    "too fast": (
        crazyflie([("e", GYRO + MOTORS, T, np.column_stack([99 * sensors(T), ratios(T)]))]),
        ["rad/s, beyond 60 rad/s", "the log is corrupt there"],
    ),
}


def backward():
    """A log whose first events have later times than the others."""
    values = np.column_stack([sensors(T), ratios(T)])
    content = bytearray(crazyflie([("e", GYRO + MOTORS, T, values)], checksum=False))
    size = 2 + 8 + 4 * 6 + 2 * 4
    for row in range(100):
        at = len(content) - size * (T.size - row) + 2
        content[at : at + 8] = struct.pack("<Q", 99_000_000 - row)
    return bytes(content)


BAD["backward"] = (backward(), "time runs backward")
T_2019 = 0.004 * np.arange(750)
VARIABLES = GYRO + STATE + RPMS


def log_2019(t=T_2019, **options):
    return crazyflie_2019(VARIABLES, t, np.column_stack([sensors(t), state(t), speeds(t) / RPM]), **options)


BAD["2019, other width"] = (b"\x07" + log_2019()[1:], "does not describe its variables")
BAD["2019, nothing"] = (log_2019(T_2019[:0]), "holds no events")
BAD["2019, backward"] = (log_2019(T_2019[::-1]), "time runs backward")
SMALL_2019 = log_2019(T_2019[:40])
EMPTY_EVENTS = HEADER + b"\0\0" + bytes(10) * 200_000
SMALL = one_event(T[:25])
