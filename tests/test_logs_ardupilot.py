"""DataFlash logs of ArduPilot: which messages are read, frames, outputs, rates that are too low, damage."""

import numpy as np
import pytest
from ardupilot_logs import TEXTS, T, angles, ekf, escs, everything, imu, outputs, rate
from helpers import CRAZYFLIE
from recorded_logs import check, commands, dataflash, speeds

from jaxos4.errors import InputError
from jaxos4.logs import log_format, read_log, read_recording


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


@pytest.mark.parametrize("letter", TEXTS)
def test_a_text_is_no_number(letter, save):
    """It is as if the field was not there: no setting, and the next best source."""
    found = read_recording(save(TEXTS[letter]))
    assert found.specific_force is None
    assert found.facts.gyro.source == "RATE"


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
