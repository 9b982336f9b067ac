"""Logs of ArduPilot."""

import numpy as np
from recorded_logs import FRD, RPM, attitude, commands, dataflash, force, position, rates, speeds, velocity
from scipy.spatial.transform import Rotation

T = 0.0025 * np.arange(1200)  # the main loop runs at 400 Hz


def degrees(t):
    """Roll, pitch, yaw as ArduPilot has them: of x forward, y right, z down, and yaw from 0 to 360."""
    angles = Rotation.from_matrix(FRD @ attitude(t) @ FRD).as_euler("ZYX", degrees=True)[:, ::-1]
    return angles % [720, 720, 360]


def imu(t, instance=0, sign=1):
    values = (np.full(t.size, instance), sign * rates(t) @ FRD, force(t) @ FRD)
    return ("IMU", "Bffffff", "I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", t, values)


def angles(t, name="ATT", letter="c"):
    signed = np.mod(degrees(t) + [180, 180, 0], 360) - [180, 180, 0]
    return (name, 3 * letter, "Roll,Pitch,Yaw", t, (signed,))


def outputs(t, order=(0, 1, 2, 3)):
    pwm = np.full((t.size, 8), 1000.0)
    pwm[:, order] = 1000 + 1000 * commands(t)
    return ("RCOU", "HHHHHHHH", ",".join(f"C{i}" for i in range(1, 9)), t, (pwm,))


def rate(t):
    return ("RATE", "fff", "R,P,Y", t, (np.rad2deg(rates(t) @ FRD),))


def ekf(t, core=0, shift=0.0):
    values = (np.full(t.size, core), velocity(t) @ FRD, position(t) @ FRD + shift)
    return ("XKF1", "Bffffff", "C,VN,VE,VD,PN,PE,PD", t, values)


def escs(t, order=(0, 1, 2, 3), speeds=speeds):
    """One message for each motor, at times of its own."""
    each = [np.column_stack([np.full(t.size, o), speeds(t + 5e-4 * i)[:, i] / RPM]) for i, o in enumerate(order)]
    times = np.concatenate([t + 5e-4 * i for i in range(4)])
    return ("ESC", "Bf", "Instance,RPM", times, (np.concatenate(each),))


def everything(t=T):
    slow = t[::4]
    messages = [imu(t), rate(slow), angles(t, "ANG", "f"), ekf(t[::8]), escs(slow), outputs(t[::40])]
    messages.append(("BAT", "Bf", "Inst,Volt", t[::40], (np.zeros(t[::40].size), 16.0 - 0.1 * t[::40])))
    return dataflash(messages, {"FRAME_CLASS": 1.0, "LOG_BITMASK": 176126})


FEW = T[:40]
BAD = {
    "header only": (b"\xa3\x95\x80", "holds no body rates; set LOG_BITMASK to 262145"),
    "no gyro": (dataflash([outputs(FEW)]), "holds no body rates"),
    "no motors": (dataflash([imu(FEW)]), "holds no rotor speeds or commands; add 1024"),
    "hexarotor": (dataflash([imu(FEW), outputs(FEW)], {"FRAME_CLASS": 2.0}), "this is no quadrotor"),
    "fifth motor": (dataflash([imu(FEW), outputs(FEW)], {"SERVO6_FUNCTION": 37.0}), "this is no quadrotor"),
    "apart": (dataflash([imu(FEW), outputs(FEW + 60)]), "not logged at the same time"),
    "too fast": (dataflash([("RATE", "fff", "R,P,Y", FEW, (9e3 * rates(FEW),)), outputs(FEW)]), "rad/s, beyond"),
    "damaged all over": (dataflash([imu(FEW)]) + b"\xa3\x95\x01" * 1100, "damaged in more than 1000 places"),
}
TEXTS = {
    letter: everything(FEW)
    .replace(b"QNf".ljust(16, b"\0"), b"QN" + letter.ljust(14, b"\0"))
    .replace(b"QBffffff".ljust(16, b"\0"), b"QB" + 6 * letter + bytes(8))
    for letter in (b"n", b"a")
}
"""Logs whose PARM and IMU have a text, or one that does not fit, for each number."""
SMALL = dataflash([imu(FEW), angles(FEW), outputs(FEW)], {"FRAME_CLASS": 1.0})
