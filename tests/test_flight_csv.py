"""Flights to CSV and back; what a log may look like, what it may not, and what is done to an uneven one."""

import inspect
import os
import stat

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE, same
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

import jaxos4.logs.assemble as assemble_module
import jaxos4.logs.csv as csv_module
import jaxos4.logs.table as table_module
from jaxos4._files import write_atomically
from jaxos4.airframe import OS4
from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES, Flight
from jaxos4.logs import read_flight, read_recording, write_flight
from jaxos4.logs.sampling import resample, unwrap

HEADER = "t,omega1,omega2,omega3,omega4,p,q,psi"
ROWS = [f"{0.01 * k:.2f},100,101,102,103,{0.1 * k:.1f},-0.2,0.3" for k in range(6)]
LIMITS = {"phi": 1.5, "theta": 1.5, "psi": 1.5, "p": 60, "q": 60, "r": 60, "vx": 1e3, "vy": 1e3, "vz": 1e3}


def read_flight_and_notes(path, airframe=None):
    found = read_recording(path, airframe)
    return found.flight, found.notes


def csv(header=HEADER, rows=ROWS):
    return "\n".join([header, *rows]) + "\n"


def edited(row, column, cell, header=HEADER):
    """A good file with one cell replaced; rows are counted as in messages."""
    cells = [line.split(",") for line in ROWS]
    cells[row - 2][header.split(",").index(column)] = cell
    return csv(header, [",".join(line) for line in cells])


def refusal(path, airframe=None):
    """The message, which is one line that begins with the file."""
    with pytest.raises(InputError) as caught:
        read_flight(path, airframe)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"{path}: ")
    assert message.endswith(".")
    return message.removeprefix(f"{path}: ")


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
    text = (tmp_path / "f.csv").read_bytes().decode()
    row = ",7.0,7.0,7.0,7.0,{},1e-300"
    assert "\r" not in text
    assert text.splitlines() == [
        "t,omega1,omega2,omega3,omega4,p,ay",
        "0.0" + row.format(""),
        "0.5" + row.format("0.25"),
        "1.0" + row.format(""),
    ]


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
        assert same(flight, again)
        late = csv(rows=[f"{1.7e9 + 0.01 * k:.2f},1,1,1,1,0,0,0" for k in range(500)])
        with pytest.warns(UserWarning, match="starts at 1700000000 s"):
            moved = read_flight(save(late))
        assert moved.time[0] == 0
        assert moved.dt == pytest.approx(0.01, rel=1e-6)
    assert read_flight(save(late)).time[0] == 1.7e9


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("states", np.inf, "sample 1, column x: is inf"),
        ("omega", np.nan, "sample 1, column omega1: is nan"),
        ("time", np.nan, "sample 1, column t: is nan"),
        ("batch", 2, r"one file holds one flight, got a batch of shape \(2,\)"),
    ],
)
def test_what_a_file_cannot_hold_is_not_written(field, value, words, tmp_path):
    flight = Flight(np.arange(3.0), np.ones((3, 4)), np.zeros((3, 12)))
    if field == "batch":
        flight = jax.tree.map(lambda leaf: jnp.stack([leaf] * value), flight)
    else:
        array = getattr(flight, field)
        flight = eqx.tree_at(lambda f: getattr(f, field), flight, array.at[(1,) + (0,) * (array.ndim - 1)].set(value))
    with pytest.raises(InputError, match=words):
        write_flight(flight, tmp_path / "f.csv")
    assert list(tmp_path.iterdir()) == []


# Whole files or none


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "old.csv"
    path.write_text("old")

    def interrupted():
        with write_atomically(path) as beside:
            beside.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_replaces_the_file_behind_a_link_and_keeps_its_mode(tmp_path):
    path, link = tmp_path / "old.csv", tmp_path / "link.csv"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    with write_atomically(link) as beside:
        assert beside.parent == tmp_path
        assert beside.suffix == ".csv"
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


# What a file may look like


@pytest.mark.parametrize(
    "content",
    [
        csv().replace("\n", "\r\n"),
        csv().replace("\n", "\r"),
        "\ufeff" + csv(),
        csv().rstrip("\n"),
        csv() + "\n  \n\n",
        csv().replace(",", " ,\t"),
        "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in csv().split()),
        csv().replace(",-0.2,", ",-2.0E-01,").replace(",100,", ",+100.,"),
        "\n".join(",".join(line.split(",")[i] for i in (7, 3, 1, 0, 2, 5, 6, 4)) for line in csv().split()),
    ],
    ids=["crlf", "cr", "bom", "no-end", "blank-end", "padded", "quoted", "forms", "shuffled"],
)
def test_what_does_not_matter(content, save):
    assert same(read_flight(save(content)), read_flight(save(csv())))


