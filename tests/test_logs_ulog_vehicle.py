"""What a PX4 log says of its vehicle: commands as speeds, the fastest sensor, the vehicle's type, its facts."""

import numpy as np
import pytest
from helpers import refused
from hypothesis import given, settings, strategies as st
from recorded_logs import FRD, check, crazyflie, force, message, rates, speeds, ulog
from scipy.signal import butter, lfilter, sosfiltfilt
from test_flight_csv import CRAZYFLIE
from test_inspect import VEHICLE
from test_logs_ulog import (
    ESC,
    angular_velocity,
    battery,
    combined,
    escs,
    grid,
    motors,
    parameter,
    pwm,
    states,
    vehicle_attitude,
)

from jaxos4.errors import InputError
from jaxos4.logs import read_log, read_recording
from jaxos4.logs.sampling import Series, at_rows, logged_rate
from jaxos4.logs.table import SLOWEST_RATE, LogFacts, Sampling, gyro_rows

T = 2500.0  # the test airframe's full scale [rad/s]


def read_log_and_facts(path, airframe=None):
    found = read_recording(path, airframe)
    return found.flight, found.notes, found.facts


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
    flight, notes, facts = read_log_and_facts(path, CRAZYFLIE)
    assert flight.commanded
    assert any("logged at 4 Hz only: commands are used" in note for note in notes)
    assert facts.motors == Sampling("actuator_motors", pytest.approx(100.0))
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
    flight, _, facts = read_log_and_facts(save(log(angular_velocity(grid(angular)), combined(grid(imu)), ROTORS)))
    check(flight, names=("p", "q", "r"))
    assert float(flight.dt) == pytest.approx(step)
    assert facts.gyro == Sampling(topic, pytest.approx(1 / step))


def test_raw_sensors_are_calibrated_or_not_taken(save):
    t, offset, scale = grid(0.001), np.array([0.3, -0.2, 0.1]), np.array([1.01, 0.99, 1.02])
    gyro = raw("sensor_gyro", t, rates(t) @ FRD + offset)
    accelerometer = raw("sensor_accel", t, (force(t) @ FRD) / scale + offset, device=2**31 + 5)
    known = {"CAL_GYRO2_ID": 42, "CAL_ACC0_ID": -(2**31) + 5}
    known |= {f"CAL_GYRO2_{axis}OFF": float(o) for axis, o in zip("XYZ", offset, strict=True)}
    known |= {f"CAL_ACC0_{axis}OFF": float(o) for axis, o in zip("XYZ", offset, strict=True)}
    known |= {f"CAL_ACC0_{axis}SCALE": float(s) for axis, s in zip("XYZ", scale, strict=True)}
    topics = (combined(grid(0.02)), gyro, accelerometer, ROTORS)
    flight, _, facts = read_log_and_facts(save(log(*topics, **known)))
    check(flight, names=("p", "q", "r"))
    assert facts.gyro == Sampling("sensor_gyro", pytest.approx(1000.0))
    for spoilt in ({"SENS_BOARD_ROT": 2}, {"SENS_BOARD_Y_OFF": 1.0}, {"CAL_GYRO2_ID": 41}, {"CAL_GYRO2_ROT": 4}):
        flight, _, facts = read_log_and_facts(save(log(*topics, **(known | spoilt))))
        check(flight, names=("p", "q", "r"))
        assert facts.gyro == Sampling("sensor_combined", pytest.approx(50.0))


def test_a_faster_sensor_is_averaged_and_not_sampled(save):
    fast = grid(0.001, 3.2, offset=-0.1)
    shaken = force(fast) + 30 * np.cos(2 * np.pi * 200 * fast)[:, None]  # one period a row: samples would show 30
    acceleration = ("vehicle_acceleration", "uint64_t timestamp;float[3] xyz;", "Qfff", (shaken @ FRD).tolist(), fast)
    check(read_log(save(log(angular_velocity(grid(0.005)), acceleration, ROTORS)))[0], names=("p", "q", "r"), atol=5e-3)


