"""Whatever a file holds, reading it gives a usable flight or one line that says why not, and nothing else."""

import math

import equinox as eqx
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

import jaxos4.logs._table as table_module
from jaxos4.airframe import OS4
from jaxos4.errors import InputError
from jaxos4.flight import Flight
from jaxos4.logs import read_flight_and_notes
from jaxos4.logs.csv import COLUMN_NAMES

AIRFRAME = eqx.tree_at(lambda a: a.max_rotor_speed, OS4, np.asarray(400.0))
NAMES = ("t", "omega1", "omega2", "omega3", "omega4", "p", "q", "r", "phi", "theta", "psi", "x", "az")
JUNK = st.one_of(
    st.sampled_from(
        ["", " ", "nan", "NaN", "inf", "-inf", "1e999", "-1e999", "1e-999", "1e308", "-0", "1_0", "0x1", "١", "½", "é"]
        + [
            "true",
            "None",
            ",",
            ";",
            '"',
            '""',
            '"1',
            "1 2",
            "--1",
            "+",
            "e",
            ".",
            "1e",
            "\0",
            "\x1c1",
            "\r",
            "\n",
            "\t1",
        ]
        + ["-1", "0.05", "1e11", "1e-9", "6.3", "-7", "59", "61", "1e5", "1e6", "\u2028", "\x85", "\ufeff", "x" * 60]
    ),
    st.floats().map(repr),
    st.integers().map(str),
    st.text(max_size=6),
)


def outcome(read, path):
    """The flight, or the refusal as a string; an `AssertionError` or what was raised otherwise."""
    try:
        flight, notes = read(path)
    except InputError as error:
        message = str(error)
        assert len(message.splitlines()) == 1
        assert message.startswith(f"{path}: ")
        assert message.isprintable()
        assert len(message) < len(str(path)) + 400
        return message
    time, omega, states = (np.asarray(a) for a in (flight.time, flight.omega, flight.states))
    assert np.isfinite(time).all()
    assert np.isfinite(omega).all()
    assert (omega >= 0).all()
    assert not np.isinf(states).any()
    assert np.isfinite(states).any()
    assert flight.specific_force is None or not np.isinf(np.asarray(flight.specific_force)).any()
    dt = (time[-1] - time[0]) / (time.size - 1)
    assert dt > 0
    assert np.abs(np.diff(time) - dt).max() <= 1e-5 * dt + 4 * np.spacing(np.abs(time).max())
    assert all(note.isprintable() for note in notes)
    return flight


def read(path):
    return read_flight_and_notes(path, AIRFRAME)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "flight.csv"


@given(content=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(lambda s: s.encode("utf-8", "replace"))))
@settings(max_examples=150)
@example(content=b"\xff\xfet\0,\0")
@example(content=b"t\n" * 3)
@example(content=b"\xef\xbb\xbf")
@example(content=b"\r\r\n\r")
def test_arbitrary_bytes(content, path):
    path.write_bytes(content)
    assert isinstance(outcome(read, path), str)  # no flight is found by chance


@given(
    header=st.lists(st.sampled_from((*COLUMN_NAMES, "T", "P", "mode", "")), max_size=12),
    rows=st.lists(st.lists(JUNK, max_size=12), max_size=6),
)
@settings(max_examples=200)
def test_tables_of_junk(header, rows, path):
    text = "\n".join(",".join(row) for row in [header, *rows])
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    outcome(read, path)


def good(rows, dt, start, wide):
    """The cells of a flight that can be read."""
    names = NAMES if wide else NAMES[:7]
    lines = [list(names)]
    for k in range(rows):
        swing = [0.3 * math.sin(0.4 * k + i) for i in range(len(names) - 5)]
        lines.append([repr(start + dt * k), "200.0", "201.5", "199", "2e2", *map(repr, swing)])
    return lines


@st.composite
def mutated(draw):
    """A good flight, changed by a few accidents."""
    lines = good(draw(st.integers(1, 25)), draw(st.sampled_from([0.01, 0.001, 0.3])), 0.0, draw(st.booleans()))
    for _ in range(draw(st.integers(0, 4))):
        row = draw(st.integers(0, len(lines) - 1))
        cell = draw(st.integers(0, max(len(lines[row]) - 1, 0)))
        accident = draw(st.sampled_from(["cell", "cell", "time", "drop", "twice", "column", "swap", "short", "empty"]))
        if accident == "cell" and lines[row]:
            lines[row][cell] = draw(JUNK)
        elif accident == "time" and lines[row]:
            lines[row][0] = repr(draw(st.floats(-1, 1e4)))
        elif accident == "drop" and len(lines) > 1:
            del lines[row]
        elif accident == "twice":
            lines.insert(row, list(lines[row]))
        elif accident == "column":
            lines = [line[:cell] + line[cell + 1 :] for line in lines]
        elif accident == "swap":
            other = draw(st.integers(0, len(lines) - 1))
            lines[row], lines[other] = lines[other], lines[row]
        elif accident == "short":
            lines[row] = lines[row][:cell]
        elif accident == "empty":
            for line in lines[1:]:
                line[cell:] = [""] * len(line[cell:])
    return draw(st.sampled_from(["\n", "\r\n", "\r"])).join(",".join(line) for line in lines)


@given(text=mutated(), block=st.sampled_from([1, 50, 1 << 20]))
@settings(max_examples=400)
def test_good_flights_after_accidents(text, block, path):
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    whole = outcome(read, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table_module, "_BLOCK", block)
        parts = outcome(read, path)
    if isinstance(whole, str):
        assert isinstance(parts, str)  # of two faults, another may be met first where the text is cut for parsing
    else:
        assert eqx.tree_equal(whole, parts) or np.isnan(np.asarray(whole.states)).any()


@given(keep=st.lists(st.booleans(), min_size=25, max_size=25).filter(lambda k: sum(k) > 2), seed=st.integers(0, 9))
@settings(max_examples=100)
def test_dropped_rows_never_refuse_a_flight(keep, seed, path):
    jitter = 0.002 * np.random.default_rng(seed).uniform(-1, 1, 25)
    lines = good(25, 0.01, 0.0, True)
    for line, offset in zip(lines[1:], jitter.tolist(), strict=True):
        line[0] = repr(float(line[0]) + offset)
    kept = [lines[0]] + [line for line, k in zip(lines[1:], keep, strict=True) if k]
    path.write_text("\n".join(",".join(line) for line in kept))
    flight = outcome(read, path)
    assert isinstance(flight, Flight)


def naive(path):
    """What a reader without care does."""
    with open(path, encoding="utf-8") as file:
        file.readline()
        cells = [[float(cell or "nan") for cell in line.split(",")] for line in file]
    array = np.array(cells)
    states = np.full((len(array), 12), np.nan)
    states[:, 7] = array[:, 5]
    return Flight(array[:, 0], array[:, 1:5], states), ()


@pytest.mark.parametrize(
    ("row", "cell", "junk"), [(3, 5, "fast"), (3, 5, "inf"), (3, 0, "7"), (3, 1, ""), (3, 2, "-1")]
)
def test_the_law_fails_a_naive_reader(row, cell, junk, path):
    lines = good(9, 0.01, 0.0, False)
    path.write_text("\n".join(",".join(line) for line in lines))
    assert isinstance(outcome(naive, path), Flight)
    lines[row][cell] = junk
    path.write_text("\n".join(",".join(line) for line in lines))
    with pytest.raises((AssertionError, ValueError)):
        outcome(naive, path)
    outcome(read, path)
