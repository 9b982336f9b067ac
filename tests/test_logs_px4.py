"""Logs of PX4: commands in any unit, the fastest sensor, facts beside the flight, broken files, real logs."""

import struct
import sys

import numpy as np
import pytest
from helpers import CRAZYFLIE, output_of, refused
from px4_logs import (
    ROTORS,
    T,
    angular_velocity,
    battery,
    combined,
    escs,
    everything,
    grid,
    local_position,
    log,
    motors,
    pwm,
    signals,
    states,
    thrusts,
)
from recorded_logs import FRD, VEHICLE, check, force, message, outcome, speeds

from jaxos4.errors import InputError
from jaxos4.logs import Sampling, read_log, read_recording
from jaxos4.logs.messages import Messages
from jaxos4.logs.ulog import _rotors

# Commands


def as_motors(t, curve):
    return [motors(t, thrusts(t).tolist())], {}


def as_old_pwm(t, curve):
    ends = {"PWM_MIN": 1075, "PWM_MAX": 1950, "PWM_MAIN_MIN1": -1, "PWM_MAIN_MIN2": 1100}
    low = np.array([1075.0, 1100.0, 1075.0, 1075.0])
    return [pwm(t, low + (1950 - low) * signals(thrusts(t), curve), others=1500.0)], ends


def as_pwm(t, curve):
    """Motors 1 to 4 on outputs 5, 2, 1, 7; a servo on 3."""
    channels = (4, 1, 0, 6)
    found = {f"PWM_AUX_FUNC{c + 1}": 101 + i for i, c in enumerate(channels)} | {"PWM_AUX_FUNC3": 201}
    found |= {f"PWM_AUX_MIN{c + 1}": 1100 for c in channels} | {f"PWM_AUX_MAX{c + 1}": 1900 for c in channels}
    other = pwm(t, np.full((t.size, 4), 1500.0))
    moving = pwm(t, 1100 + 800 * signals(thrusts(t), curve), channels=channels, others=1500.0)
    return [other, moving], found


def as_dshot(t, curve):
    return [pwm(t, 1999 * (0.055 + 0.945 * signals(thrusts(t), curve)))], {"DSHOT_MIN": 0.055, "DSHOT_CONFIG": 600}


def as_new_dshot(t, curve):
    topics, parameters = as_dshot(t, curve)
    functions = {f"PWM_MAIN_FUNC{i}": 100 + i for i in range(1, 5)}
    return topics, parameters | functions | {"DSHOT_CONFIG": 0, "PWM_MAIN_TIM0": 50, "PWM_MAIN_TIM1": -4}


def as_uavcan(t, curve):
    return [pwm(t, 1 + 8190 * signals(thrusts(t), curve), others=4095.5)], {"UAVCAN_ENABLE": 3}


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


def test_of_slow_motors_the_faster_are_read_and_unknown_motors_are_none(save):
    slow = escs(grid(0.25, 3.4, offset=-0.2))
    slower = motors(grid(0.5, 3.4, offset=-0.2), [[0.4] * 4] * 7)
    assert not read_log(save(log(combined(grid(0.005)), slow, slower)))[0].commanded
    topics, split = as_pwm(grid(0.005, 3.2, offset=-0.1), 0.0)
    split |= {"PWM_AUX_FUNC7": 0, "PWM_MAIN_FUNC1": 104}  # three motors on one driver, one on another
    with pytest.raises(InputError, match="no rotor speeds or commands"):
        read_log(save(log(combined(grid(0.005)), *topics, **split)), CRAZYFLIE)


# The fastest sensor


@pytest.mark.parametrize(
    ("angular", "imu", "topic", "step"),
    [(0.02, 0.004, "sensor_combined", 0.004), (0.002, 0.004, "vehicle_angular_velocity", 0.002)],
)
def test_the_fastest_gyro_is_taken(angular, imu, topic, step, save):
    found = read_recording(save(log(angular_velocity(grid(angular)), combined(grid(imu)), ROTORS)))
    check(found.flight, names=("p", "q", "r"))
    assert found.dt == pytest.approx(step)
    assert found.facts.gyro == Sampling(topic, pytest.approx(1 / step))


def test_a_faster_sensor_is_averaged_and_not_sampled(save):
    fast = grid(0.001, 3.2, offset=-0.1)
    shaken = force(fast) + 30 * np.cos(2 * np.pi * 200 * fast)[:, None]  # one period a row: samples would show 30
    acceleration = ("vehicle_acceleration", "uint64_t timestamp;float[3] xyz;", "Qfff", (shaken @ FRD).tolist(), fast)
    check(read_log(save(log(angular_velocity(grid(0.005)), acceleration, ROTORS)))[0], names=("p", "q", "r"), atol=5e-3)


# The vehicle


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
    np.testing.assert_allclose(found.voltage, 15.2, rtol=1e-6)
    assert "SDLOG_PROFILE to 147" in found.facts.faster
    generic = quad | {f"CA_ROTOR{i}_P{axis}": 1.0 for i in range(4) for axis in "XY"}
    assert read_recording(save(log(*topics, **generic))).facts.rotor_positions is None
    bare = read_recording(save(log(combined(grid(0.005)), ROTORS))).facts
    assert (bare.rotor_positions, bare.rotor_spins, bare.landed) == (None, None, ())


