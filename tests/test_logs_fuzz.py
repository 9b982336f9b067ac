"""The law of all log formats: a file gives a usable flight or an `InputError` of one line, whatever it contains."""

import math

import numpy as np
import pytest
import test_logs_blackbox as blackbox
import test_logs_crazyflie as crazyflie
import test_logs_ulog as ulog
from helpers import same
from hypothesis import example, given, settings, strategies as st
from recorded_logs import damaged, outcome
from test_flight_csv import CRAZYFLIE, csv, read_flight_and_notes

import jaxos4.logs.csv as csv_module
from jaxos4.flight import Flight
from jaxos4.logs import FORMATS, log_format, read_log
from jaxos4.logs.csv import COLUMN_NAMES

NAMES = ("t", "omega1", "omega2", "omega3", "omega4", "p", "q", "r", "phi", "theta", "psi", "x", "az")
JUNK = st.one_of(
    st.sampled_from(
        """- , ; " "" "1 -- --1 + e . 1e 1_0 0x1 nan NaN inf -inf true None 1e999 -1e999 1e-999 1e308 -0 -1 0.05 1e11
        1e-9 6.3 -7 59 61 1e5 1e6""".split()
        + ["", " ", "1 2", "\0", "\x1c1", "\r", "\n", "\t1", "\u2028", "\x85", "\ufeff", "x" * 60, "١", "½", "é"]
    ),
    st.floats().map(repr),
    st.integers().map(str),
    st.text(max_size=6),
)

# Each format: a good log, the bytes at its beginning that are its header, and bad logs with words of their messages.
SUBJECTS = {
    "ULog": (ulog.SMALL, 16, ulog.BAD),
    "Crazyflie": (crazyflie.SMALL, 60, crazyflie.BAD),
    "blackbox": (blackbox.SMALL, 400, blackbox.BAD),
    "CSV": (csv().encode(), 38, {}),
}
BAD = {(name, case): bad[case] for name, (_, _, bad) in SUBJECTS.items() for case in bad}
ACCIDENTS = st.lists(
    st.tuples(
        st.sampled_from(["cut", "flip", "flip", "insert", "drop", "zeros"]), st.floats(0, 1), st.integers(0, 999)
    ),
    max_size=4,
)


def read(path):
    return read_log(path, CRAZYFLIE)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "flight.log"


def test_every_format_is_a_subject():
    assert list(SUBJECTS) == [each.name for each in FORMATS]


@pytest.mark.parametrize(("name", "case"), BAD)
def test_a_bad_log_is_refused_in_one_line(name, case, save):
    content, words = BAD[name, case]
    message = outcome(read, save(content))
    assert isinstance(message, str)
    assert words in message


@pytest.mark.parametrize("name", SUBJECTS)
def test_a_damaged_log(name, path):
    content = SUBJECTS[name][0]
    path.write_bytes(content)
    assert log_format(path).name == name
    assert isinstance(outcome(read, path), Flight)

    @given(accidents=ACCIDENTS)
    @settings(max_examples=150)
    def law(accidents):
        path.write_bytes(damaged(content, accidents))
        outcome(read, path)

    law()


@pytest.mark.parametrize("name", SUBJECTS)
def test_any_bytes_after_a_part_of_the_header(name, path):
    content, header, _ = SUBJECTS[name]

    @given(junk=st.binary(max_size=400), keep=st.integers(1, header))
    @settings(max_examples=80)
    def law(junk, keep):
        path.write_bytes(content[:keep] + junk)
        assert isinstance(outcome(read, path), str)  # no flight is found by chance

    law()


@given(
    lines=st.lists(
        st.sampled_from(
            [*blackbox.LINES[:4], '"acc_1G","x"', '"motor_poles","0"', '"a,b', "gyroADC[0],1,2,3", "", "\0", "1,2"]
        ),
        max_size=8,
    )
)
@settings(max_examples=80)
def test_lines_of_a_blackbox_log_in_any_order(lines, path):
    path.write_text("\n".join([blackbox.LINES[0], *lines] if len(lines) % 2 else lines))
    outcome(read, path)


# The flight CSV


def read_csv(path):
    return read_flight_and_notes(path, CRAZYFLIE)


@given(content=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(lambda s: s.encode("utf-8", "replace"))))
@settings(max_examples=150)
@example(content=b"\xff\xfet\0,\0")
@example(content=b"t\n" * 3)
@example(content=b"\xef\xbb\xbf")
@example(content=b"\r\r\n\r")
def test_arbitrary_bytes(content, path):
    path.write_bytes(content)
    assert isinstance(outcome(read_csv, path), str)  # no flight is found by chance


@given(
    header=st.lists(st.sampled_from((*COLUMN_NAMES, "T", "P", "mode", "")), max_size=12),
    rows=st.lists(st.lists(JUNK, max_size=12), max_size=6),
)
@settings(max_examples=200)
def test_tables_of_junk(header, rows, path):
    text = "\n".join(",".join(row) for row in [header, *rows])
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    outcome(read_csv, path)


def good(rows, dt, start, wide):
    """The cells of a good flight."""
    names = NAMES if wide else NAMES[:7]
    lines: list[list[str]] = [list(names)]
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
    whole = outcome(read_csv, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_module, "_BLOCK", block)
        parts = outcome(read_csv, path)
    if isinstance(whole, str):
        assert isinstance(parts, str)  # of two faults, another may be found first
    else:
        assert same(whole, parts)


@given(keep=st.lists(st.booleans(), min_size=25, max_size=25).filter(lambda k: sum(k) > 2), seed=st.integers(0, 9))
@settings(max_examples=100)
def test_dropped_rows_never_refuse_a_flight(keep, seed, path):
    jitter = 0.002 * np.random.default_rng(seed).uniform(-1, 1, 25)
    lines = good(25, 0.01, 0.0, True)
    for line, offset in zip(lines[1:], jitter.tolist(), strict=True):
        line[0] = repr(float(line[0]) + offset)
    kept = [lines[0]] + [line for line, k in zip(lines[1:], keep, strict=True) if k]
    path.write_text("\n".join(",".join(line) for line in kept))
    flight = outcome(read_csv, path)
    assert isinstance(flight, Flight)


def naive(path):
    """A reader without checks."""
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
    outcome(read_csv, path)
