"""Blackbox logs of Betaflight and INAV: signs from the meaning of the axes, units from settings or defaults, frames."""

import numpy as np
import pytest
from blackbox_logs import RATES, SETTINGS, T, bbl, recorded, without
from helpers import CRAZYFLIE, usable_stretches
from recorded_logs import FRD, GRAVITY, RPM, attitude, blackbox_csv, check, force, quaternions, rates, speeds

from jaxos4.errors import InputError
from jaxos4.logs import read_log, read_recording
from jaxos4.logs.blackbox_frames import Numbers
from jaxos4.recording import cut
from jaxos4.recording.motion import rotor_signs

ATTITUDE = (*RATES, "phi", "theta", "psi")


def test_what_is_assumed_of_units_is_said_unless_an_export_says_its_settings(save):
    text = " ".join(read_log(save(blackbox_csv(recorded(T))))[1])
    for words in ("14 motor poles", "2048 units for 1 g", "blackbox_high_resolution", "eRPM[0] is rotor 1"):
        assert words in text
    fine = SETTINGS | {"blackbox_high_resolution": "1", "fields": "[1,2,3]", "note": "motor[0], and more"}
    columns = recorded(T, poles=12, scale=10)
    columns["time"] = columns.pop("time (us)")
    flight, notes = read_log(save(blackbox_csv(columns, settings=fine)))
    check(flight, names=RATES, atol=5e-3)
    np.testing.assert_allclose(flight.omega, speeds(np.asarray(flight.time)), atol=100 / 6 * RPM)
    assert not any("taken as" in note or "default" in note for note in notes)


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [
        ("gyro.scale", "0x3d79c190", 0.061),  # of Cleanflight: the bits of a float, in deg/s
        ("gyro_scale", "0x3d79c190", 0.061),
        ("gyro_scale", "0x3f800000", 1.0),
        ("gyro_scale", "0x30925312", 0.061),  # of Baseflight, in rad/us
        ("gyroScale", "1.0646508e-9", 0.061),  # of Explorer, in rad/us
        ("gyroScale", "0.0001", 1.0),  # of Explorer, if it knows none
        ("gyro_scale", "0x7fc00000", 1.0),  # not a number
    ],
)
@pytest.mark.parametrize("raw", [False, True])
def test_the_gyro_has_the_scale_in_the_settings(name, text, count, raw, save):
    columns = recorded(T, scale=1 / count)
    columns |= {name: np.rint(x).astype(int) for name, x in columns.items() if name.startswith("gyro")}
    settings = SETTINGS | {"motor_poles": "14", name: text}
    content = bbl(columns, settings=settings) if raw else blackbox_csv(columns, settings=settings)
    check(read_log(save(content))[0], names=RATES, atol=np.deg2rad(count))


@pytest.mark.parametrize(
    ("time", "gyro", "force"), [("s", "deg/s", "g"), ("ms", "rad/s", "m/s/s"), ("us", "rad/s", "m/s2")]
)
def test_columns_that_blackbox_decode_has_converted_have_the_unit_in_their_name(time, gyro, force, save):
    columns = recorded(T)
    out = {f"time ({time})": columns.pop("time (us)") * {"s": 1e-6, "ms": 1e-3, "us": 1}[time]}
    for name, values in columns.items():
        if name.startswith("gyroADC"):
            out[f"{name} ({gyro})"] = np.round(values * {"deg/s": 1, "rad/s": np.pi / 180}[gyro], 4)
        elif name.startswith("accSmooth"):
            out[f"{name} ({force})"] = np.round(values / 2048 * (1 if force == "g" else GRAVITY), 4)
        else:
            out[name] = values
    out["vbatLatest (V)"] = np.full(T.size, 16.8)
    flight, notes = read_log(save(blackbox_csv(out)))
    check(flight, names=RATES)
    assert not any("gyroADC is taken" in note or "accSmooth" in note for note in notes)
    out = {name.replace("gyroADC[0] ", "gyroADC[0]  "): values for name, values in out.items()}
    with pytest.raises(InputError, match="no body rates"):
        read_log(save(blackbox_csv(out)))


def test_the_unfiltered_gyro_is_preferred_and_what_is_missing_or_off_is_not_measured(save):
    columns = recorded(T) | {f"gyroUnfilt[{i}]": np.full(T.size, 57.2957795 * (i + 1)) for i in range(3)}
    flight, notes = read_log(save(blackbox_csv(columns, settings=SETTINGS | {"acc_1G": "0"})))
    np.testing.assert_allclose(np.asarray(flight.states)[:, [7, 9, 11]], np.tile([1.0, 2, 3], (T.size, 1)), rtol=1e-6)
    assert flight.specific_force is None
    assert any("the accelerometer is off" in note for note in notes)
    text = blackbox_csv(recorded(T)).splitlines()
    for row in (50, 51):
        text[row] = ", ".join("NaN" if 2 <= i <= 4 else cell for i, cell in enumerate(text[row].split(", ")))
    flight, _ = read_log(save("\n".join(text)))
    assert np.isnan(np.asarray(flight.states)[49:51, 7]).all()


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