def test_voltage_is_interpolated_over_what_was_not_measured(save):
    def voltage(cells, rows=ROWS):
        lines = [f"{row},{cell}" for row, cell in zip(rows, cells, strict=True)]
        return read_flight_and_notes(save(csv(HEADER + ",voltage", lines)))[0].voltage

    found = voltage(["", "12.0", "", "0", "11.7", ""])
    assert found is not None
    np.testing.assert_allclose(found, [12.0, 12.0, 11.9, 11.8, 11.7, 11.7], rtol=1e-12)
    uneven = [row.replace("0.03,", "0.034,", 1) for row in ROWS]
    found = voltage(["12.0", "", "", "", "", "11.5"], uneven)
    assert found is not None
    np.testing.assert_allclose(found, np.linspace(12.0, 11.5, 6), rtol=1e-12)
    assert voltage([""] * 6) is None
    assert voltage(["0", "", "-1", "0", "0", "0"]) is None
    assert read_flight(save(csv())).voltage is None


def test_commands_are_fractions_of_full_scale(save):
    text = csv(HEADER.replace("omega", "command"), [row.replace(",10", ",0.10") for row in ROWS])
    flight, notes = read_flight_and_notes(save(text), CRAZYFLIE)
    np.testing.assert_allclose(flight.omega[0], 2500 * np.array([0.100, 0.101, 0.102, 0.103]), rtol=1e-15)
    for airframe in (None, OS4):
        assert "set max_rotor_speed [rad/s] in the airframe's TOML file" in refusal(save(text), airframe)


# Notes


HELD = edited(4, "omega2", "").replace("0.03,100,101", "0.03,100,")
NOTES = {
    "measured omega1..omega4 are used; command1, command2 are ignored": csv(
        HEADER + ",command1,command2", [row + ",0.5,0.5" for row in ROWS]
    ),
    "omega2: 2 empty cells hold the value before them, for up to 0.02 s": HELD,
    "unknown columns are ignored: 'P' (did you mean p?), 'roll' (did you mean phi?), 'mode', "
    "'Omega_1' (did you mean omega1?), 'mode', ''": csv(
        HEADER + ",P,roll,mode,Omega_1,mode,", [row + ',1,2,"a, b",4,é_1,' for row in ROWS]
    ),
}


@pytest.mark.parametrize("note", NOTES)
def test_what_the_reader_assumes_is_noted_and_the_rest_is_read(note, save):
    flight, notes = read_flight_and_notes(save(NOTES[note]))
    assert notes == (note,)
    assert same(flight, read_flight(save(csv())))


def test_warnings_point_at_the_caller(save):
    path = save(csv(HEADER + ",mode", [row + ",1" for row in ROWS]))
    with pytest.warns(UserWarning, match="unknown columns") as caught:
        inspect.unwrap(read_flight)(path)  # without the tests' own layer of shape checks
    assert caught[0].filename == __file__
    assert str(caught[0].message).startswith(f"{path}: ")


def test_units_that_may_be_wrong_are_noted(save):
    header, tail = HEADER + ",ax,ay,az", ",0.1,0,1"
    notes = read_flight_and_notes(save(csv(header, [row + tail for row in ROWS])))[1]
    assert len(notes) == 1
    assert "if they are in g, multiply by 9.80665" in notes[0]
    hover = float(OS4.hover_speed)
    for factor, words in ((1, None), (9.549, "rpm, divide by 9.549"), (1 / 6.283, "rev/s, multiply by 6.283")):
        rows = [row.replace("100,101,102,103", ",".join([str(hover * factor)] * 4)) for row in ROWS]
        notes = read_flight_and_notes(save(csv(rows=rows)), OS4)[1]
        assert (words is None and notes == ()) or (len(notes) == 1 and words is not None and words in notes[0])


# What a file may not be

