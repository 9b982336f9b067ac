"""Flights to CSV and back; what a log may look like, what it may not, and what is done to an uneven one."""

import inspect

import numpy as np
import pytest
from flight_csvs import HEADER, ROWS, csv, edited, read_flight_and_notes
from helpers import CRAZYFLIE, same

import jaxos4.logs.csv as csv_module
import jaxos4.logs.table as table_module
from jaxos4.airframe import OS4
from jaxos4.errors import InputError
from jaxos4.logs import read_flight


def refusal(path, airframe=None):
    """The message, which is one line that begins with the file."""
    with pytest.raises(InputError) as caught:
        read_flight(path, airframe)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"{path}: ")
    assert message.endswith(".")
    return message.removeprefix(f"{path}: ")


# What a file may look like


SAME = {
    "crlf": csv().replace("\n", "\r\n"),
    "cr": csv().replace("\n", "\r"),
    "bom": "\ufeff" + csv(),
    "no end": csv().rstrip("\n"),
    "blank end": csv() + "\n  \n\n",
    "padded": csv().replace(",", " ,\t"),
    "quoted": "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in csv().split()),
    "forms": csv().replace(",-0.2,", ",-2.0E-01,").replace(",100,", ",+100.,"),
    "shuffled": "\n".join(",".join(line.split(",")[i] for i in (7, 3, 1, 0, 2, 5, 6, 4)) for line in csv().split()),
}
# The note of the reader, and the file.
NOTED = {
    "measured omega1..omega4 are used; command1, command2 are ignored": csv(
        HEADER + ",command1,command2", [row + ",0.5,0.5" for row in ROWS]
    ),
    "omega2: 2 empty cells filled with the value before, for up to 0.02 s": edited(4, "omega2", "").replace(
        "0.03,100,101", "0.03,100,"
    ),
    "unknown columns are ignored: 'P', 'roll', 'mode', 'Omega_1', 'mode', ''": csv(
        HEADER + ",P,roll,mode,Omega_1,mode,", [row + ',1,2,"a, b",4,é_1,' for row in ROWS]
    ),
}


@pytest.mark.parametrize("case", [*SAME, *NOTED])
def test_what_does_not_matter_and_what_the_reader_assumes_and_notes(case, save):
    flight, notes = read_flight_and_notes(save(SAME[case] if case in SAME else NOTED[case]))
    assert notes == (() if case in SAME else (case,))
    assert same(flight, read_flight(save(csv())))


VOLTAGES = [  # cells, and what is read
    (["", "12.0", "", "0", "11.7", ""], [12.0, 12.0, 11.9, 11.8, 11.7, 11.7]),
    (["12.0", "", "", "", "", "11.5"], np.linspace(12.0, 11.5, 6)),
    ([""] * 6, None),
    (["0", "", "-1", "0", "0", "0"], None),
]


