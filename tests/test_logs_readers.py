"""The laws of all log formats on one table of readers: what is refused, what damage does, how often logs were written.

A file gives a usable flight or an `InputError` of one line, whatever it contains.
"""

import time

import ardupilot_logs as ardupilot
import blackbox_logs as blackbox
import column_logs as columns
import crazyflie_logs as crazyflie
import equinox as eqx
import flight_csvs as flight_csv
import numpy as np
import px4_logs as ulog
import pytest
from helpers import CRAZYFLIE, memory_below
from hypothesis import given, settings, strategies as st
from recorded_logs import RPM, blackbox_csv, check, outcome, speeds, survives_damage

from jaxos4 import logs
from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES
from jaxos4.logs import FORMATS, log_format, read_log

# Each reader: a good log, the bytes at its beginning that are its header, and bad logs with words of their messages.
SUBJECTS = {
    "ULog": (ulog.SMALL, 16, ulog.BAD),
    "ArduPilot": (ardupilot.SMALL, 300, ardupilot.BAD),
    "Crazyflie": (crazyflie.SMALL, 60, crazyflie.BAD),
    "Crazyflie, 2019": (crazyflie.SMALL_2019, 100, {}),
    "blackbox": (blackbox.SMALL, 400, blackbox.BAD),
    "blackbox, not decoded": (blackbox.SMALL_RAW, 400, {}),
    "NeuroBEM": (columns.neurobem_csv(50), 300, {}),
    "CSV": (flight_csv.csv().encode(), 38, flight_csv.BAD),
}
BAD = {(name, case): bad[case] for name, (_, _, bad) in SUBJECTS.items() for case in bad}


def read(path):
    return read_log(path, CRAZYFLIE)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "flight.log"


@pytest.mark.parametrize(("name", "case"), BAD)
def test_a_bad_log_is_refused_in_one_line(name, case, save):
    content, words = BAD[name, case]
    message = outcome(read, save(content))
    assert isinstance(message, str)
    for word in [words] if isinstance(words, str) else words:
        assert word in message


@pytest.mark.slow
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_damaged_log_and_any_bytes_after_a_part_of_the_header(name, path):
    content, header, _ = SUBJECTS[name]
    path.write_bytes(content)
    assert log_format(path).name == name.partition(",")[0]
    survives_damage(read, path, content, examples=100)

    @given(junk=st.binary(max_size=400), keep=st.integers(0, header))
    @settings(max_examples=60)
    def law_of_junk(junk, keep):
        path.write_bytes(content[:keep] + junk)
        assert isinstance(outcome(read, path), str)  # no flight is found by chance

    law_of_junk()


PX4_OF_2016 = ardupilot.SMALL.replace(b"Type,Length,Name,Format,Columns", b"Type,Length,Name,Format,Labels\0")
UNREAD = {
    "zip": (b"PK\x03\x04" + bytes(60), "is an archive (zip, tar, or .xlsx, .npz); unpack it"),
    "gzip": (b"\x1f\x8b\x08" + bytes(60), "is a compressed file; unpack it"),
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(60), "is an HDF5 file (netCDF, MATLAB 7.3); read it in Python"),
    "MATLAB": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "is a MATLAB file"),
    "NumPy": (b"\x93NUMPY\x01\0", "is a NumPy file"),
    "Parquet": (b"PAR1\x15\x04", "is a Parquet or Arrow file"),
    "Excel": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "is an Excel file"),
    "UTF-16": ("t,p\n".encode("utf-16"), "is text in UTF-16; save it as CSV in UTF-8"),
    "ArduPilot text": (b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "give the .BIN file"),
    "telemetry": (b"\0\x05\xa1\xb2\xc3\xd4\xe5\xf6\xfd\x09", "is a telemetry log of MAVLink (.tlog)"),
    "DJI": (b"\x55\xaa".ljust(16, b".") + b"BUILD 2016", "is a log of DJI; decode it by DatCon"),
    "PX4 before ULog": (PX4_OF_2016, "is a log of PX4 from before ULog (.px4log); convert it to CSV by sdlog2_dump.py"),
    "zip of a CSV": (b"PK\x03\x04\x14" + bytes(25) + blackbox.SMALL, "is an archive"),
    "zip of another": (b"PK\x03\x04\x14" + bytes(25) + columns.neurobem_csv(50), "is an archive"),
    "tar of a CSV": (b"log.csv".ljust(257, b"\0") + b"ustar".ljust(255, b"\0") + blackbox.SMALL, "is an archive"),
    "a result": (
        b'{"estimator": "ibss"}',
        "is a JSON file; the result of `jaxos4 estimate` is read by `jaxos4 report`",
    ),
    "an airframe": (b"# weighed\n\nmass = 0.03\n", "is a TOML file, not a log; give a log here (an airframe,"),
    "a column map": (b'[columns]\np = "gyro x"\n', "is a TOML file"),
    "other": (b"abc\x01\x02\x03", "is of a kind that is not known; export it as CSV"),
}


@pytest.mark.parametrize("case", UNREAD)
def test_a_file_that_is_not_read_is_named_with_what_to_do(case, save):
    content, words = UNREAD[case]
    message = outcome(read, save(content))
    assert words in message
    assert message.endswith("Logs that are read: " + ", ".join(each.label for each in FORMATS) + ".")


