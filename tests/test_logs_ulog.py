"""PX4's logs: our frame and units, any rates of logging, and one line for a damaged file."""

import builtins
import struct
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from recorded_logs import FRD, RPM, attitude, check, force, message, outcome, position, rates, speeds, ulog, velocity
from scipy.spatial.transform import Rotation
from test_flight_csv import CRAZYFLIE

from jaxos4.errors import InputError
from jaxos4.logs import read_log
from jaxos4.logs.sampling import Series, at_rows, root_mean_square

T = 2500.0  # the test airframe's full scale [rad/s]
ESC = b"esc_report:uint64_t timestamp;int32_t esc_rpm;uint8_t actuator_function;uint8_t[3] _padding0;"


def grid(step, seconds=3.0, offset=0.0):
    return offset + step * np.arange(round(seconds / step))


def angular_velocity(t):
    # stamped half a millisecond after it was sampled
    rows = [(int(1e6 * (s + 5.0)), *row) for s, row in zip(t, rates(t) @ FRD, strict=True)]
    fields = "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;"
    return "vehicle_angular_velocity", fields, "QQfff", rows, t + 5e-4


def combined(t):
    rows = np.column_stack([rates(t) @ FRD, force(t) @ FRD]).tolist()
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


def escs(t, order=(0, 1, 2, 3)):
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


def test_a_flight_comes_back_in_our_frame_and_units(save):
    flight, notes = read_log(save(everything()))
    fewest = check(flight)
    assert fewest >= 0.95 * 3 / 0.02  # each sample of the slowest sensor is one sample
    assert float(flight.dt) == pytest.approx(0.005)
    middle = np.asarray(flight.time)[:-1] + 0.0025
    np.testing.assert_allclose(flight.omega[:-1], speeds(middle), atol=0.5)
    assert any("esc_status.esc[0].esc_rpm is rotor 1" in note for note in notes)


def test_a_sign_that_is_wrong_would_show(save):
    flight, _ = read_log(save(everything(angular=None, combined=combined(grid(0.005)))))
    check(flight)
    q = np.asarray(flight.states).copy()
    q[:, 9] *= -1
    with pytest.raises(AssertionError):
        check(type(flight)(flight.time, flight.omega, q, flight.specific_force))


def test_speeds_are_put_in_the_motors_order(save):
    flight, _ = read_log(save(everything(esc=escs(grid(0.01, 3.2, offset=-0.1), order=(2, 0, 3, 1)))))
    np.testing.assert_allclose(flight.omega[:-1], speeds(np.asarray(flight.time)[:-1] + 0.0025), atol=0.5)


def test_commands_are_held_and_scaled(save):
    t = grid(0.05, 3.2, offset=-0.1)
    command = 0.3 + 0.1 * np.arange(4) + 0.05 * np.sign(np.sin(9 * t))[:, None]
    path = save(everything(esc=None, motors=motors(t, command.tolist())))
    flight, notes = read_log(path, CRAZYFLIE)
    check(flight)
    held = command[np.searchsorted(t, np.asarray(flight.time) + 1e-9, side="right") - 1]
    steady = np.abs(np.diff(held, axis=0)).max(axis=1) == 0
    np.testing.assert_allclose(np.asarray(flight.omega)[:-1][steady], T * held[:-1][steady], rtol=1e-6)
    assert any("actuator_motors.control" in note for note in notes)
    assert np.asarray(read_log(path, full_scale=1.0)[0].omega).max() < 1
    with pytest.raises(InputError, match=r"field actuator_motors.control\[0\]: the rotor speed of full command"):
        read_log(path)


@pytest.mark.parametrize(("scale", "offset", "words"), [(1000, 1000, "PWM"), (1999, 0, "DShot")])
def test_outputs_are_pwm_or_dshot(scale, offset, words, save):
    t = grid(0.02, 3.2, offset=-0.1)
    command = np.tile([[0.2, 0.3, 0.4, 0.5]], (t.size, 1)) + 0.1 * np.sin(3 * t)[:, None]
    path = save(everything(esc=None, outputs=pwm(t, (offset + scale * command).tolist())))
    flight, notes = read_log(path, CRAZYFLIE)
    assert any(words in note for note in notes)
    np.testing.assert_allclose(np.asarray(flight.omega).mean(axis=0), T * command.mean(axis=0), rtol=0.01)


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


def test_a_log_cut_by_a_loss_of_power_is_read_to_there(save):
    content = everything()
    for tail in (content[: len(content) * 2 // 3], content[: len(content) * 2 // 3] + bytes(5000)):
        flight, notes = read_log(save(tail))
        assert any("ends abruptly" in note for note in notes)
        check(flight, seconds=1.9)


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


def test_time_that_runs_backward_is_reported(save):
    content = bytearray(everything(angular=None))
    stamps = [i for i in range(len(content) - 11) if content[i : i + 3] == b"\x22\x00D"][:60]
    assert len(stamps) == 60
    for at in stamps:  # of sensor_combined: its first minute comes late
        content[at + 5 : at + 13] = struct.pack("<Q", 9_000_000_000 - at)
    assert "time runs backward" in str(outcome(read_log, save(bytes(content))))


def nested(width, depth):
    """Formats that hold `width` ** `depth` fields."""
    formats = [f"m{i}:m{i + 1}[{width}] inner;" for i in range(depth)]
    formats += [f"m{depth}:float x;", f"sensor_combined:uint64_t timestamp;m0[{width}] inner;"]
    return b"".join(message("F", text.encode()) for text in formats)


BOMBS = {
    "wide": message("F", b"sensor_combined:uint64_t timestamp;float[65535] a;float[65535] b;"),
    "nested": nested(100, 3),
    "deep": nested(1, 60),
    "endless": message("F", b"sensor_combined:uint64_t timestamp;sensor_combined[2] inner;"),
    "empty arrays": message("F", b"sensor_combined:uint64_t timestamp;sensor_combined[0] inner;"),
    "long": b"\xff\xff\x01" * 2000,
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_few_bytes_cost_little_whatever_they_announce(name, save):
    path = save(ulog([], before=BOMBS[name] + message("A", b"\0\0\0sensor_combined")))
    tracemalloc.start()
    begin = time.perf_counter()
    result = outcome(read_log, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert isinstance(result, str)
    assert peak < 20e6
    assert time.perf_counter() - begin < 5


def test_without_pyulog_it_is_said_what_to_install(save, monkeypatch):
    path, original = save(everything()), builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("pyulog"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"install jaxos4\[ulog\]\.$"):
        read_log(path)


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
