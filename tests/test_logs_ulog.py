"""PX4's logs: our frame and units, any rates of logging, and one line for a damaged file."""

import builtins
import struct

import numpy as np
import pytest
from helpers import CRAZYFLIE
from px4_logs import T, combined, escs, everything, grid, local_position, log, motors
from recorded_logs import check, message, outcome, speeds

from jaxos4.errors import InputError
from jaxos4.logs import read_log


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


# The vehicle


def test_without_pyulog_it_is_said_what_to_install(save, monkeypatch):
    path, original = save(everything()), builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("pyulog"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"install jaxos4\[ulog\]\.$"):
        read_log(path)