BAD = {
    "empty": ("", ["is empty"]),
    "blank": ("\n\n", ["row 1", "is empty", "header"]),
    "header only": (csv(rows=[]), ["has a header and no data"]),
    "one row": (csv(rows=ROWS[:1]), ["has a header and one row of data"]),
    "no header": (csv(header=ROWS[0]), ["row 1", "contains numbers instead of the header"]),
    "semicolons": (csv().replace(",", ";"), ["row 1", "separated by ';'", "commas"]),
    "tabs": (csv().replace(",", "\t"), ["row 1", "separated by tabs", "commas"]),
    "no t": (csv(HEADER.replace("t,", "time,")), ["column t", "should 'time' be t?"]),
    "empty t": (csv(rows=["," + row.split(",", 1)[1] for row in ROWS]), ["column t", "no time"]),
    "empty cell of t": (edited(4, "t", ""), ["row 4, column t", "is empty"]),
    "no rotors": (csv(HEADER.replace("omega", "w")), ["column omega1", "command1..4"]),
    "three rotors": (csv(HEADER.replace("omega3", "Omega3")), ["column omega3", "should 'Omega3' be omega3?"]),
    "three commands": (
        csv("t,command1,command2,w,command4,p,q,psi", [row.replace(",10", ",0.10") for row in ROWS]),
        ["column command3"],
    ),
    "all-empty rotor": (csv(rows=[row.replace(",102,", ",,") for row in ROWS]), ["column omega3"]),
    "rotor without a first value": (edited(2, "omega2", ""), ["row 2, column omega2", "no earlier value to hold"]),
    "no state": (csv("t,omega1,omega2,omega3,omega4,P,b,c"), ["no state was measured", "'P' be p"]),
    "nothing in the states": (csv(rows=[row.rsplit(",", 3)[0] + ",,," for row in ROWS]), ["no state was measured"]),
    "twice the same": (csv(HEADER.replace("q", " p ")), ["row 1, column p", "occurs 2 times"]),
    "a cell short": (csv(rows=[*ROWS[:2], ROWS[2].rsplit(",", 1)[0], *ROWS[3:]]), ["row 4", "7 cells", "header has 8"]),
    "a cell long": (csv(rows=[*ROWS[:2], ROWS[2] + ",0", *ROWS[3:]]), ["row 4", "9 cells", "the header has 8"]),
    "a cut line": (csv(rows=[*ROWS, "0.0"]), ["row 8", "has 1 cell,"]),
    "a blank row": (csv(rows=[*ROWS[:2], "", *ROWS[2:]]), ["row 4", "is blank"]),
    "an open quote": (csv(rows=[*ROWS[:2], ROWS[2].replace(",-0.2", ',"-0.2'), *ROWS[3:]]), ["row 4", "7 cells"]),
    "text": (edited(3, "q", "fast"), ["row 3, column q", "'fast'", "not a number"]),
    "decimal comma": (edited(3, "q", '"0,5"'), ["row 3, column q", "'0,5'", "not a number"]),
    "underscore": (edited(3, "q", "1_0"), ["row 3, column q", "not a number"]),
    "other digits": (edited(3, "q", "\u0661"), ["row 3, column q", "not a number"]),
    "hexadecimal": (edited(3, "q", "0x1"), ["row 3, column q", "not a number"]),
    "nan": (edited(3, "q", "nan"), ["row 3, column q", "'nan'", "leave the cell empty"]),
    "NaN in t": (edited(3, "t", "NaN"), ["row 3, column t", "'NaN'"]),
    "infinity": (edited(3, "omega1", "-Inf"), ["row 3, column omega1", "leave the cell empty"]),
    "N/A": (edited(3, "q", "N/A"), ["row 3, column q", "leave the cell empty"]),
    "overflow": (edited(3, "q", "1e999"), ["row 3, column q", "too large for a number", "leave the cell empty"]),
    "time back": (edited(4, "t", "0.001"), ["row 4, column t", "backward, from 0.01 s to 0.001 s"]),
    "time again": (edited(4, "t", "0.01"), ["row 4, column t", "repeats 0.01 s of row 3"]),
    "milliseconds": (csv(rows=[f"{5 * k},1,1,1,1,0,0,0" for k in range(5)]), ["column t", "divide"]),
    "nanoseconds": (edited(4, "t", "1.7e18"), ["row 4, column t", "in seconds"]),
    "gigahertz": (csv(rows=[f"{k}e-9,1,1,1,1,0,0,0" for k in range(5)]), ["column t", "microsecond"]),
    "a long gap": (
        csv(rows=[f"{k}e-6,1,1,1,1,0,0,0" for k in range(5)] + ["1e6,1,1,1,1,0,0,0"]),
        ["row 7, column t", "a gap of 1e+06 s", "1e+12 samples", "cut the file there"],
    ),
    "negative speed": (edited(5, "omega2", "-3"), ["row 5, column omega2", "drop the sign"]),
    "absurd speed": (edited(5, "omega2", "2e5"), ["row 5, column omega2", "rad/s", "rpm"]),
    "command in percent": (csv(HEADER.replace("omega", "command")), ["row 2, column command1", "full scale"]),
    "fast rate": (edited(5, "p", "-61"), ["row 5, column p", "looks like deg/s", "57.3"]),
    "psi far": (edited(5, "psi", "2e4"), ["row 5, column psi", "looks like degrees"]),
    "psi wrapped at 180": (edited(5, "psi", "-359.8"), ["row 5, column psi", "looks like degrees"]),
    "phi": (edited(5, "q", "7", HEADER).replace("q", "phi"), ["row 5, column phi", "looks like degrees"]),
    "theta": (edited(5, "q", "-1.6").replace("q", "theta"), ["row 5, column theta", "degrees", "pi/2"]),
    "position": (edited(5, "q", "1e7").replace("q", "x"), ["row 5, column x", "metres"]),
    "velocity": (edited(5, "q", "1001").replace("q", "vx"), ["row 5, column vx", "m/s"]),
    "force": (edited(5, "q", "1001").replace("q", "ax"), ["row 5, column ax", "m/s^2"]),
    "millivolts": (edited(5, "q", "11100").replace("q", "voltage"), ["row 5, column voltage", "mV, divide by 1000"]),
    "nul": (edited(3, "q", "\0"), ["row 3, column q", "not text in UTF-8"]),
    "latin-1": (edited(3, "q", "é").encode("latin-1"), ["row 3, column q", "not text in UTF-8"]),
    "utf-16": (csv().encode("utf-16"), ["row 1", "not text in UTF-8"]),
    "binary": (bytes(range(256)) * 4, ["row 1", "not text in UTF-8"]),
    "endless header": (b"t" * (1 << 21), ["row 1", "longer than a million"]),
    "endless row": ((csv() + "1" * (1 << 22)), ["row 8", "longer than a million"]),
    "endless cell": (edited(3, "q", '"' + "1" * 200_000 + '"'), ["row 3", "too long"]),
    "long cell": (edited(3, "q", "x" * 1000), ["row 3, column q", "x...'"]),
}


