"""Flights to CSV and back: every bit, only what was measured, whole files or none."""

import dataclasses
import os
import stat

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flight_csvs import csv, read_flight_and_notes
from helpers import same
from hypothesis import example, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from jaxos4._files import write_atomically, write_file
from jaxos4.airframe import OS4
from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES, Flight
from jaxos4.logs import read_flight, write_flight

LIMITS = {"phi": 1.5, "theta": 1.5, "psi": 1.5, "p": 60, "q": 60, "r": 60, "vx": 1e3, "vy": 1e3, "vz": 1e3}


def masked(draw, shape, limits):
    values = draw(hnp.arrays(float, shape, elements=st.floats(-1, 1, width=64))) * limits
    return np.where(draw(hnp.arrays(bool, shape)), np.nan, values)


@st.composite
def flights(draw):
    n = draw(st.integers(2, 12))
    time = draw(st.floats(-1e4, 1e4)) + draw(st.floats(1e-3, 0.02)) * np.arange(n)
    omega = draw(hnp.arrays(float, (n, 4), elements=st.floats(0, 1e5)))
    states = masked(draw, (n, 12), [LIMITS.get(name, 1e6) for name in STATE_NAMES])
    states[draw(st.integers(0, n - 1)), draw(st.integers(0, 11))] = 0.1
    force = masked(draw, (n, 3), 1e3) if draw(st.booleans()) else None
    force = None if force is None or np.isnan(force).all() else jnp.asarray(force)
    voltage = draw(hnp.arrays(float, n, elements=st.floats(1e-3, 200))) if draw(st.booleans()) else None
    return Flight(time, omega, states, force, voltage=voltage)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("flights")


# Round trip


@given(flight=flights())
@example(flight=Flight(np.arange(2) / 64, np.zeros((2, 4)), np.full((2, 12), -0.0)))
@settings(max_examples=150)
def test_reading_gives_back_every_bit(flight, folder):
    path = folder / "flight.csv"
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
    arrays = {"time": np.arange(3.0), "omega": np.ones((3, 4)), "states": np.zeros((3, 12))}
    if at:
        arrays[field][at] = np.inf
    flight = Flight(**arrays)
    if field == "batch":
        flight = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), flight)
    with pytest.raises(InputError, match=words):
        write_flight(flight, tmp_path / "f.csv")
    assert list(tmp_path.iterdir()) == []


# Whole files or none


def test_a_failed_write_keeps_the_old_file_and_a_whole_one_that_behind_a_link_and_its_mode(tmp_path):
    path, link = tmp_path / "old.csv", tmp_path / "link.csv"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)

    def interrupted():
        with write_atomically(path) as beside:
            beside.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    with write_atomically(link) as beside:
        assert (beside.parent, beside.suffix) == (tmp_path, ".csv")
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert sorted(tmp_path.iterdir()) == [link, path]


def test_a_device_is_written_to_and_a_folder_that_is_none_is_named(tmp_path):
    with write_atomically(os.devnull) as beside:
        beside.write_text("nothing")
    assert not os.path.isfile(os.devnull)
    flight = Flight(np.arange(3.0), np.ones((3, 4)), np.zeros((3, 12)))
    with pytest.raises(FileNotFoundError, match=r"no such folder to write to.*nowhere/f\.csv"):
        write_flight(flight, tmp_path / "nowhere" / "f.csv")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        write_flight(flight, tmp_path)


def test_a_pipe_is_written_in_place():
    reader, writer = os.pipe()
    write_file(f"/dev/fd/{writer}", "t,p\n")
    os.close(writer)
    with open(reader) as file:
        assert file.read() == "t,p\n"
