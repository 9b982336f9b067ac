"""Blackbox logs of Betaflight and INAV: signs from the meaning of the axes, units from settings or defaults, frames."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings as hypothesis_settings, strategies as st
from recorded_logs import (
    GRAVITY,
    RPM,
    attitude,
    blackbox_csv,
    check,
    damaged,
    force,
    outcome,
    position,
    rates,
    speeds,
    velocity,
)
from test_flight_csv import CRAZYFLIE

from jaxos4.errors import InputError
from jaxos4.flight import Flight
from jaxos4.logs import log_format, read_log
from jaxos4.logs.blackbox_frames import Numbers
from jaxos4.recording import usable_stretches

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


@pytest.mark.parametrize("how", ["setting", "zeros"])
def test_an_accelerometer_that_is_off_is_none(how, save):
    columns = (
        recorded(T) if how == "setting" else recorded(T) | {f"accSmooth[{i}]": 0 * T.astype(int) for i in range(3)}
    )
    settings = SETTINGS | ({"acc_1G": "0"} if how == "setting" else {})
    flight, notes = read_log(save(blackbox_csv(columns, settings=settings)))
    assert flight.specific_force is None
    assert any("the accelerometer is off" in note for note in notes)


# Logs that are not decoded. The writers of the encodings follow the description of the format.


def unsigned(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def signed(value):
    return unsigned((value << 1 ^ value >> 31) & 0xFFFFFFFF)


def bits(*pairs):
    """Bytes of signed values, each as (value, width), the highest bit first; filled up with zeros."""
    text = "".join(f"{value & (1 << width) - 1:0{width}b}" for value, width in pairs)
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


def fits(value, width):
    return -(1 << width - 1) <= value < 1 << width - 1


def of_bytes(values):
    lengths = [next(n for n in (1, 2, 3, 4) if fits(value, 8 * n)) for value in values]
    lead = 0xC0 | sum(length - 1 << 2 * i for i, length in enumerate(lengths))
    return bytes([lead]) + b"".join(v.to_bytes(n, "little", signed=True) for v, n in zip(values, lengths, strict=True))


def tag2_3(values):
    for width, lead in ((2, 0), (4, 1), (6, 2)):
        if all(fits(value, width) for value in values):
            return bits(
                (lead, 2),
                *([(0, 2)] * (width == 4)),
                *((v, width + 2 * (width == 6 and i > 0)) for i, v in enumerate(values)),
            )
    return of_bytes(values)


def tag2_3_variable(values):
    for lead, widths in enumerate(((2, 2, 2), (5, 5, 4), (8, 7, 7))):
        if all(map(fits, values, widths)):
            return bits((lead, 2), *zip(values, widths, strict=True))
    return of_bytes(values)


def tag8_4(values):
    widths = [0 if value == 0 else next(w for w in (4, 8, 16) if fits(value, w)) for value in values]
    header = sum((0, 4, 8, 16).index(width) << 2 * i for i, width in enumerate(widths))
    return bytes([header]) + bits(*((v, w) for v, w in zip(values, widths, strict=True) if w))


def tag8(values):
    header = sum((value != 0) << i for i, value in enumerate(values))
    return bytes([header]) + b"".join(signed(value) for value in values if value)


WRITERS = {0: (signed, 1), 1: (unsigned, 1), 6: (tag8, 8), 7: (tag2_3, 3), 8: (tag8_4, 4), 9: (None, 1)}
WRITERS[10] = (tag2_3_variable, 3)
LAYOUT = {
    "loopIteration": (9, 6),
    "time": (0, 2),
    "gyroADC": (7, 1),
    "accSmooth": (10, 1),
    "motor": (8, 3),
    "eRPM": (6, 1),
}


def bbl(columns, *, settings=None, interval=32, end=True):
    """A session with the integers `columns`; a complete frame every `interval` rows."""
    columns = {name.replace("time (us)", "time"): np.rint(values).astype(int) for name, values in columns.items()}
    columns["loopIteration"] = 4 * np.arange(columns["time"].size)
    order = list(LAYOUT)  # fields of one encoding stand together, others at the end
    columns = dict(
        sorted(columns.items(), key=lambda item: (*order, item[0].split("[")[0]).index(item[0].split("[")[0]))
    )
    layout = [LAYOUT.get(name.split("[")[0], (0, 1)) for name in columns]
    signs = [int(name.startswith(("gyro", "acc"))) for name in columns]
    lines = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock",
        "Data version": 2,
        "Field I name": ",".join(columns),
        "Field I signed": ",".join(map(str, signs)),
        "Field I predictor": ",".join("5" if name[:5] == "motor" and name != "motor[0]" else "0" for name in columns),
        "Field I encoding": ",".join(
            "0" if s or name[:5] == "motor" else "1" for s, name in zip(signs, columns, strict=True)
        ),
        "Field P predictor": ",".join(str(predictor) for _, predictor in layout),
        "Field P encoding": ",".join(str(encoding) for encoding, _ in layout),
        "Field S name": "flightModeFlags,stateFlags",
        "Field S signed": "0,0",
        "Field S predictor": "0,0",
        "Field S encoding": "1,1",
        "I interval": 4 * interval,
        "P interval": 4,
        **(settings or {"acc_1G": 2048, "motor_poles": 14, "motorOutput": "48,2047"}),
    }
    out = bytearray("".join(f"H {key}:{value}\n" for key, value in lines.items()).encode())
    names, rows = list(columns), np.column_stack(list(columns.values())).tolist()
    for k, row in enumerate(rows):
        if k % interval == 0:
            first = row[names.index("motor[0]")] if "motor[0]" in names else 0
            out += b"E\x00" + unsigned(row[1]) + b"S\x01\x07" + b"I"
            for name, value, sign in zip(names, row, signs, strict=True):
                other = name[:5] == "motor" and name != "motor[0]"
                out += signed(value - first * other) if sign or name[:5] == "motor" else unsigned(value)
            before = earlier = row
            continue
        predicted = []
        for (_, predictor), one, two in zip(layout, before, earlier, strict=True):
            half = (one + two) // 2 if one + two >= 0 else -(-(one + two) // 2)
            predicted.append({1: one, 2: 2 * one - two, 3: half, 6: one + 4}[predictor])
        deltas = [value - guess for value, guess in zip(row, predicted, strict=True)]
        out += b"P"
        i = 0
        while i < len(deltas):
            encoding = layout[i][0]
            write, most = WRITERS[encoding]
            stop = i + 1
            while stop < len(deltas) and stop - i < most and layout[stop][0] == encoding:
                stop += 1
            if write is not None:
                out += write(deltas[i] if most == 1 else deltas[i:stop])
            i = stop
        before, earlier = row, before
    return bytes(out) + (b"E\xffEnd of log\0" if end else b"")


VALUES = st.one_of(st.integers(-3, 3), st.integers(-40, 40), st.integers(-(2**15), 2**15 - 1))


@given(values=st.lists(VALUES, min_size=8, max_size=8))
def test_each_encoding_comes_back(values):
    whole = {6: values, 7: values[:3], 8: values[:4], 10: values[:3]}
    for encoding, numbers in whole.items():
        stream, found = Numbers(WRITERS[encoding][0](numbers)), []
        stream.read(encoding, len(numbers), found)
        assert found == numbers
        assert stream.at == len(stream.data)


def test_a_log_that_is_not_decoded_is_the_same_flight(save):
    columns = recorded(T, scale=1)
    direct, notes = read_log(save(bbl(columns), "a.bbl"))
    check(direct, names=RATES, atol=2e-2)  # the gyro's unit is 1 deg/s
    integers = {name: np.rint(values).astype(int) for name, values in columns.items()}
    decoded, _ = read_log(save(blackbox_csv(integers)))
    for ours, other in ((direct.omega, decoded.omega), (direct.states, decoded.states), (direct.time, decoded.time)):
        np.testing.assert_allclose(ours, other, atol=1e-12)
    assert log_format(save(bbl(columns))).name == "blackbox"
    assert not any("taken as" in note or "default" in note for note in notes)


def test_settings_are_read_from_the_log_beside_its_csv(save):
    fine = {"acc_1G": 512, "motor_poles": 12, "motorOutput": "48,2047", "blackbox_high_resolution": 1}
    columns = recorded(T, poles=12, one_g=512, scale=10)
    save(bbl(columns) + bbl(columns, settings=fine), "LOG1.BFL")
    flight, notes = read_log(save(blackbox_csv(columns), "LOG1.02.csv"))
    check(flight, names=RATES, atol=3e-2)
    np.testing.assert_allclose(flight.omega, speeds(np.asarray(flight.time)), atol=100 / 6 * RPM)
    assert any("from LOG1.BFL beside it" in note for note in notes)
    for name in ("LOG1.csv", "LOG1.03.csv", "LOG2.01.csv"):  # which session, none, none
        assert not any(
            "beside it" in note and "settings are taken" in note
            for note in read_log(save(blackbox_csv(columns), name))[1]
        )


def test_the_gyros_scale_is_read(save):
    scale = {"gyro_scale": "0x" + struct.pack(">f", 1 / 16.4).hex()}
    flight, _ = read_log(save(bbl(recorded(T, scale=16.4), settings=scale)))
    check(flight, names=RATES, atol=5e-3)


@pytest.mark.parametrize(
    ("firmware", "name", "known"),
    [
        ("Betaflight 4.2.11 (948ba6339)", "vbatLatest", True),
        ("Betaflight 3.0.1", "vbatLatest", False),
        ("INAV 7.1", "vbat", True),
    ],
)
def test_the_voltage_is_read_if_its_unit_is_known(firmware, name, known, save):
    columns = recorded(T) | {name: np.rint(1650 - 20 * T).astype(int)}
    flight, _ = read_log(save(bbl(columns, settings={"acc_1G": 2048, "Firmware revision": firmware})))
    assert (flight.voltage is not None) == known
    if known:
        np.testing.assert_allclose(flight.voltage, 16.5 - 0.2 * T, atol=0.006)


def test_sessions_follow_each_other(save):
    columns = recorded(T)
    flight, notes = read_log(save(bbl(columns) + b"\xff" * 99 + bbl(columns, end=False)))
    assert float(flight.time[-1]) == pytest.approx(2 * T[-1] + 1)
    assert any("2 sessions, of 3.0, 3.0 s, follow each other" in note for note in notes)
    assert any(note.startswith("session 2: has no end") for note in notes)
    assert [(round(part.begin), round(part.end)) for part in usable_stretches(flight)] == [(0, 3), (4, 7)]
    other = {"acc_1G": 512}
    flight, notes = read_log(save(bbl(columns) + bbl(without(recorded(T[:900]), "eRPM"), settings=other)))
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


def test_a_damaged_log_gives_a_flight_or_one_line(save):
    columns = recorded(T[:100])
    content = bbl(columns) + bbl(columns)
    path = save(content)
    accidents = st.tuples(
        st.sampled_from(["cut", "flip", "flip", "insert", "drop", "zeros"]), st.floats(0, 1), st.integers(0, 999)
    )

    @given(accidents=st.lists(accidents, max_size=4), header=st.booleans())
    @hypothesis_settings(max_examples=300)
    def law(accidents, header):
        part = [(kind, place * 0.05 if header else place, value) for kind, place, value in accidents]
        path.write_bytes(damaged(content, part))
        outcome(lambda path: read_log(path, CRAZYFLIE), path)

    law()
    assert isinstance(outcome(lambda path: read_log(path, CRAZYFLIE), save(content)), Flight)


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
    "no frames": (bbl(recorded(T[:50]))[:600], "no frame of it can be decoded"),
    "unknown encoding": (
        bbl(recorded(T[:50])).replace(b"Field S encoding:1,1", b"Field S encoding:1,5"),
        "an encoding that is not known, 5",
    ),
    "no fields": (bbl(recorded(T[:50])).replace(b"Field I name", b"Field I nom"), "its header is damaged"),
    "six raw motors": (
        bbl(recorded(T[:50]) | {"motor[4]": np.arange(50), "motor[5]": np.arange(50)}),
        "more than four motors",
    ),
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