# Attitude, and the fields of Indiflight


def whole(scale, turned=False):
    """Quaternions as whole numbers; the first is not negative."""
    found = quaternions(T, turned)
    return np.rint(scale * found * np.sign(found[:, :1])).astype(int)


def fields(name, values):
    return {f"{name}[{i}]": column for i, column in enumerate(values.T)}


@pytest.mark.parametrize("raw", [True, False])
def test_the_attitude_of_betaflight_is_a_quaternion_without_its_first_number(raw, save):
    columns = recorded(T) | fields("imuQuaternion", whole(0x7FFF)[:, 1:])
    content = bbl(columns) if raw else blackbox_csv(columns, settings=SETTINGS | {"motor_poles": "14"})
    check(read_log(save(content))[0], names=ATTITUDE, atol=2e-2)  # the first number is near 0 at half a turn


def test_the_attitude_of_inav_is_angles_with_yaw_to_the_right(save):
    nose, left = attitude(T)[:, :, 0], attitude(T)[:, :, 1]
    down, right = np.arcsin(-nose[:, 2]), np.arctan2(left[:, 2], attitude(T)[:, 2, 2])
    angles = np.column_stack([right, down, -np.arctan2(nose[:, 1], nose[:, 0]) % (2 * np.pi)])
    columns = recorded(T) | fields("attitude", np.rint(10 * np.rad2deg(angles)).astype(int))
    check(read_log(save(blackbox_csv(columns, settings=SETTINGS)))[0], names=ATTITUDE, atol=5e-3)


@pytest.mark.parametrize("turned", [False, True])
def test_the_measured_speeds_and_the_attitude_of_indiflight_are_read(turned, save):
    """Its gyro and accelerometer were forward, left, up, as Betaflight's; now they are forward, right, down."""
    signs = FRD if turned else np.eye(3)
    columns = without(recorded(T, gyro=lambda t: rates(t) @ signs, accelerometer=lambda t: force(t) @ signs), "eRPM")
    columns |= fields("quat", whole(8127, turned=True)) | fields("omega", np.rint(0.9 * speeds(T)).astype(int))
    columns |= fields("omegaUnfiltered", np.rint(speeds(T)).astype(int))
    flight, notes = read_log(save(blackbox_csv(columns, settings=SETTINGS)))
    check(flight, names=ATTITUDE, atol=5e-3)
    np.testing.assert_allclose(flight.omega, speeds(T), atol=0.51)
    assert any("omegaUnfiltered[0] is rotor 1" in note for note in notes)
    assert any("count as forward, right, down" in note for note in notes) == turned
    filtered = without(columns, "omegaUnfiltered")
    flight, _ = read_log(save(blackbox_csv(filtered, settings=SETTINGS)))
    np.testing.assert_allclose(flight.omega, 0.9 * speeds(T), atol=0.51)


def test_an_attitude_that_never_changes_is_none(save):
    columns = recorded(T) | fields("imuQuaternion", np.zeros((T.size, 3), int))
    check(read_log(save(blackbox_csv(columns, settings=SETTINGS)))[0], names=RATES, atol=5e-3)


# Logs that are not decoded

ENCODED = [  # encoding, bytes by the description of the format, numbers
    (0, "00017f8001ff7cfeffffff0f", [0, -1, -64, 64, -8000, 2147483647]),
    (1, "007f8001808001ffffffff0f", [0, 127, 128, 16384, 4294967295]),
    (3, "05ff7f", [-5, 1]),
    (6, "ca05508f0302", [0, -3, 0, 40, 0, 0, -200, 1]),
    (7, "18", [1, -2, 0]),
    (7, "4873", [-8, 7, 3]),
    (7, "a01f00", [-32, 31, 0]),
    (7, "e4802c01a08601", [-128, 300, 100000]),
    (7, "cf00000080ffffff7f05", [-2147483648, 2147483647, 5]),
    (8, "e487f8ad00", [0, -8, 127, -30000]),
    (8, "151230", [1, 2, 3, 0]),
    (9, "", [0, 0, 0]),
    (10, "24", [-2, 1, 0]),
    (10, "60f8", [-16, 15, -8]),
    (10, "a01fc0", [-128, 63, -64]),
    (10, "f97fff409c00c0ab76ff", [-129, 40000, -9000000]),
]


@pytest.mark.parametrize(("encoding", "encoded", "numbers"), ENCODED)
def test_each_encoding_is_read(encoding, encoded, numbers):
    stream, found = Numbers(bytes.fromhex(encoded)), []
    stream.read(encoding, len(numbers), found)
    assert found == numbers
    assert stream.at == len(stream.data)


