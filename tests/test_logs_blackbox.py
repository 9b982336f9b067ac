"""Blackbox logs as CSV, of Betaflight and INAV: signs from the meaning of the axes, units from settings or defaults."""

import numpy as np
import pytest
from recorded_logs import GRAVITY, RPM, attitude, blackbox_csv, check, force, position, rates, speeds, velocity
from test_flight_csv import CRAZYFLIE

from jaxos4.errors import InputError
from jaxos4.logs import log_format, read_log

RATES = ("p", "q", "r")
SETTINGS = {"Product": "Blackbox flight data recorder by Nicholas Sherlock", "acc_1G": "2048", "motor_poles": "12"}


def recorded(t, *, poles=14, one_g=2048, scale=1.0, rate_unit="", field="gyroADC"):
    """What a Betaflight would log, in its own integers."""
    out = {"loopIteration": np.arange(t.size), "time (us)": np.rint(1e6 * t + 7e6).astype(int)}
    for i in range(3):  # about forward, left and up: right-handed, as gyroscopes are mounted
        out[f"{field}[{i}]{rate_unit}"] = np.round(np.rad2deg(rates(t)[:, i]) * scale, 3)
        out[f"accSmooth[{i}]"] = np.rint(force(t)[:, i] / GRAVITY * one_g).astype(int)
    for i in range(4):
        out[f"motor[{i}]"] = np.rint(48 + (2047 - 48) * (0.3 + 0.1 * i + 0.05 * np.sin(t))).astype(int)
        out[f"eRPM[{i}]"] = np.rint(speeds(t)[:, i] / RPM * (poles / 2) / 100).astype(int)
    return out


def inav(t):
    """INAV's attitude in tenths of a degree, from where the axes point; its position in centimetres."""
    nose, left = attitude(t)[:, :, 0], attitude(t)[:, :, 1]
    heading = np.arctan2(-nose[:, 1], nose[:, 0]) % (2 * np.pi)  # a compass bearing: clockwise from north
    down = np.arcsin(-nose[:, 2])
    right = np.arctan2(left[:, 2], np.sqrt(1 - nose[:, 2] ** 2 - left[:, 2] ** 2))  # left wing up
    out = {f"attitude[{i}]": np.round(10 * np.rad2deg(angle), 2) for i, angle in enumerate((right, down, heading))}
    for i in range(3):  # north, east, up
        sign = -1 if i == 1 else 1
        out[f"navPos[{i}]"] = np.round(100 * sign * position(t)[:, i], 3)
        out[f"navVel[{i}]"] = np.round(100 * sign * velocity(t)[:, i], 3)
    return out


T = 0.002 * np.arange(1500)


def without(columns, *prefixes):
    return {name: values for name, values in columns.items() if not name.startswith(prefixes)}


def test_a_decoded_log_comes_back_in_our_frame_and_units(save):
    path = save(blackbox_csv(recorded(T)))
    assert log_format(path).name == "blackbox"
    flight, notes = read_log(path)
    check(flight, names=RATES, atol=5e-3)
    np.testing.assert_allclose(flight.omega, speeds(np.asarray(flight.time)), atol=100 / 7 * RPM)
    assert float(flight.time[0]) == 0
    text = " ".join(notes)
    for words in ("14 motor poles", "2048 units for 1 g", "blackbox_high_resolution", "eRPM[0] is rotor 1"):
        assert words in text


def test_inavs_attitude_and_position_come_back_in_our_frame(save):
    columns = without(recorded(T), "eRPM") | inav(T)
    flight, _ = read_log(save(blackbox_csv(columns)), CRAZYFLIE)
    check(flight, atol=5e-3)
    wrong = columns | {"attitude[1]": -columns["attitude[1]"]}
    with pytest.raises(AssertionError):
        check(read_log(save(blackbox_csv(wrong)), CRAZYFLIE)[0], atol=5e-3)


def test_an_export_says_its_settings(save):
    fine = SETTINGS | {"blackbox_high_resolution": "1", "fields": "[1,2,3]", "note": "motor[0], and more"}
    columns = recorded(T, poles=12, scale=10)
    columns["time"] = columns.pop("time (us)")
    flight, notes = read_log(save(blackbox_csv(columns, settings=fine)))
    check(flight, names=RATES, atol=5e-3)
    np.testing.assert_allclose(flight.omega, speeds(np.asarray(flight.time)), atol=100 / 6 * RPM)
    assert not any("taken as" in note or "default" in note for note in notes)


