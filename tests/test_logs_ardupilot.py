"""DataFlash logs of ArduPilot: which messages are read, frames, outputs, rates that are too low, damage."""

import numpy as np
import pytest
from ardupilot_logs import T, angles, commands, imu, outputs
from helpers import CRAZYFLIE
from recorded_logs import FRD, RPM, check, dataflash, position, rates, speeds, velocity

from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES
from jaxos4.logs import log_format, read_log, read_recording

ATTITUDE = ("p", "q", "r", "phi", "theta", "psi")


def rate(t):
    return ("RATE", "fff", "R,P,Y", t, (np.rad2deg(rates(t) @ FRD),))


def ekf(t, core=0, shift=0.0):
    values = (np.full(t.size, core), velocity(t) @ FRD, position(t) @ FRD + shift)
    return ("XKF1", "Bffffff", "C,VN,VE,VD,PN,PE,PD", t, values)


def escs(t, order=(0, 1, 2, 3)):
    """One message for each motor, at times of its own."""
    each = [np.column_stack([np.full(t.size, o), speeds(t + 5e-4 * i)[:, i] / RPM]) for i, o in enumerate(order)]
    times = np.concatenate([t + 5e-4 * i for i in range(4)])
    return ("ESC", "Bf", "Instance,RPM", times, (np.concatenate(each),))


def everything(t=T):
    slow = t[::4]
    messages = [imu(t), rate(slow), angles(t, "ANG", "f"), ekf(t[::8]), escs(slow), outputs(t[::40])]
    messages.append(("BAT", "Bf", "Inst,Volt", t[::40], (np.zeros(t[::40].size), 16.0 - 0.1 * t[::40])))
    return dataflash(messages, {"FRAME_CLASS": 1.0, "LOG_BITMASK": 176126})


def test_a_log_is_the_same_flight(save):
    flight, notes = read_log(save(everything()))
    check(flight, start=0.0, names=STATE_NAMES, forces=True)
    t = np.asarray(flight.time)[:-4]  # after the last message, speeds are held
    np.testing.assert_allclose(flight.omega[:-4], speeds(t + 0.00125), atol=0.5)
    np.testing.assert_allclose(flight.voltage[:1150], 16 - 0.1 * np.asarray(flight.time)[:1150], atol=1e-4)
    assert not flight.commanded
    assert any("ESC.RPM of output 1 is rotor 1" in note for note in notes)


def test_the_library_of_ardupilot_reads_the_same(save, capfd):
    reader = pytest.importorskip("pymavlink.DFReader", reason="compares with the library of ArduPilot")
    path = save(everything())
    log, found = reader.DFReader_binary(str(path)), []
    while (message := log.recv_match(type=["IMU"])) is not None:
        found.append((message.GyrX, -message.GyrY, -message.GyrZ))
    log.filehandle.close()
    log.data_map.close()
    capfd.readouterr()
    read = read_recording(path)
    np.testing.assert_allclose(read.states[:, [7, 9, 11]], np.array(found)[: read.time.size], atol=1e-9)


def test_the_fastest_message_and_the_first_sensor_are_read(save):
    slow = T[::8]
    messages = [imu(slow), imu(slow, 1, -1), rate(T), angles(slow), ekf(slow), ekf(slow, 1, 99.0), outputs(T)]
    flight, notes = read_log(save(dataflash(messages)), CRAZYFLIE)
    check(flight, atol=4e-3)
    assert flight.time.size > 1190
    assert flight.commanded
    np.testing.assert_allclose(flight.omega[:-1], 2500 * commands(T[:-1]), atol=1.3)
    assert any("commands are RCOU, PWM 1000..2000" in note for note in notes)


@pytest.mark.parametrize("measured", [True, False])
def test_outputs_are_put_in_the_order_of_the_motors(measured, save):
    order = (2, 0, 7, 1)
    functions = {f"SERVO{output + 1}_FUNCTION": 33.0 + motor for motor, output in enumerate(order)}
    limits = {"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0}
    motors = escs(T[::4], order) if measured else outputs(T, order)
    flight, _ = read_log(save(dataflash([imu(T), angles(T), motors], functions | limits)), CRAZYFLIE)
    wanted = speeds(np.asarray(flight.time)[:-1] + 0.00125) if measured else 2500 * commands(T[:-1])
    np.testing.assert_allclose(flight.omega[:-1], wanted, atol=1.3)


def test_motors_at_10_hz_are_refused_with_the_setting_that_helps(save, run):
    save(dataflash([imu(T), angles(T), outputs(T[::40])], {"LOG_BITMASK": 176126.0}), "flight.bin")
    code, out, _ = run("inspect", "flight.bin")
    assert code == 0
    text = " ".join(out.split())
    assert "flight.bin: ArduPilot DataFlash log" in text
    assert "the motors were logged at 10 Hz (RCOU), too rarely to identify a vehicle" in text
    assert "SERVO_BLH_BDMASK = 15" in text
    assert f"set LOG_BITMASK to {176126 | 1 | 1 << 18} (with fast attitude and fast IMU), and fly again" in text


def test_measured_speeds_that_are_rare_are_not_used_if_commands_are_fast(save):
    flight, notes = read_log(save(dataflash([imu(T), angles(T), escs(T[::40]), outputs(T)])), CRAZYFLIE)
    assert flight.commanded
    assert any("measured speeds (ESC) were logged at 10 Hz only: commands are used" in note for note in notes)


def test_what_follows_damage_up_to_the_next_message_is_ignored(save):
    content = bytearray(everything())
    middle = content.index(b"\xa3\x95", len(content) // 2)
    whole, _ = read_log(save(bytes(content)))
    content[middle + 2 : middle + 7] = b""
    flight, notes = read_log(save(bytes(content) + bytes(5000)))
    assert any("is damaged in 1 place;" in note for note in notes)
    found, wanted = (np.asarray(each.states)[:1190, [7, 9, 11]] for each in (flight, whole))
    same = np.isfinite(found).all(axis=1)
    assert np.count_nonzero(~same) <= 2
    np.testing.assert_allclose(found[same], wanted[same], atol=1e-9)
    path = save(bytes(content), "00000001.BIN")
    assert log_format(path).name == "ArduPilot"


def test_a_new_format_of_zero_length_ends(save):
    """Of the message type that follows, each would be read for ever."""
    zero = b"\xa3\x95\x80" + bytes([200, 0]) + b"NONE" + b"B".ljust(16, b"\0") + b"A".ljust(64, b"\0")
    with pytest.raises(InputError, match="holds no body rates"):
        read_log(save(zero + 50 * b"\xa3\x95\xc8"))