def test_the_land_detector_counts_as_the_ground(save, run):
    detected = states("vehicle_land_detected", [-2.0, 0.5, 2.4, 2.6], landed=[1, 0, 0, 1], ground_contact=[1, 0, 1, 1])
    path = save(log(combined(grid(0.005)), ROTORS, detected))
    landed = read_recording(path).facts.landed
    np.testing.assert_allclose(landed, [(0.0, 0.5), (2.4, 2.995)], atol=1e-6)
    out = output_of(run("inspect", path.name))
    assert out.count("on the ground") == 2
    assert "usable" in out
    never = states("vehicle_land_detected", [-2.0], landed=[1])
    save(log(combined(grid(0.005)), ROTORS, never))
    words = "the vehicle never flew (from 0.0 s to 3.0 s: on the ground); give the log of a flight"
    assert output_of(run("inspect", path.name)).splitlines()[1] == f"cannot identify a vehicle: {words}."


# The file


def test_speeds_are_put_in_the_motors_order_and_need_no_curve(save):
    esc = escs(grid(0.01, 3.2, offset=-0.1), order=(2, 0, 3, 1))
    flight, notes = read_log(save(log(combined(grid(0.005)), esc, THR_MDL_FAC=0.3)))
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.0025), atol=0.5)
    assert not any("THR_MDL_FAC" in note for note in notes)


def test_idle_escs_give_way_to_commands_which_need_a_full_scale_and_invalid_positions_are_not_measured(save):
    t = grid(0.01, 3.2, offset=-0.1)
    idle = (*escs(t)[:3], [(4, *[0] * 24) for _ in t], t)
    invalid, command = local_position(grid(0.02), valid=False), motors(t, [[0.4] * 4] * t.size)
    path = save(everything(esc=idle, motors=command, position=invalid))
    flight, notes = read_log(path, CRAZYFLIE)
    assert any("commands are used" in note for note in notes)
    np.testing.assert_allclose(flight.omega, 0.4 * T, rtol=1e-6)
    check(flight, names=("p", "q", "r", "phi", "theta", "psi", "z", "vx", "vy", "vz"))
    np.testing.assert_allclose(read_log(path, full_scale=1.0)[0].omega, 0.4, rtol=1e-6)
    with pytest.raises(InputError, match=r"field actuator_motors.control\[0\]: the rotor speed of full command"):
        read_log(path)


def test_idle_escs_without_commands_do_not_say_that_commands_are_used():
    """The note is of what was chosen."""
    t = grid(0.01)
    none = {"t": t} | {f"esc[{i}].esc_rpm": np.zeros(t.size) for i in range(4)}
    log = Messages("log", {"esc_status": {0: none}}, "")
    assert _rotors(log) is None
    assert log.notes == []
    commands = {"t": t} | {f"control[{i}]": np.full(t.size, 0.4) for i in range(4)}
    log = Messages("log", {"esc_status": {0: none}, "actuator_motors": {0: commands}}, "")
    assert _rotors(log).names[0] == "actuator_motors.control[0]"
    assert log.notes == ["esc_status holds no speed of at least one rotor: commands are used"]


def test_what_was_appended_after_a_restart_does_not_break_it(save):
    whole = everything()
    content = bytearray(whole[: len(whole) * 2 // 3 - 5])
    at = len(content)
    content[19 + 8] = 1  # data appended
    content[19 + 16 : 19 + 24] = struct.pack("<Q", at)
    assert content[18:19] == b"B"
    flight, _ = read_log(save(bytes(content) + message("L", b"6" + bytes(8) + b"hard fault")))
    check(flight, seconds=1.9)
    content[19 + 8] = 0
    assert isinstance(outcome(read_log, save(bytes(content) + message("L", b"6" + bytes(8) + b"hard fault") * 9)), str)


def test_without_pyulog_it_is_said_what_to_install(save, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog.core", None)
    with pytest.raises(InputError, match=r"install jaxos4\[ulog\]\.$"):
        read_log(save(everything()))


def test_a_corrupt_field_of_an_esc_is_missing():
    fields = {"esc[0].actuator_function": np.array([101.0, np.nan]), "esc[1].state": np.array([5.0])}
    log = Messages("log", {"esc_status": {0: fields}}, "")
    assert log.latest("esc_status", "esc[0].actuator_function") is None
    assert log.latest("esc_status", "esc[1].state") == 5.0


# Real logs

REAL = {
    "pyulog_sample_log_small": (
        "this is no quadrotor",
        "is_vtol: this is no quadrotor",
        "this is no quadrotor; give the log of a quadrotor",
    ),
    "pyulog_sample_px4_events": ("at 10 Hz (actuator_motors)", "cannot identify a vehicle", "set SDLOG_PROFILE to 147"),
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
    assert code == (2 if "no quadrotor" in cause else 0)
    assert inspected in " ".join((out + err).split())
    assert cause in (err or out.splitlines()[1])
    result = run("estimate", str(path), "--model", "flight", "--airframe", "vehicle.toml")
    refused(result, cause, remedy)