def test_paths_that_are_no_readable_file(tmp_path, monkeypatch):
    assert "no such file" in refusal(tmp_path / "none.csv")
    assert "is a folder" in refusal(tmp_path)
    assert "no such file" in refusal(tmp_path / "none" / "none.csv")
    with pytest.raises(InputError, match=r"a\\nb: there is no such file"):
        read_flight("a\nb")
    with pytest.raises(InputError, match="null character"):
        read_flight("a\0b")
    with pytest.raises(InputError, match="cannot be read"):
        read_flight("a" * 5000)
    with pytest.raises(InputError, match="cannot be read"):
        read_flight("\ud800")

    def forbidden(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(table_module, "open", forbidden, raising=False)
    assert "permission denied" in refusal(tmp_path / "f.csv")


def test_too_many_rows_are_refused(save, monkeypatch):
    monkeypatch.setattr(csv_module, "MAX_ROWS", 5)
    assert "more than 5 rows" in refusal(save(csv()))


# Angles against rates


def columns(names, t, *values):
    """A file of some columns, with rotors that turn at 9 rad/s."""
    rows = [",".join(map(repr, [row[0], 9, 9, 9, 9, *row[1:]])) for row in np.column_stack([t, *values]).tolist()]
    return csv(",".join(["t,omega1,omega2,omega3,omega4", *names]), rows)


def spin(scale_angle=1.0, scale_rate=1.0, rate=3.0, noise=0.0, names=("phi", "p")):
    """A file of five seconds of one angle and its rate, in units of choice."""
    rng = np.random.default_rng(0)
    t = np.arange(500) * 0.01
    angle = 0.4 * np.sin(rate * t) + noise * 0.005 * rng.normal(size=500)
    speed = 0.4 * rate * np.cos(rate * t) + noise * 0.01 * rng.normal(size=500)
    return columns(names, t, scale_angle * angle, scale_rate * speed)


@pytest.mark.parametrize("names", [("phi", "p"), ("theta", "q"), ("psi", "r")])
def test_an_angle_at_odds_with_its_rate_is_refused(names, save):
    degrees = 180 / np.pi
    assert read_flight_and_notes(save(spin(names=names, noise=1)))[1] == ()
    message = refusal(save(spin(degrees, names=names, noise=1)))
    assert message.startswith(f"column {names[0]}: ")
    assert "degrees" in message
    message = refusal(save(spin(scale_rate=degrees, rate=2.0, names=names, noise=1)))
    assert message.startswith(f"column {names[1]}: ")
    assert "deg/s" in message
    for scale in ((20.0, 1.0), (1.0, 15.0), (1.5, -1.0)) if names[0] == "psi" else ():  # other disagreements
        read_flight(save(spin(*scale, rate=2.0, names=names)))


def test_noise_alone_is_no_degrees(save):
    """Hovering: over 0.2 s, noise in the angle is some 57 times the integral of noise in the rate, by chance."""
    rng = np.random.default_rng(1)
    angle, rate = 0.005 * rng.normal(size=500), 2.8e-3 * rng.normal(size=500)
    path = save(columns(("psi", "r"), 0.01 * np.arange(500), angle, rate))
    assert read_flight_and_notes(path)[1] == ()
    with pytest.MonkeyPatch.context() as patch:  # without the check that the two are similar
        patch.setattr(assemble_module, "_SIMILARITY", -1.0)
        assert "looks like degrees" in refusal(path)


def test_a_flip_is_no_degree(save):
    """Three turns of roll are 19 rad, as the roll rate says; without it they are refused."""
    t = np.arange(200) * 0.01
    flight = read_flight(save(columns(("phi", "p"), t, 10 * t, 10.0 + 0 * t)))
    assert flight.states[-1, STATE_NAMES.index("phi")] == 10 * t[-1]
    message = refusal(save(columns(("phi", "q"), t, 10 * t, 10.0 + 0 * t)))
    assert message.startswith("row 65, column phi: is 6.3 rad")


# Uneven times


def uneven(n, dt, seed=0, jitter=0.2):
    rng = np.random.default_rng(seed)
    return dt * (np.arange(n) + rng.uniform(-jitter, jitter, n))


def worst(n):
    """Largest error of a sine sampled n times in 2 s at uneven times and brought to a grid."""
    t = uneven(n, 2.0 / n)
    (grid, _, channels), _ = resample(t, np.ones((n, 4)), np.sin(5 * t)[:, None], 2.0 / n)
    assert not np.isnan(channels).any()
    return np.abs(channels[:, 0] - np.sin(5 * grid)).max()


def test_resampling_is_second_order():
    assert 1.8 < np.log2(worst(250) / worst(1000)) / 2 < 2.3
    assert worst(1000) < 25 / 8 * (2 / 1000) ** 2 * 1.4**2


@given(seed=st.integers(0, 999), lost=st.floats(0, 0.6), slow=st.integers(1, 5))
@settings(max_examples=100)
def test_nothing_is_invented_across_gaps(seed, lost, slow):
    rng = np.random.default_rng(seed)
    dt = 0.01
    t = uneven(80, dt, seed)
    t = t[np.sort(rng.choice(80, 60, replace=False))]
    y = np.cumsum(rng.normal(size=60))
    y[rng.random(60) < lost] = np.nan
    y[np.arange(60) % slow != 0] = np.nan
    (grid, _, channels), _ = resample(t, np.ones((60, 4)), y[:, None], dt)
    ts, ys = t[np.isfinite(y)], y[np.isfinite(y)]
    for g, value in zip(grid, channels[:, 0], strict=True):
        if np.isnan(value):
            continue
        right = np.searchsorted(ts, g)
        assert np.abs(ts - g).min() <= 0.75 * dt + 1e-12  # a sample is near
        around = ys[max(right - 1, 0) : right + 1]  # and the value lies between those around it
        assert around.min() - 1e-9 <= value <= around.max() + 1e-9


def test_rows_that_are_missing_from_a_grid_are_not_measured(save):
    rows = [f"{0.01 * k:.2f},{k},0,0,0,{k},0,0" for k in range(20) if k not in (5, 11, 12)]
    flight, notes = read_flight_and_notes(save(csv(rows=rows)))
    p = np.asarray(flight.states)[:, STATE_NAMES.index("p")]
    assert flight.time.shape == (20,)
    assert np.flatnonzero(np.isnan(p)).tolist() == [5, 11, 12]
    np.testing.assert_allclose(p[~np.isnan(p)], np.delete(np.arange(20.0), [5, 11, 12]), atol=1e-9)
    np.testing.assert_allclose(flight.omega[[4, 5, 6, 10, 11, 12, 13], 0], [4, 4, 6, 10, 10, 10, 13], rtol=1e-9)
    assert len(notes) == 1
    assert "17 rows were resampled to 20 samples, one every 10 ms" in notes[0]
    assert "2 gaps of up to 30 ms: the 3 samples in gaps hold the rotor speeds" in notes[0]


@pytest.mark.parametrize("offset", [0.004, 0.009])
def test_rows_near_a_grid_stand_as_recorded_and_time_is_the_grid(offset, save):
    dt = 0.01
    t = dt * np.arange(50)
    t[1:-1] += dt * offset * np.random.default_rng(0).choice([-1, 1], 48)
    flight, notes = read_flight_and_notes(save(columns("p", t, np.sin(99 * t))))
    assert notes == ()
    np.testing.assert_array_equal(np.asarray(flight.states)[:, STATE_NAMES.index("p")], np.sin(99 * t))
    np.testing.assert_allclose(np.diff(flight.time), dt, rtol=1e-12)
    t[7] = dt * 7.02
    assert "resampled" in read_flight_and_notes(save(columns("p", t, np.sin(99 * t))))[1][0]


def test_turns_are_taken_out_before_interpolation(save):
    t = uneven(400, 0.01)
    flight, notes = read_flight_and_notes(save(columns(["psi"], t, (7 * t + np.pi) % (2 * np.pi) - np.pi)))
    np.testing.assert_allclose(flight.states[:, STATE_NAMES.index("psi")], 7 * np.asarray(flight.time), atol=1e-9)
    assert notes[0] == "psi: 4 jumps of 2 pi removed"


@given(turns=hnp.arrays(int, st.integers(2, 30), elements=st.integers(-3, 3)), seed=st.integers(0, 99))
@settings(max_examples=50)
def test_unwrapping_changes_by_whole_turns_and_leaves_the_smooth(turns, seed):
    rng = np.random.default_rng(seed)
    angle = np.cumsum(rng.uniform(-3, 3, turns.size))
    angle[rng.random(turns.size) < 0.2] = np.nan
    jumpy = angle + 2 * np.pi * turns
    out, jumps = unwrap(jumpy)
    steps = np.diff(out[np.isfinite(out)])
    assert (np.abs(steps) <= np.pi + 1e-9).all()
    whole = ((out - jumpy) / (2 * np.pi))[np.isfinite(out)]
    np.testing.assert_allclose(whole, np.rint(whole), atol=1e-9)
    again, none = unwrap(out)
    assert none == 0
    assert again is out


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
    assert len(notes) == 1
    assert f"{rows} rows were resampled to {flight.time.size} samples, one every {step} ms" in notes[0]
    assert (f"{gaps} gaps" in notes[0]) == (gaps > 0)
    time, states = np.asarray(flight.time), np.asarray(flight.states)
    assert abs(time[-1] - raw[-1, 0]) < 2e-3
    for name, column in (("p", 5), ("q", 6), ("r", 7)):
        got = states[:, STATE_NAMES.index(name)]
        assert np.isnan(got).mean() < 1e-3
        kept = ~np.isnan(got)
        np.testing.assert_allclose(got[kept], np.interp(time[kept], raw[:, 0], raw[:, column]), atol=1e-9)
    assert np.isnan(states[:, [STATE_NAMES.index(n) for n in ("x", "vz", "phi", "theta", "psi")]]).all()
    impulse = (np.asarray(flight.omega)[:-1] ** 2).sum(axis=0) * float(flight.dt)
    held = ((2500 * raw[:-1, 1:5]) ** 2 * np.diff(raw[:, 0])[:, None]).sum(axis=0)
    np.testing.assert_allclose(impulse, held, rtol=1e-3)
    # thrust over the flight carries the weight, so the units and the rotor columns are what they are taken for
    assert 0.6 < impulse.sum() * CRAZYFLIE.thrust_coefficient / (time[-1] * 0.027 * 9.81) < 1.6


def test_an_accelerometer_that_never_changes_is_off(save):
    rows = [f"{0.01 * k:.2f},{','.join(['200'] * 4)},0.1,0,0,9.81" for k in range(200)]
    flight, notes = read_flight_and_notes(save(csv("t,omega1,omega2,omega3,omega4,p,ax,ay,az", rows)))
    assert any("is off" in note for note in notes)
    assert flight.specific_force is None or np.isnan(flight.specific_force).all()
    rows[100] = rows[100].replace("9.81", "9.80")
    flight, notes = read_flight_and_notes(save(csv("t,omega1,omega2,omega3,omega4,p,ax,ay,az", rows)))
    assert not any("is off" in note for note in notes)
    assert np.isfinite(flight.specific_force).all()