@pytest.mark.parametrize("time", ["[s] t", "[t]", "{t}", '"{t}"'])
def test_a_csv_whose_first_column_begins_as_toml_or_json_does_is_read_by_a_column_map(time, save):
    header, rows = flight_csv.csv().split("\n", 1)
    names = {name: name for name in header.split(",")} | {"t": time.strip('"')}
    plain, _ = read_log(save(f"{header}\n{rows}".encode()))
    again, _ = read_log(save(f"{time}{header.removeprefix('t')}\n{rows}".encode()), columns={"columns": names})
    np.testing.assert_array_equal(again.states, plain.states)


@pytest.mark.parametrize("preamble", ["rate = 100 Hz", "rate = 100"])
def test_a_csv_with_a_preamble_is_no_toml(preamble, save):
    path = save(f"{preamble}\n{flight_csv.csv()}".encode())
    assert log_format(path) is logs.CSV
    assert "row 1: is separated by blanks" in outcome(read, path)


class Failing:
    """A format of another package that was made for another version."""

    label = "lab"

    def recognises(self, begin):
        raise AttributeError("no such version")


@pytest.mark.parametrize("kind", [Failing(), None])
def test_a_wrong_format_of_another_package_is_a_warning(kind, save, monkeypatch):
    monkeypatch.setattr(logs, "_OTHERS", {"lab": kind})
    path = save(flight_csv.csv().encode())
    with pytest.warns(UserWarning, match=r"the log format lab of another package fails \(.*\); update or uninstall it"):
        assert log_format(path) is logs.CSV
    with pytest.warns(UserWarning, match="lab"), pytest.raises(InputError, match="flight CSV, lab"):
        log_format(save(UNREAD["gzip"][0]))


# Frame, units and truncation

# Each whole log: its content, its states, the time at which it begins, the tolerances of states and rotor speeds.
WHOLE = {
    "ULog": (ulog.everything(), STATE_NAMES, 0.0, 2e-3, 0.5),
    "ArduPilot": (ardupilot.everything(), STATE_NAMES, 0.0, 2e-3, 0.5),
    "Crazyflie, version 1": (crazyflie.one_event(crazyflie.T, version=1), STATE_NAMES, 3.0, 2e-3, 0.6 * RPM),
    "Crazyflie, 2019": (crazyflie.log_2019(), STATE_NAMES, 0.0, 2e-3, 0.6 * RPM),
    "Crazyflie": (crazyflie.one_event(crazyflie.T), STATE_NAMES, 3.0, 2e-3, 0.6 * RPM),
    "blackbox": (blackbox_csv(blackbox.recorded(blackbox.T)), blackbox.RATES, 0.0, 5e-3, 100 / 7 * RPM),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_flight_comes_back_in_our_frame_and_units(name, save):
    content, states, start, atol, of_speeds = WHOLE[name]
    flight, notes = read_log(save(content))
    options = {"names": states, "start": start, "atol": atol}
    assert check(flight, **options) >= 0.95 * 3 / 0.02  # each sample of the slowest sensor is one sample
    assert flight.time[0] == 0
    middle = np.asarray(flight.time)[:-4] + start + (0.0 if name == "blackbox" else float(flight.dt) / 2)
    np.testing.assert_allclose(flight.omega[:-4], speeds(middle), atol=of_speeds)  # after the last, speeds are held
    assert not flight.commanded
    assert any("is rotor 1" in note for note in notes) == (not name.startswith("Crazyflie"))
    if name == "ArduPilot":
        np.testing.assert_allclose(flight.voltage[:1150], 16 - 0.1 * np.asarray(flight.time)[:1150], atol=1e-4)
    for column in {STATE_NAMES.index(each) for each in ("q", "theta", "psi", "y", "vz") if each in states}:
        wrong = eqx.tree_at(lambda f: f.states, flight, flight.states.at[:, column].multiply(-1))
        with pytest.raises(AssertionError):
            check(wrong, **options)


@pytest.mark.parametrize("name", ["ULog", "Crazyflie"])
def test_a_log_cut_by_a_loss_of_power_is_read_to_there(name, save):
    content, _, start, *_ = WHOLE[name]
    part = content[: len(content) * 2 // 3]
    for cut in (part, part + bytes(5000)) if name == "ULog" else (part, content[:-4]):
        flight, notes = read_log(save(cut))
        assert name == "ULog" or any("no valid checksum" in note for note in notes)
        check(flight, start=start, seconds=1.9)
    assert not any("no valid checksum" in note for note in read_log(save(content))[1])


COSTLY = {name: ulog.announced(formats) for name, formats in ulog.BOMBS.items()}
COSTLY["empty events"] = crazyflie.EMPTY_EVENTS


@pytest.mark.parametrize("name", COSTLY)
def test_a_few_bytes_cost_little_whatever_they_announce(name, save):
    path = save(COSTLY[name])
    begin = time.process_time()
    with memory_below(100e6 if name == "empty events" else 20e6):
        assert isinstance(outcome(read_log, path), str)
    assert time.process_time() - begin < 10


def test_each_format_is_a_subject():
    elsewhere = {"ROS"}  # test_logs_ros, because its bags need rosbags
    assert {name.partition(",")[0] for name in SUBJECTS} | elsewhere == {each.name for each in FORMATS}
