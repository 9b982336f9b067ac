"""PX4's logs: our frame and units, any rates of logging, and one line for a damaged file."""

import struct

import numpy as np
import pytest
from helpers import CRAZYFLIE, refused
from hypothesis import given, settings, strategies as st
from recorded_logs import (
    FRD,
    RPM,
    VEHICLE,
    attitude,
    check,
    force,
    message,
    outcome,
    position,
    rates,
    speeds,
    ulog,
    velocity,
)
from scipy.spatial.transform import Rotation

from jaxos4.errors import InputError
from jaxos4.logs import Sampling, Table, read_log, read_recording
from jaxos4.logs.sampling import Series, at_rows, gyro_rows, root_mean_square

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
    q = Rotation.from_matrix(FRD @ attitude(t) @ FRD).as_quat()[:, [3, 0, 1, 2]]
    return "vehicle_attitude", "uint64_t timestamp;float[4] q;", "Qffff", q.tolist(), t


def local_position(t, valid=True):
    rows = np.column_stack([position(t) @ FRD, velocity(t) @ FRD]).tolist()
    fields = "uint64_t timestamp;" + "".join(f"float {n};" for n in ("x", "y", "z", "vx", "vy", "vz"))
    rows = [(*row, valid, True) for row in rows]
    return "vehicle_local_position", fields + "bool xy_valid;bool z_valid;", "Qffffff??", rows, t


def escs(t, order=(0, 1, 2, 3), speeds=speeds):
    """ESC number i turns motor order[i]; speeds are signed by the sense of rotation."""
    signed = speeds(t) / RPM * [1, -1, 1, -1]
    rows = []
    for row in np.rint(signed).astype(int).tolist():
        cells = []
        for i in range(4):
            cells += [0, row[order[i]], 101 + order[i], 0, 0, 0]
        rows.append(tuple(cells))
    fields = "uint64_t timestamp;uint8_t esc_count;uint8_t[7] _padding0;esc_report[4] esc;"
    return "esc_status", fields, "QB7x" + "QiBBBB" * 4, [(4, *row) for row in rows], t


def motors(t, command, more=0):
    rows = [(*row, *[0.5] * more, *[float("nan")] * (8 - more)) for row in command]
    return "actuator_motors", "uint64_t timestamp;float[12] control;", "Q" + "f" * 12, rows, t


def pwm(t, output):
    rows = [(4, *row, *[0.0] * 12) for row in output]
    return "actuator_outputs", "uint64_t timestamp;uint8_t noutputs;float[16] output;", "QB" + "f" * 16, rows, t


def everything(**changes):
    parts = {
        "angular": angular_velocity(grid(0.005)),
        "combined": combined(grid(0.005, offset=0.001)),
        "attitude": vehicle_attitude(grid(0.01, offset=0.002)),
        "position": local_position(grid(0.02, offset=0.003)),
        "esc": escs(grid(0.01, 3.2, offset=-0.1)),
    }
    parts.update(changes)
    return ulog([part for part in parts.values() if part is not None], before=message("F", ESC))


def test_speeds_are_put_in_the_motors_order_and_need_no_curve(save):
    esc = escs(grid(0.01, 3.2, offset=-0.1), order=(2, 0, 3, 1))
    flight, notes = read_log(save(log(combined(grid(0.005)), esc, THR_MDL_FAC=0.3)))
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.0025), atol=0.5)
    assert not any("THR_MDL_FAC" in note for note in notes)


def test_commands_need_a_full_scale(save):
    t = grid(0.05, 3.2, offset=-0.1)
    path = save(everything(esc=None, motors=motors(t, [[0.3] * 4] * t.size)))
    np.testing.assert_allclose(read_log(path, full_scale=1.0)[0].omega, 0.3, rtol=1e-6)
    with pytest.raises(InputError, match=r"field actuator_motors.control\[0\]: the rotor speed of full command"):
        read_log(path)


def test_idle_escs_give_way_to_commands(save):
    t = grid(0.01, 3.2, offset=-0.1)
    idle = escs(t)
    idle = (*idle[:3], [(4, *[0] * 24) for _ in t], t)
    flight, notes = read_log(save(everything(esc=idle, motors=motors(t, [[0.4] * 4] * t.size))), CRAZYFLIE)
    assert any("commands are used" in note for note in notes)
    np.testing.assert_allclose(flight.omega, 0.4 * T, rtol=1e-6)