@pytest.mark.parametrize(("cells", "expected"), VOLTAGES)
def test_voltage_is_interpolated_over_what_was_not_measured(cells, expected, save):
    uneven = [row.replace("0.03,", "0.034,", 1) for row in ROWS]
    for rows in (ROWS, uneven) if cells[-1] else (ROWS,):
        lines = [f"{row},{cell}" for row, cell in zip(rows, cells, strict=True)]
        voltage = read_flight_and_notes(save(csv(HEADER + ",voltage", lines)))[0].voltage
        assert (voltage is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(voltage, expected, rtol=1e-12)


def test_commands_are_fractions_of_full_scale(save):
    text = csv(HEADER.replace("omega", "command"), [row.replace(",10", ",0.10") for row in ROWS])
    flight, notes = read_flight_and_notes(save(text), CRAZYFLIE)
    np.testing.assert_allclose(flight.omega[0], 2500 * np.array([0.100, 0.101, 0.102, 0.103]), rtol=1e-15)
    for airframe in (None, OS4):
        assert "set max_rotor_speed [rad/s] in the airframe's TOML file" in refusal(save(text), airframe)


def test_warnings_point_at_the_caller(save):
    path = save(csv(HEADER + ",mode", [row + ",1" for row in ROWS]))
    with pytest.warns(UserWarning, match="unknown columns") as caught:
        inspect.unwrap(read_flight)(path)  # without the tests' own layer of shape checks
    assert caught[0].filename == __file__
    assert str(caught[0].message).startswith(f"{path}: ")


# What a file may not be


def test_paths_that_are_no_readable_file_and_too_many_rows(tmp_path, save, monkeypatch):
    assert "no such file" in refusal(tmp_path / "none.csv")
    assert "is a folder" in refusal(tmp_path)
    assert "no such file" in refusal(tmp_path / "none" / "none.csv")
    paths = {"a\nb": r"a\\nb: there is no such file", "a\0b": "null character", "a" * 5000: "cannot be read"}
    for path, words in (paths | {"\ud800": "cannot be read"}).items():
        with pytest.raises(InputError, match=words):
            read_flight(path)
    with monkeypatch.context() as patch:
        patch.setattr(csv_module, "MAX_ROWS", 5)
        assert "more than 5 rows" in refusal(save(csv()))

    def forbidden(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(table_module, "open", forbidden, raising=False)
    assert "permission denied" in refusal(tmp_path / "f.csv")


@pytest.mark.parametrize(
    ("row", "cell", "words"), [(3, "", ""), (6, " 1", ""), (7, "x", "row 7, column q"), (5, "1e999", "row 5")]
)
def test_plain_lines_are_read_together_up_to_the_first_that_is_not(row, cell, words, save):
    """The numbers and the refusals are those of a file that is read row by row."""
    path, found = save(edited(row, "q", cell)), []
    for lines in (1, 2, 100):
        if words:
            with pytest.raises(InputError, match=words):
                csv_module.read_table(path, csv_module.COLUMN_NAMES, lines_at_once=lines)
        else:
            table = csv_module.read_table(path, csv_module.COLUMN_NAMES, lines_at_once=lines)
            found.append(np.stack([*table.columns.values()]))
    assert all(np.array_equal(each, found[0], equal_nan=True) for each in found)


# Real flights

REAL = {
    "rollpitch": (42392, 0.988, 6),
    "yaw_a": (6563, 0.987, 2),
    "yaw_b": (4544, 0.993, 0),
    "hover": (34840, 0.989, 0),
}


@pytest.mark.parametrize("name", REAL)
def test_a_real_flight_is_read(name, shared_flights):
    rows, step, gaps = REAL[name]
    path = shared_flights / f"arpl_crazyflie_{name}.csv"
    flight, notes = read_flight_and_notes(path, CRAZYFLIE)
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    (note,) = notes
    assert f"{rows} rows were resampled to {flight.time.size} samples, one every {step} ms" in note
    assert (f"{gaps} gaps" in note) == (gaps > 0)
    time, states = np.asarray(flight.time), np.asarray(flight.states)
    assert abs(time[-1] - raw[-1, 0]) < 2e-3
    for state, column in ((7, 5), (9, 6), (11, 7)):
        kept = ~np.isnan(states[:, state])
        assert kept.mean() > 1 - 1e-3
        expected = np.interp(time[kept], raw[:, 0], raw[:, column])
        np.testing.assert_allclose(states[kept, state], expected, atol=1e-9)
    assert np.isnan(np.delete(states, [7, 9, 11], axis=1)).all()
    impulse = (np.asarray(flight.omega)[:-1] ** 2).sum(axis=0) * float(flight.dt)
    held = ((2500 * raw[:-1, 1:5]) ** 2 * np.diff(raw[:, 0])[:, None]).sum(axis=0)
    np.testing.assert_allclose(impulse, held, rtol=1e-3)
    # thrust over the flight carries the weight, so the units and the rotor columns are what they are taken for
    assert 0.6 < impulse.sum() * CRAZYFLIE.thrust_coefficient / (time[-1] * 0.027 * 9.81) < 1.6


def test_an_empty_first_rotor_cell_is_refused_also_beside_an_impossible_one(tmp_path):
    lines = edited(2, "omega1", "").splitlines()
    cells = lines[4].split(",")
    cells[1] = "-5"
    (tmp_path / "flight.csv").write_text("\n".join([*lines[:4], ",".join(cells), *lines[5:]]) + "\n")
    assert "omega1: is empty, with no earlier value" in refusal(tmp_path / "flight.csv")
