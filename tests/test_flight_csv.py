"""Flights as CSV: what a file may look like and what not, every bit back, whole files or none."""

import dataclasses
import inspect
import os
import stat

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flight_csvs import HEADER, ROWS, csv, edited, read_flight_and_notes
from helpers import CRAZYFLIE, same
from hypothesis import example, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

import jaxos4.logs.csv as csv_module
import jaxos4.logs.table as table_module
from jaxos4.airframe import OS4
from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES, Flight
from jaxos4.logs import read_flight, write_flight


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
def test_plain_lines_are_read_together_up_to_the_first_that_is_not(row, cell, words, save, monkeypatch):
    """The numbers and the refusals are those of a file that is read row by row."""
    path, found = save(edited(row, "q", cell)), []
    for lines in (1, 2, 100):
        monkeypatch.setattr(csv_module, "LINES_AT_ONCE", lines)
        if words:
            with pytest.raises(InputError, match=words):
                csv_module.read_table(path, csv_module.COLUMNS)
        else:
            table = csv_module.read_table(path, csv_module.COLUMNS)
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


# Writing


FLIGHT = Flight(np.arange(3.0), np.ones((3, 4)), np.zeros((3, 12)))
LIMITS = {"phi": 1.5, "theta": 1.5, "psi": 1.5, "p": 60, "q": 60, "r": 60, "vx": 1e3, "vy": 1e3, "vz": 1e3}


def masked(draw, shape, limits):
    values = draw(hnp.arrays(float, shape, elements=st.floats(-1, 1, width=64))) * limits
    return np.where(draw(hnp.arrays(bool, shape)), np.nan, values)


@st.composite
def flights(draw):
    n = draw(st.integers(2, 12))
    time = draw(st.floats(-1e4, 1e4)) + draw(st.floats(1e-3, 0.02)) * np.arange(n)
    # A rotor turns, or stands still: a single 0 counts as not measured.
    omega = draw(hnp.arrays(float, (n, 4), elements=st.floats(0, 1e5, exclude_min=True)))
    omega *= draw(hnp.arrays(bool, 4))
    states = masked(draw, (n, 12), [LIMITS.get(name, 1e6) for name in STATE_NAMES])
    states[draw(st.integers(0, n - 1)), draw(st.integers(0, 11))] = 0.1
    force = masked(draw, (n, 3), 1e3) if draw(st.booleans()) else None
    force = None if force is None or np.isnan(force).all() else jnp.asarray(force)
    voltage = draw(hnp.arrays(float, n, elements=st.floats(1e-3, 200))) if draw(st.booleans()) else None
    return Flight(time, omega, states, force, voltage=voltage)


# Round trip


@given(flight=flights())
@example(flight=Flight(np.arange(2) / 64, np.zeros((2, 4)), np.full((2, 12), -0.0)))
@settings(max_examples=150)
def test_reading_gives_back_every_bit(flight, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "flight.csv"
    write_flight(flight, path)
    again, notes = read_flight_and_notes(path)
    for one, other in zip(jax.tree.leaves(flight), jax.tree.leaves(again), strict=True):
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()
    assert all("in g" in note for note in notes)  # small forces may be in other units


def test_only_what_was_measured_gets_a_column(tmp_path):
    states = np.full((3, 12), np.nan)
    states[1, STATE_NAMES.index("p")] = 0.25
    flight = Flight(np.arange(3) * 0.5, np.full((3, 4), 7.0), states, jnp.asarray([[np.nan, 1e-300, np.nan]] * 3))
    write_flight(flight, tmp_path / "f.csv")
    rows = [f"{t},7.0,7.0,7.0,7.0,{p},1e-300" for t, p in (("0.0", ""), ("0.5", "0.25"), ("1.0", ""))]
    text = (tmp_path / "f.csv").read_bytes().decode()
    assert text == "\n".join(["t,omega1,omega2,omega3,omega4,p,ay", *rows, ""])


def test_commands_are_written_as_shares_of_the_largest_speed(tmp_path):
    flight = Flight(np.arange(3.0), np.full((3, 4), 250.0), np.zeros((3, 12)), commanded=True)
    airframe = eqx.tree_at(lambda a: a.max_rotor_speed, OS4, np.asarray(500.0))
    write_flight(flight, tmp_path / "f.csv", airframe)
    assert (tmp_path / "f.csv").read_text().startswith("t,command1,command2,command3,command4,")
    again = read_flight(tmp_path / "f.csv", airframe)
    assert again.commanded
    assert same(flight, again)
    # Without the largest speed they cannot be written as commands.
    for unknown in (None, OS4):
        write_flight(flight, tmp_path / "g.csv", unknown)
        assert not read_flight(tmp_path / "g.csv").commanded


def test_single_precision_gives_back_its_bits_and_moves_a_late_start(save):
    with jax.enable_x64(False):
        flight = Flight(0.1 * np.arange(9), np.full((9, 4), 1 / 3), np.full((9, 12), 0.1))
        path = save("")
        write_flight(flight, path)
        again = read_flight(path)
        assert again.states.dtype == jnp.float32
        assert same(dataclasses.replace(flight, held=False), again)  # measured speeds of a file are those at its times
        late = csv(rows=[f"{1.7e9 + 0.01 * k:.2f},1,1,1,1,0,0,0" for k in range(500)])
        with pytest.warns(UserWarning, match="starts at 1700000000 s"):
            moved = read_flight(save(late))
        assert moved.time[0] == 0
        assert moved.dt == pytest.approx(0.01, rel=1e-6)
    assert read_flight(save(late)).time[0] == 1.7e9


@pytest.mark.parametrize(
    ("field", "at", "words"),
    [
        ("states", (1, 0), "sample 1, column x: is inf"),
        ("omega", (1, 0), "sample 1, column omega1: is inf"),
        ("time", (1,), "sample 1, column t: is inf"),
        ("batch", (), r"one file holds one flight, got a batch of shape \(2,\)"),
    ],
)
def test_what_a_file_cannot_hold_is_not_written(field, at, words, tmp_path):
    flight = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), FLIGHT)
    if at:
        infinite = jnp.asarray(getattr(FLIGHT, field)).at[at].set(np.inf)
        flight = dataclasses.replace(FLIGHT, **{field: infinite})
    with pytest.raises(InputError, match=words):
        write_flight(flight, tmp_path / "f.csv")
    assert list(tmp_path.iterdir()) == []


# Whole files or none


def interrupt(descriptor):
    raise KeyboardInterrupt


def test_a_file_is_replaced_as_a_whole_or_not_at_all_behind_a_link_and_keeps_its_mode(tmp_path, monkeypatch):
    path, link = tmp_path / "old.csv", tmp_path / "link.csv"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_flight(FLIGHT, link)
    assert same(read_flight(path).states, FLIGHT.states)
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_flight(dataclasses.replace(FLIGHT, omega=2 * FLIGHT.omega), path)
    assert path.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == [link, path]
    with pytest.raises(FileNotFoundError, match=r"no such folder to write to.*nowhere/f\.csv"):
        write_flight(FLIGHT, tmp_path / "nowhere" / "f.csv")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        write_flight(FLIGHT, tmp_path)


def test_a_device_and_a_pipe_are_written_in_place():
    write_flight(FLIGHT, os.devnull)
    assert not os.path.isfile(os.devnull)
    reader, writer = os.pipe()
    write_flight(FLIGHT, f"/dev/fd/{writer}")
    os.close(writer)
    with open(reader) as file:
        assert file.readline().startswith("t,omega1,")