def test_invalid_positions_are_not_measured(save):
    flight, _ = read_log(save(everything(position=local_position(grid(0.02), valid=False))))
    check(flight, names=("p", "q", "r", "phi", "theta", "psi", "z", "vx", "vy", "vz"))


def test_what_was_appended_after_a_restart_does_not_break_it(save):
    whole = everything()
    content = bytearray(whole[: len(whole) * 2 // 3 - 5])
    at = len(content)
    content[19 + 8] = 1  # data appended
    content[19 + 16 : 19 + 24] = struct.pack("<Q", at)
    assert content[18:19] == b"B"
    flight, notes = read_log(save(bytes(content) + message("L", b"6" + bytes(8) + b"hard fault")))
    check(flight, seconds=1.9)
    assert not any("abruptly" in note for note in notes)
    content[19 + 8] = 0
    assert isinstance(outcome(read_log, save(bytes(content) + message("L", b"6" + bytes(8) + b"hard fault") * 9)), str)


BAD = {
    "other magic": (b"ULog\x02" + bytes(40), "is not a ULog"),
    "header": (everything()[:12], "ends within its header"),
    "nothing": (ulog([]), "no body rates"),
    "no motors": (everything(esc=None), "no rotor speeds or commands"),
    "no gyro": (everything(angular=None, combined=None), "no body rates"),
    "six motors": (everything(esc=None, motors=motors(grid(0.01), [[0.5] * 4] * 300, more=2)), "drives 6 motors"),
    "apart": (everything(esc=escs(grid(0.01, 1.0, offset=50.0))), "not logged at the same time"),
    "newer": (b"ULog\x01\x12\x35\x01" + bytes(8) + message("B", bytes(8) + b"\x02" + bytes(31)), "newer ULog format"),
    "no such message": (ulog([combined(grid(0.005))], extra=b"\x05\x00\x07hello"), "is corrupt at byte"),
    "unannounced": (ulog([combined(grid(0.005))], extra=message("D", b"\x63\0" + bytes(9))), "never announced"),
    "no format": (ulog([], before=message("A", b"\0\0\0sensor_combined")), "has no format"),
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


def parameter(name, value):
    """A parameter of the autopilot: a whole number, or a float."""
    kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
    key = f"{kind} {name}".encode()
    return message("P", bytes([len(key)]) + key + struct.pack(code, value))


def states(topic, times, **fields):
    """A topic of whole numbers, such as vehicle_status: for each field, its value at each time."""
    layout = "uint64_t timestamp;" + "".join(f"uint8_t {name};" for name in fields)
    return topic, layout, "Q" + "B" * len(fields), list(zip(*fields.values(), strict=True)), np.asarray(times)


def battery(t, volts):
    rows = [(float(each), 4) for each in np.broadcast_to(volts, t.shape)]
    return "battery_status", "uint64_t timestamp;float voltage_v;uint8_t cell_count;", "QfB", rows, t


SMALL = ulog(
    [
        combined(grid(0.02, 0.6)),
        vehicle_attitude(grid(0.04, 0.6)),
        local_position(grid(0.1, 0.6)),
        escs(grid(0.05, 0.7, offset=-0.05)),
        motors(grid(0.1, 0.6), [[0.5] * 4] * 6),
        states("vehicle_status", [0.0, 0.3], is_vtol=[0, 0], vehicle_type=[1, 1], system_type=[2, 2]),
        states("vehicle_land_detected", [0.0, 0.3], landed=[1, 0], maybe_landed=[1, 0]),
        battery(grid(0.2, 0.6), 15.0),
    ],
    before=message("F", ESC) + parameter("THR_MDL_FAC", 0.3) + parameter("CA_ROTOR_COUNT", 4),
)


def log(*topics, **parameters):
    """A ULog file of these topics, with the autopilot's parameters."""
    settings = b"".join(parameter(name, value) for name, value in parameters.items())
    return ulog(list(topics), before=message("F", ESC) + settings)


def thrusts(t):
    """The shares of thrust that the controller asks for."""
    return 0.4 + 0.05 * np.arange(4) + 0.2 * np.sin(np.outer(t, [1.0, 1.3, 0.7, 1.9]))


def signals(thrust, curve):
    """The motors' signals, by PX4's own formula for the positive root of f u^2 + (1 - f) u = thrust."""
    if curve == 0:
        return thrust
    return -(1 - curve) / (2 * curve) + np.sqrt((1 - curve) ** 2 / (4 * curve**2) + thrust / curve)


# Commands


def outputs(t, values, *, channels=(0, 1, 2, 3), others=0.0):
    rows = np.full((t.size, 16), others)
    rows[:, list(channels)] = values
    name, fields, code, _, _ = pwm(t, [])
    return name, fields, code, [(16, *row) for row in rows.tolist()], t


def as_motors(t, curve):
    return [motors(t, thrusts(t).tolist())], {}


def as_old_pwm(t, curve):
    ends = {"PWM_MIN": 1075, "PWM_MAX": 1950, "PWM_MAIN_MIN1": -1, "PWM_MAIN_MIN2": 1100}
    low = np.array([1075.0, 1100.0, 1075.0, 1075.0])
    return [outputs(t, low + (1950 - low) * signals(thrusts(t), curve), others=1500.0)], ends


def as_pwm(t, curve):
    """Motors 1 to 4 on outputs 5, 2, 1, 7; a servo on 3."""
    channels = (4, 1, 0, 6)
    found = {f"PWM_AUX_FUNC{c + 1}": 101 + i for i, c in enumerate(channels)} | {"PWM_AUX_FUNC3": 201}
    found |= {f"PWM_AUX_MIN{c + 1}": 1100 for c in channels} | {f"PWM_AUX_MAX{c + 1}": 1900 for c in channels}
    other = outputs(t, np.full((t.size, 4), 1500.0))
    moving = outputs(t, 1100 + 800 * signals(thrusts(t), curve), channels=channels, others=1500.0)
    return [other, moving], found


def as_dshot(t, curve):
    return [outputs(t, 1999 * (0.055 + 0.945 * signals(thrusts(t), curve)))], {"DSHOT_MIN": 0.055, "DSHOT_CONFIG": 600}


def as_new_dshot(t, curve):
    topics, parameters = as_dshot(t, curve)
    functions = {f"PWM_MAIN_FUNC{i}": 100 + i for i in range(1, 5)}
    return topics, parameters | functions | {"DSHOT_CONFIG": 0, "PWM_MAIN_TIM0": 50, "PWM_MAIN_TIM1": -4}


def as_uavcan(t, curve):
    return [outputs(t, 1 + 8190 * signals(thrusts(t), curve), others=4095.5)], {"UAVCAN_ENABLE": 3}


@pytest.mark.parametrize("curve", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("logged", [as_motors, as_old_pwm, as_pwm, as_dshot, as_new_dshot, as_uavcan])
def test_one_flight_gives_the_same_speeds_in_whatever_unit_its_commands_are_logged(logged, curve, save):
    t = grid(0.005, 3.2, offset=-0.1)
    topics, parameters = logged(t, curve)
    flight, notes = read_log(save(log(combined(grid(0.005)), *topics, THR_MDL_FAC=curve, **parameters)), CRAZYFLIE)
    time = np.asarray(flight.time)
    held = thrusts(t[np.searchsorted(t, time + 1e-9, side="right") - 1])
    want = np.sqrt(held) if curve else held
    np.testing.assert_allclose(np.asarray(flight.omega)[:-1] / T, want[:-1], atol=2e-3)
    assert sum("THR_MDL_FAC is 0" in note for note in notes) == (curve == 0)


def test_outputs_of_unknown_motors_are_not_taken(save):
    t = grid(0.005, 3.2, offset=-0.1)
    topics, split = as_pwm(t, 0.0)
    split |= {"PWM_AUX_FUNC7": 0, "PWM_MAIN_FUNC1": 104}  # three motors on one driver, one on another
    with pytest.raises(InputError, match="no rotor speeds or commands"):
        read_log(save(log(combined(grid(0.005)), *topics, **split)), CRAZYFLIE)


def test_measured_speeds_that_are_slow_give_way_to_commands(save):
    t = grid(0.01, 3.2, offset=-0.1)
    slow = escs(grid(0.25, 3.4, offset=-0.2))
    path = save(log(combined(grid(0.005)), slow, motors(t, [[0.4] * 4] * t.size)))
    found = read_recording(path, CRAZYFLIE)
    assert found.commanded
    assert any("logged at 4 Hz only: commands are used" in note for note in found.notes)
    assert found.facts.motors == Sampling("actuator_motors", pytest.approx(100.0))
    path = save(log(combined(grid(0.005)), slow, motors(grid(0.5, 3.4, offset=-0.2), [[0.4] * 4] * 7)))
    assert not read_log(path)[0].commanded  # of slow ones, the faster


# The fastest sensor


def raw(topic, t, values, device=42):
    rows = [(device, *row) for row in values.tolist()]
    return topic, "uint64_t timestamp;uint32_t device_id;float x;float y;float z;", "QIfff", rows, t


ROTORS = escs(grid(0.01, 3.4, offset=-0.2))


@pytest.mark.parametrize(
    ("angular", "imu", "topic", "step"),
    [(0.02, 0.004, "sensor_combined", 0.004), (0.002, 0.004, "vehicle_angular_velocity", 0.002)],
)
def test_the_fastest_gyro_is_taken(angular, imu, topic, step, save):
    found = read_recording(save(log(angular_velocity(grid(angular)), combined(grid(imu)), ROTORS)))
    check(found.flight, names=("p", "q", "r"))
    assert found.dt == pytest.approx(step)
    assert found.facts.gyro == Sampling(topic, pytest.approx(1 / step))


def test_raw_sensors_are_calibrated_or_not_taken(save):
    t, offset, scale = grid(0.001), np.array([0.3, -0.2, 0.1]), np.array([1.01, 0.99, 1.02])
    gyro = raw("sensor_gyro", t, rates(t) @ FRD + offset)
    accelerometer = raw("sensor_accel", t, (force(t) @ FRD) / scale + offset, device=2**31 + 5)
    known = {"CAL_GYRO2_ID": 42, "CAL_ACC0_ID": -(2**31) + 5}
    known |= {f"CAL_GYRO2_{axis}OFF": float(o) for axis, o in zip("XYZ", offset, strict=True)}
    known |= {f"CAL_ACC0_{axis}OFF": float(o) for axis, o in zip("XYZ", offset, strict=True)}
    known |= {f"CAL_ACC0_{axis}SCALE": float(s) for axis, s in zip("XYZ", scale, strict=True)}
    topics = (combined(grid(0.02)), gyro, accelerometer, ROTORS)
    found = read_recording(save(log(*topics, **known)))
    check(found.flight, names=("p", "q", "r"))
    assert found.facts.gyro == Sampling("sensor_gyro", pytest.approx(1000.0))
    for spoilt in ({"SENS_BOARD_ROT": 2}, {"SENS_BOARD_Y_OFF": 1.0}, {"CAL_GYRO2_ID": 41}, {"CAL_GYRO2_ROT": 4}):
        found = read_recording(save(log(*topics, **(known | spoilt))))
        check(found.flight, names=("p", "q", "r"))
        assert found.facts.gyro == Sampling("sensor_combined", pytest.approx(50.0))


def test_a_faster_sensor_is_averaged_and_not_sampled(save):
    fast = grid(0.001, 3.2, offset=-0.1)
    shaken = force(fast) + 30 * np.cos(2 * np.pi * 200 * fast)[:, None]  # one period a row: samples would show 30
    acceleration = ("vehicle_acceleration", "uint64_t timestamp;float[3] xyz;", "Qfff", (shaken @ FRD).tolist(), fast)
    check(read_log(save(log(angular_velocity(grid(0.005)), acceleration, ROTORS)))[0], names=("p", "q", "r"), atol=5e-3)


def test_a_gyro_beyond_a_kilohertz_is_averaged_to_one():
    t = grid(0.00025, 2.0)
    noise = np.random.default_rng(0).normal(0, 0.1, (t.size, 3))
    motor = Series(grid(0.01, 2.2, offset=-0.1), np.full((220, 4), 0.5))
    rows, table = gyro_rows(Table("", {}), Series(t, rates(t) + noise), motor, measured=False, others={})
    assert np.median(np.diff(rows)) == pytest.approx(0.001)
    off = np.column_stack([table.columns[name] for name in "pqr"]) - rates(rows)
    assert np.std(off) == pytest.approx(0.1 / 2, rel=0.15)  # of four samples each


@given(seed=st.integers(0, 999), ratio=st.floats(1.5, 30.0))
@settings(max_examples=40)
def test_means_of_a_line_lie_on_the_line_and_not_across_gaps(seed, ratio):
    rng = np.random.default_rng(seed)
    rows = 0.01 * np.arange(200)
    t = np.arange(0.0, 2.0, 0.01 / ratio)
    t = np.sort(t + rng.uniform(-0.2, 0.2, t.size) * 0.01 / ratio)
    t = t[(t < 0.8) | (t > 1.1)]
    out = at_rows(rows, Series(t, np.column_stack([3 * t - 1, np.ones(t.size)])))
    measured = np.isfinite(out[:, 0])
    np.testing.assert_allclose(out[measured, 0], 3 * rows[measured] - 1, atol=1e-9)
    np.testing.assert_allclose(out[measured, 1], 1.0, atol=1e-9)
    assert not measured[(rows > 0.8) & (rows < 1.1)].any()
    assert measured[(rows > 0.05) & (rows < 0.75)].all()


# The vehicle


OTHERS = {
    "vtol": (
        [states("vehicle_status", [0.0, 1.0], is_vtol=[0, 1])],
        {},
        "field vehicle_status.is_vtol: this is a VTOL",
    ),
    "plane": (
        [states("vehicle_status", [0.0], vehicle_type=[2])],
        {},
        "field vehicle_status.vehicle_type: this is a fi",
    ),
    "hexarotor": (
        [states("vehicle_status", [0.0], system_type=[13])],
        {},
        "vehicle_status.system_type: this is a hexarotor",
    ),
    "type": ([], {"MAV_TYPE": 22}, "parameter MAV_TYPE: this is a VTOL"),
    "frame": ([], {"CA_AIRFRAME": 3}, "parameter CA_AIRFRAME: this is a VTOL"),
    "rotors": ([], {"CA_ROTOR_COUNT": 6}, "parameter CA_ROTOR_COUNT: this is a vehicle with 6 rotors"),
}
REMEDY = "; only a quadrotor can be identified: give the log of one."
BAD |= {
    name: (log(combined(grid(0.005)), ROTORS, *topics, **parameters), [words, REMEDY])
    for name, (topics, parameters, words) in OTHERS.items()
}


def test_what_the_log_knows_of_a_quadrotor(save):
    quad = {"MAV_TYPE": 2, "CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4, "SDLOG_PROFILE": 131}
    # Quad X: 1 front right, 2 rear left, both counter-clockwise; 3 front left, 4 rear right. PX4's y points right.
    places = [(0.15, 0.25), (-0.15, -0.19), (0.15, -0.25), (-0.15, 0.19)]
    for i, (x, y) in enumerate(places):
        quad |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_KM": 0.05 if i < 2 else -0.05}
    status = states("vehicle_status", [0.0], is_vtol=[0], vehicle_type=[1], system_type=[2])
    topics = (combined(grid(0.005)), ROTORS, status, battery(grid(0.2), 15.2))
    found = read_recording(save(log(*topics, **quad)))
    np.testing.assert_allclose(found.facts.rotor_positions, [(x, -y) for x, y in places], rtol=1e-6)
    assert found.facts.rotor_spins == (1.0, 1.0, -1.0, -1.0)
    assert found.facts.cells == 4
    np.testing.assert_allclose(found.voltage, 15.2, rtol=1e-6)
    assert "SDLOG_PROFILE to 147" in found.facts.faster
    generic = quad | {f"CA_ROTOR{i}_P{axis}": 1.0 for i in range(4) for axis in "XY"}
    assert read_recording(save(log(*topics, **generic))).facts.rotor_positions is None
    bare = read_recording(save(log(combined(grid(0.005)), ROTORS))).facts
    assert (bare.rotor_positions, bare.rotor_spins, bare.cells, bare.landed) == (None, None, None, ())


def test_the_land_detector_counts_as_the_ground(save, run, tmp_path):
    detected = states("vehicle_land_detected", [-2.0, 0.5, 2.4, 2.6], landed=[1, 0, 0, 1], ground_contact=[1, 0, 1, 1])
    path = save(log(combined(grid(0.005)), escs(grid(0.01, 3.2, offset=-0.1)), detected))
    landed = read_recording(path).facts.landed
    np.testing.assert_allclose(landed, [(0.0, 0.5), (2.4, 2.995)], atol=1e-6)
    code, out, err = run("inspect", path.name)
    assert (code, err) == (0, "")
    assert out.count("on the ground") == 2
    assert "usable" in out
    never = states("vehicle_land_detected", [-2.0], landed=[1])
    save(log(combined(grid(0.005)), escs(grid(0.01, 3.2, offset=-0.1)), never))
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    code, out, err = run("inspect", path.name)
    words = "the vehicle never flew (from 0.0 s to 3.0 s: on the ground); give the log of a flight"
    assert out.splitlines()[1] == f"cannot identify a vehicle: {words}."
    result = run("estimate", path.name, "--model", "flight", "--airframe", "vehicle.toml")
    refused(result, f"jaxos4: {path.name}: {words}")


# Real logs

REAL = {
    "pyulog_sample_log_small": ("this is a VTOL", "this is a VTOL", "only a quadrotor can be identified"),
    "pyulog_sample_px4_events": ("at 10 Hz (actuator_motors)", "too little flight", "set SDLOG_PROFILE to 147"),
    "pyulog_sample_appended_multiple": ("the vehicle never flew", "on the ground", "give the log of a flight"),
    "px4_ulog_rs_esc_status": ("at 9.6 Hz (actuator_outputs)", "UAVCAN 1..8191", "set SDLOG_PROFILE to 17"),
}


@pytest.mark.parametrize("name", REAL)
def test_real_logs_that_identify_nothing_say_why_in_the_first_line(name, shared_flights, run, tmp_path):
    path = shared_flights / "px4" / f"{name}.ulg"
    if not path.is_file():
        pytest.skip("the folder of real flights has no logs of PX4")
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    cause, inspected, remedy = REAL[name]
    code, out, err = run("inspect", str(path))
    assert code == (2 if "VTOL" in cause else 0)
    assert inspected in " ".join((out + err).split())
    assert cause in (err or out.splitlines()[1])
    result = run("estimate", str(path), "--model", "flight", "--airframe", "vehicle.toml")
    refused(result, cause, remedy)


# Rates of their own


@given(seed=st.integers(0, 99), measured=st.booleans())
@settings(max_examples=30)
def test_impulse_is_conserved_whatever_the_rates(seed, measured):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.001, 0.1, 60))
    rows = np.sort(rng.uniform(t[0], t[-1], 40))
    values = rng.uniform(0, 900, (60, 4))
    got = root_mean_square(Series(t, values), rows, linear=measured)
    fine = np.linspace(rows[0], rows[-1], 400_001)
    held = values[np.searchsorted(t, fine, side="right") - 1] ** 2
    if measured:
        held = np.column_stack([np.interp(fine, t, column**2) for column in values.T])
    truth = held[:-1].mean(axis=0) * (rows[-1] - rows[0])
    np.testing.assert_allclose((got[:-1] ** 2 * np.diff(rows)[:, None]).sum(axis=0), truth, rtol=1e-3)


def test_a_slow_sensor_stands_at_its_nearest_row_and_not_across_its_gaps():
    rows = 0.01 * np.arange(200)
    t = np.delete(0.004 + 0.05 * np.arange(40), np.arange(10, 20))
    out = at_rows(rows, Series(t, np.sin(3 * t)[:, None]))[:, 0]
    measured = np.isfinite(out)
    np.testing.assert_allclose(out[measured], np.sin(3 * rows[measured]), atol=3 * 0.05**2)
    assert abs(np.count_nonzero(measured) - 29) <= 2
    assert not measured[(rows > t[9] + 0.01) & (rows < t[10] - 0.01)].any()