def test_a_log_that_is_not_decoded_is_the_same_flight(save):
    columns = recorded(T, scale=1)
    direct, notes = read_log(save(bbl(columns), "a.bbl"))
    check(direct, names=RATES, atol=2e-2)  # the gyro's unit is 1 deg/s
    decoded, _ = read_log(save(blackbox_csv({name: np.rint(x).astype(int) for name, x in columns.items()})))
    for name in ("omega", "states", "time"):
        np.testing.assert_allclose(getattr(direct, name), getattr(decoded, name), atol=1e-12)
    assert not any("taken as" in note or "default" in note for note in notes)


@pytest.mark.parametrize("firmware", ["Betaflight 4.2.11 (948)", "Betaflight 3.0.1", "INAV 7.1"])
def test_the_voltage_is_read_if_its_unit_is_known(firmware, save):
    name = "vbat" if "INAV" in firmware else "vbatLatest"
    columns = recorded(T) | {name: np.rint(1650 - 20 * T).astype(int)}
    voltage = read_log(save(bbl(columns, settings={"acc_1G": 2048, "Firmware revision": firmware})))[0].voltage
    assert (voltage is not None) == (" 4." in firmware)
    if voltage is not None:
        np.testing.assert_allclose(voltage, 16.5 - 0.2 * T, atol=0.006)


def test_sessions_follow_each_other(save):
    columns = recorded(T)
    flight, notes = read_log(save(bbl(columns) + b"\xff" * 99 + bbl(columns, end=False)))
    assert float(flight.time[-1]) == pytest.approx(2 * T[-1] + 1)
    assert any("2 sessions, of 3.0, 3.0 s, follow each other" in note for note in notes)
    assert any(note.startswith("session 2: has no end") for note in notes)
    assert [(round(part.begin), round(part.end)) for part in usable_stretches(flight)] == [(0, 3), (4, 7)]
    other = bbl(without(recorded(T[:900]), "eRPM"), settings={"acc_1G": 512})
    flight, notes = read_log(save(bbl(columns) + other))
    assert float(flight.time[-1]) == pytest.approx(T[-1])
    assert any("1 of 2 sessions are ignored" in note for note in notes)


@pytest.mark.parametrize("accident", ["drop", "flip"])
def test_differences_after_a_lost_frame_are_ignored(accident, save):
    """Up to the next complete frame; all others are as they were."""
    columns = recorded(T)
    content = bytearray(bbl(columns))
    whole, _ = read_log(save(bytes(content)))
    at = content.index(b"P", len(content) // 2)
    if accident == "drop":
        del content[at : at + 7]
    else:
        content[at] = 0xFF
    flight, notes = read_log(save(bytes(content)))
    assert any("is damaged in 1 place" in note for note in notes)
    lost = np.isnan(np.asarray(flight.states)[:, 7])
    assert 0 < lost.sum() <= 33
    np.testing.assert_allclose(np.asarray(flight.states)[~lost], np.asarray(whole.states)[~lost], atol=1e-9)


# Real logs. Decoding takes seconds: once for each log.

# Rear right, front right, rear left, front left; props out.
SIGNS = (-1, 1, -1, 1), (-1, -1, 1, 1), (1, -1, -1, 1)


@pytest.mark.parametrize(
    ("name", "rows", "sessions", "usable", "signs"),
    [
        ("btfl_001.bbl", 24991, 2, 0.0, None),  # its second session was carried by hand, with idle throttle
        ("btfl_002.bbl", 66640, 1, 0.7, SIGNS),
        ("LOG00037.BFL", 16774, 1, 0.9, None),
    ],
)
def test_a_real_log_is_what_another_decoder_makes_of_it(name, rows, sessions, usable, signs, shared_flights):
    flight = read_recording(shared_flights / "betaflight" / f"fc_{name}", full_scale=1.0)
    assert any(f"{rows} rows were resampled" in note for note in flight.notes)
    assert any(f"{sessions} sessions" in note for note in flight.notes) == (sessions > 1)
    assert np.nanmedian(np.linalg.norm(flight.specific_force, axis=1)) == pytest.approx(GRAVITY, rel=0.1)
    assert 3 * 3.5 < np.median(flight.voltage) < 6 * 4.3
    parts = usable_stretches(flight)
    kept = sum(part.length for part in parts)
    assert kept == 0 if usable == 0 else kept > usable * np.ptp(flight.time)
    if signs is not None:
        assert rotor_signs([cut(flight, part) for part in parts]) == signs


# Bad logs, for the laws of all readers.


def test_blank_lines_above_the_header_are_skipped_and_others_are_refused(save):
    text = blackbox_csv(recorded(T), settings={"acc_1G": "2048"})
    plain, spaced = (read_recording(save(each), full_scale=1.0) for each in (text, f"\n\n{text}"))
    np.testing.assert_array_equal(plain.states, spaced.states)
    with pytest.raises(InputError):
        read_recording(save(text.replace("\n", "\n\n")), full_scale=1.0)
