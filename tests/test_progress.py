"""Progress: what is computed, and how far, also where no terminal shows it."""

import contextlib
import re
import time

import pytest

from jaxos4.cli import estimate
from jaxos4.cli._shared import showing_stages


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr("jaxos4.cli._shared.PERIOD", 0.02)


def test_a_redirected_wait_tells_from_time_to_time_what_and_how_far(often, capsys):
    with showing_stages("compiling", 40) as progress:
        time.sleep(0.1)
        progress("cells of IBSS", 3)
        time.sleep(0.1)
    out, err = capsys.readouterr()
    assert out == ""
    assert "jaxos4: compiling, 0 s\n" in err
    assert err.endswith("jaxos4: cells of IBSS (3 of 40), 0 s\n")
    assert all(re.fullmatch(r"jaxos4: .+, \d+ s", line) for line in err.splitlines())
    time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_a_short_wait_is_silent(capsys):
    with showing_stages("reading"):
        pass
    assert capsys.readouterr() == ("", "")


def test_no_stderr_is_no_fault(often, monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    with showing_stages("reading"):
        time.sleep(0.1)


def test_a_command_shows_its_stages_in_a_file(run, often, tmp_path):
    code, out, err = run(
        "simulate", "--closed-loop", "--airframe", "crazyflie", "--duration", "2", "--out", "flight.csv"
    )
    assert code == 0
    assert "jaxos4" not in out
    assert "jaxos4: compiling and simulating, " in err


def test_logs_are_counted_while_they_are_read(run, monkeypatch):
    told = []
    monkeypatch.setattr(estimate, "showing_stages", lambda first: contextlib.nullcontext(told.append))
    code, _, err = run("simulate", "--duration", "2", "--out", "a.csv")
    assert code == 0, err
    code, _, err = run("estimate", "a.csv", "b.csv", "c.csv")
    assert (code, err) == (2, "jaxos4: b.csv: there is no such file; give the path of an existing file.\n")
    assert told == ["reading a.csv (1 of 3)", "reading b.csv (2 of 3)"]