@pytest.mark.parametrize(("unit", "factor"), [(" (deg/s)", 1.0), (" (rad/s)", np.pi / 180)])
def test_units_in_the_names_are_obeyed(unit, factor, save):
    columns = without(recorded(T, rate_unit=unit, scale=factor), "accSmooth")
    for i in range(3):
        columns[f"accSmooth[{i}] (g)"] = np.round(force(T)[:, i] / GRAVITY, 4)
    flight, notes = read_log(save(blackbox_csv(columns)))
    check(flight, names=RATES, atol=5e-3)
    assert not any("units for 1 g" in note for note in notes)


def test_the_unfiltered_gyro_is_preferred(save):
    columns = recorded(T) | {f"gyroUnfilt[{i}]": np.full(T.size, 57.2957795 * (i + 1)) for i in range(3)}
    flight, _ = read_log(save(blackbox_csv(columns)))
    np.testing.assert_allclose(np.asarray(flight.states)[:, [7, 9, 11]], np.tile([1.0, 2, 3], (T.size, 1)), rtol=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "settings"), [(48, 2047, {}), (1000, 2000, {}), (48, 2047, {"motorOutput": "158,2047"})]
)
def test_commands_are_fractions_of_their_protocol(low, high, settings, save):
    columns = without(recorded(T), "eRPM")
    command = np.clip(0.4 + 0.2 * np.sin(T), 0, 1)
    if high == 2000:
        command[:10] = 0.0  # not armed yet
    columns |= {f"motor[{i}]": np.rint(low + (high - low) * command).astype(int) for i in range(4)}
    flight, notes = read_log(save(blackbox_csv(columns, settings=settings)), CRAZYFLIE)
    np.testing.assert_allclose(np.asarray(flight.omega)[:, 2], 2500 * command, atol=2)
    assert any(f"from {low} to {high}" in note for note in notes)


def test_missing_values_are_not_measured(save):
    text = blackbox_csv(recorded(T)).splitlines()
    for row in (50, 51):
        text[row] = ", ".join("NaN" if 2 <= i <= 4 else cell for i, cell in enumerate(text[row].split(", ")))
    flight, _ = read_log(save("\n".join(text)))
    assert np.isnan(np.asarray(flight.states)[49:51, 7]).all()


LINES = blackbox_csv(recorded(T[:50])).splitlines()


def replaced(row, old, new):
    return "\n".join([*LINES[:row], LINES[row].replace(old, new, 1), *LINES[row + 1 :]])


BAD = {
    "raw": (b"H Product:Blackbox flight data recorder by Nicholas Sherlock\nH ...", "decode it by blackbox_decode"),
    "header only": (LINES[0], "has a header and no data"),
    "a cut line": ("\n".join(LINES)[:-20], "row 51"),
    "text": (replaced(5, LINES[5].split(", ")[2], "fast"), "row 6, column gyroADC[0]"),
    "time backward": ("\n".join([*LINES[:5], LINES[2], *LINES[5:]]), "row 6, column time (us)"),
    "no time": (replaced(0, "time (us)", "elapsed"), "there is no time"),
    "no gyro": (replaced(0, "gyroADC[1]", "other"), "there are no body rates"),
    "no motors": (blackbox_csv(without(recorded(T[:50]), "motor", "eRPM")), "column motor[0]: is missing"),
    "six motors": (
        blackbox_csv(recorded(T[:50]) | {"motor[4]": np.arange(50), "motor[5]": np.arange(50)}),
        "more than four motors",
    ),
    "settings above": ('"acc_1G","2048"\n' + "\n".join(LINES[:5]) + "\n1,2", "row 7"),
    "too fast": (blackbox_csv(recorded(T[:50], scale=200)), "beyond 60 rad/s; its unit is not the one"),
}


def test_commands_need_a_full_scale(save):
    with pytest.raises(InputError, match=r"column motor\[0\]: the rotor speed of full command is not known"):
        read_log(save(blackbox_csv(without(recorded(T), "eRPM"))))


SMALL = blackbox_csv(recorded(T[:30]), settings=SETTINGS).encode()