def test_a_gyro_beyond_a_kilohertz_is_averaged_to_one():
    t = grid(0.00025, 2.0)
    noise = np.random.default_rng(0).normal(0, 0.1, (t.size, 3))
    motor = Series(grid(0.01, 2.2, offset=-0.1), np.full((220, 4), 0.5))
    rows, columns = gyro_rows("", Series(t, rates(t) + noise), motor, measured=False, others={})
    assert np.median(np.diff(rows)) == pytest.approx(0.001)
    off = np.column_stack([columns[name] for name in "pqr"]) - rates(rows)
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
    "vtol": (states("vehicle_status", [0.0, 1.0], is_vtol=[0, 1]), {}, r"field vehicle_status.is_vtol: this is a VTOL"),
    "plane": (states("vehicle_status", [0.0], vehicle_type=[2]), {}, "field vehicle_status.vehicle_type: this is a fi"),
    "hexarotor": (states("vehicle_status", [0.0], system_type=[13]), {}, "vehicle_status.system_type: this is a hexa"),
    "type": (None, {"MAV_TYPE": 22}, "parameter MAV_TYPE: this is a VTOL"),
    "frame": (None, {"CA_AIRFRAME": 3}, "parameter CA_AIRFRAME: this is a VTOL"),
    "rotors": (None, {"CA_ROTOR_COUNT": 6}, "parameter CA_ROTOR_COUNT: this is a vehicle with 6 rotors"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_vehicle_that_is_no_quadrotor_is_refused_in_one_line(name, save):
    topic, parameters, words = OTHERS[name]
    topics = [combined(grid(0.005)), ROTORS, *([] if topic is None else [topic])]
    remedy = "only a quadrotor can be identified: give the log of one"
    with pytest.raises(InputError, match=f"{words}.*; {remedy}") as raised:
        read_log(save(log(*topics, **parameters)))
    assert "\n" not in str(raised.value)


def test_what_the_log_knows_of_a_quadrotor(save):
    quad = {"MAV_TYPE": 2, "CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4, "SDLOG_PROFILE": 131}
    # Quad X: 1 front right, 2 rear left, both counter-clockwise; 3 front left, 4 rear right. PX4's y points right.
    places = [(0.15, 0.25), (-0.15, -0.19), (0.15, -0.25), (-0.15, 0.19)]
    for i, (x, y) in enumerate(places):
        quad |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_KM": 0.05 if i < 2 else -0.05}
    status = states("vehicle_status", [0.0], is_vtol=[0], vehicle_type=[1], system_type=[2])
    topics = (combined(grid(0.005)), ROTORS, status, battery(grid(0.2), 15.2))
    flight, _, facts = read_log_and_facts(save(log(*topics, **quad)))
    np.testing.assert_allclose(facts.rotor_positions, [(x, -y) for x, y in places], rtol=1e-6)
    assert facts.rotor_spins == (1.0, 1.0, -1.0, -1.0)
    assert facts.cells == 4
    np.testing.assert_allclose(flight.voltage, 15.2, rtol=1e-6)
    assert "SDLOG_PROFILE to 147" in facts.faster
    generic = quad | {f"CA_ROTOR{i}_P{axis}": 1.0 for i in range(4) for axis in "XY"}
    assert read_log_and_facts(save(log(*topics, **generic)))[2].rotor_positions is None
    bare = read_log_and_facts(save(log(combined(grid(0.005)), ROTORS)))[2]
    assert (bare.rotor_positions, bare.rotor_spins, bare.cells, bare.landed) == (None, None, None, ())


def test_the_land_detector_counts_as_the_ground(save, run, tmp_path):
    detected = states("vehicle_land_detected", [-2.0, 0.5, 2.4, 2.6], landed=[1, 0, 0, 1], ground_contact=[1, 0, 1, 1])
    path = save(log(combined(grid(0.005)), escs(grid(0.01, 3.2, offset=-0.1)), detected))
    landed = read_log_and_facts(path)[2].landed
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


# How often motors and gyro were logged


@given(step=st.floats(0.001, 0.9), seed=st.integers(0, 99), pauses=st.integers(0, 3), bursts=st.booleans())
@settings(max_examples=60)
def test_the_rate_is_that_of_the_samples_whatever_pauses_and_bursts_come_between(step, seed, pauses, bursts):
    rng = np.random.default_rng(seed)
    steps = step * rng.uniform(0.9, 1.1, 300)
    if bursts:  # five samples at once, then nothing for five steps: this is no high rate
        steps = np.tile([1e-6, 1e-6, 1e-6, 1e-6, step], 60)
    steps[rng.integers(0, 300, pauses)] = 500.0
    assert logged_rate(np.cumsum(steps)) == pytest.approx(1 / step, rel=0.11)


def test_the_rate_of_almost_nothing():
    assert logged_rate(np.zeros(1)) == 0
    assert logged_rate(np.array([0.0, 5.0])) == pytest.approx(0.2)
    assert LogFacts().too_slow == ""
    assert LogFacts(Sampling("m", 38.5), Sampling("g", 250.0)).too_slow == ""  # a nominal 40 Hz with jitter


def slow_ulog(step):
    t = grid(step, 3.4, offset=-0.2)
    topics = (combined(grid(0.004)), vehicle_attitude(grid(0.02)), motors(t, thrusts(t).tolist()))
    return log(*topics, SDLOG_PROFILE=131)


def slow_csv(step):
    t = grid(0.004)
    command = thrusts(t).astype(str)
    command[np.arange(t.size) % round(step / 0.004) != 0] = ""
    lines = [",".join(["t", *(f"command{i}" for i in range(1, 5)), "p", "q", "r"])]
    for row in zip(t.tolist(), *command.T, *rates(t).T.tolist(), strict=True):
        lines.append(",".join(map(str, row)))
    return "\n".join(lines).encode()


def slow_crazyflie(step):
    t, slow = grid(0.004), grid(step, 3.4)
    gyro = ["gyro.x(f)", "gyro.y(f)", "gyro.z(f)"]
    events = [("g", gyro, t, np.degrees(rates(t)))]
    events.append(("m", [f"motor.m{i}(H)" for i in range(1, 5)], slow, np.rint(65535 * thrusts(slow))))
    return crazyflie(events)


REMEDIES = {
    slow_ulog: ("actuator_motors", "set SDLOG_PROFILE to 147 (which includes 16, 'high rate')"),
    slow_csv: ("command1", "log motors and gyro at 100 Hz or more"),
    slow_crazyflie: ("motor.m1", "raise the frequency of these variables in the deck's config.txt"),
}


@pytest.mark.parametrize("kind", REMEDIES)
def test_motors_at_10_hz_identify_nothing_and_it_is_said_first(kind, save, run, tmp_path):
    (tmp_path / "vehicle.toml").write_text(VEHICLE)
    name, remedy = save(kind(0.1)).name, REMEDIES[kind][1]
    words = f"the motors were logged at 10 Hz ({REMEDIES[kind][0]}), too rarely to identify a vehicle: "
    code, out, err = run("inspect", name, "--airframe", "vehicle.toml", "--out", "found.json")
    assert (code, err) == (0, "")
    first = out.splitlines()[1]
    assert first.startswith(f"cannot identify a vehicle: {words}")
    assert remedy in first
    assert "rotor4: 10 Hz" in out
    assert "identifiable: alpha1" not in out
    result = run("estimate", name, "--model", "flight", "--airframe", "vehicle.toml")
    refused(result, f"jaxos4: {name}: {words}", remedy)
    assert read_log(save(kind(0.1)), CRAZYFLIE)[1][-1].startswith(words)
    fast = read_log_and_facts(save(kind(0.02)), CRAZYFLIE)[2]
    assert fast.motors == Sampling(REMEDIES[kind][0], pytest.approx(50.0, rel=0.01))
    assert fast.too_slow == ""


def closed_loop(lag, *, seconds=40, delay=0.01, dt=0.001):
    """Commands and body rate of one axis in closed loop, with unit inertia and gusts."""
    rng, size = np.random.default_rng(0), round(seconds / dt)
    wanted = np.repeat(rng.uniform(-3, 3, size // 400 + 1), 400)[:size]
    gusts = np.zeros(size)
    kicks = 2.0 * np.sqrt(2 * dt / 0.25) * rng.normal(size=size)
    command, rate, rotor, integral, gain = np.zeros(size), np.zeros(size), 0.0, 0.0, 1 / (4 * (lag + 0.02))
    for k in range(1, size):
        error = wanted[k - 1] - rate[k - 1]
        integral += error * dt
        command[k] = gain * (error + integral)
        rotor += dt / lag * (command[max(k - round(delay / dt), 0)] - rotor)
        gusts[k] = gusts[k - 1] * (1 - dt / 0.25) + kicks[k]
        rate[k] = rate[k - 1] + dt * (rotor + gusts[k])
    return command, rate


def identified(command, rate, every, dt=0.001):
    """1 / inertia from commands of which one in `every` was logged, at the lag and the delay that fit best."""
    band = butter(2, [1.0, 15.0], btype="band", fs=1 / dt, output="sos")
    held = command[np.arange(command.size) // every * every]
    acceleration = sosfiltfilt(band, np.gradient(rate, dt))[1000:-1000]
    fits = []
    for lag in (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1):
        torque = sosfiltfilt(band, lfilter([dt / lag], [1, dt / lag - 1], held))
        for delay in range(0, 40, 4):
            moved = np.roll(torque, delay)[1000:-1000]
            fits.append(((moved @ acceleration) ** 2 / (moved @ moved), moved @ acceleration / (moved @ moved)))
    return max(fits)[1]


@pytest.mark.parametrize("lag", [0.02, 0.08])
def test_the_limit_of_40_hz_is_what_rotors_with_these_lags_need(lag):
    flown = closed_loop(lag)
    best = identified(*flown, 4)
    assert best == pytest.approx(1, abs=0.15)
    assert identified(*flown, round(1000 / SLOWEST_RATE)) == pytest.approx(best, rel=0.08)
    assert identified(*flown, 100) < 0.75 * best  # at 10 Hz


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


def test_measured_speeds_of_a_vehicle_need_no_curve(save):
    flight, notes = read_log(save(log(combined(grid(0.005)), ROTORS, THR_MDL_FAC=0.3)))
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.0025), atol=0.5)
    assert not any("THR_MDL_FAC" in note for note in notes)
