"""The Crazyflie's micro-SD logs: versions, types, the sign of pitch, and damaged cards."""

import numpy as np
import pytest
from crazyflie_logs import GYRO, MOTORS, RPMS, STATE, T, angles, log_2019, ratios, sensors
from helpers import CRAZYFLIE
from recorded_logs import RPM, check, crazyflie, position, speeds

from jaxos4.errors import InputError
from jaxos4.logs import log_format, read_log


def test_events_of_other_rates(save):
    slow, commands = T[::5] + 0.001, T[::2] - 0.003
    events = [
        ("gyros", GYRO, T, sensors(T)),
        ("estimate", [*STATE[:3], "stateEstimate.z(e)"], slow, np.column_stack([angles(slow), position(slow)[:, 2]])),
        ("motors", MOTORS + ["pm.vbat(f)"], commands, np.column_stack([ratios(commands), 4.0 - 0.1 * commands])),
        ("never", ["a.b(B)"], np.zeros(0), np.zeros((0, 1))),
    ]  # fmt: skip
    flight, notes = read_log(save(crazyflie(events)), CRAZYFLIE)
    fewest = check(flight, names=("p", "q", "r", "phi", "theta", "psi", "z"), start=3.0, atol=4e-3)
    assert fewest == pytest.approx(slow.size, abs=2)
    np.testing.assert_allclose(
        flight.omega, 2500 * ratios(np.asarray(flight.time) + 3.0) / 65535, atol=2500 * 0.05 * 2 * 0.008
    )
    assert any("motor.m1" in note for note in notes)
    np.testing.assert_allclose(flight.voltage, 4.0 - 0.1 * (np.asarray(flight.time) + 3.0), atol=1e-3)
    with pytest.raises(InputError, match=r"field motor\.m1: the rotor speed of full command is not known"):
        read_log(save(crazyflie(events)))


def test_measured_speeds_are_used_before_commands(save):
    """In whatever event, and however often, they are logged."""
    slow = T[::4]
    events = [
        ("motors", GYRO + MOTORS, T, np.column_stack([sensors(T), ratios(T)])),
        ("speeds", RPMS, slow, np.rint(speeds(slow) / RPM)),
    ]
    flight, _ = read_log(save(crazyflie(events)), CRAZYFLIE)
    assert not flight.commanded
    np.testing.assert_allclose(flight.omega, speeds(np.asarray(flight.time) + 3.002), atol=1.0)


# The format of 2019


def test_blocks_with_a_wrong_checksum_are_ignored(save):
    content = bytearray(log_2019())
    content[len(content) // 2] ^= 1
    flight, notes = read_log(save(bytes(content)))
    check(flight)
    assert any("1 block of the log with a wrong checksum" in note for note in notes)
    assert 0 < np.isnan(np.asarray(flight.states)[:, 7]).sum() <= 8
    assert log_format(save(bytes(content))).name == "Crazyflie"
    flight, notes = read_log(save(bytes(content[: len(content) // 3])))
    check(flight, seconds=0.9)
    assert any("with a wrong checksum" in note for note in notes)
