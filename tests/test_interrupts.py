"""Ctrl-C and outputs that cannot be written: how a command ends, wherever it is."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest
from helpers import COMMAND, environment, start
from recorded_logs import rates, speeds, table_csv

import jaxos4

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals, and closes outputs as a shell does")
SIMULATE = ("simulate", "--out", "flight.csv")


class Empty:
    """Something that ends at once."""


class Waits(Empty):
    """Something whose end takes long."""

    def __del__(self):
        time.sleep(60)


def in_a_finaliser():
    Waits()
    time.sleep(60)


def in_the_callback_of_a_weak_reference():
    weakref.finalize(Empty(), time.sleep, 1.5)
    time.sleep(60)


def as_another_error():
    try:
        time.sleep(60)
    except BaseException:  # noqa: BLE001
        raise AttributeError from None


def dropped_by_another_library():
    try:
        time.sleep(60)
    except BaseException:  # noqa: BLE001
        return


@pytest.mark.parametrize(
    "wait", [in_a_finaliser, in_the_callback_of_a_weak_reference, as_another_error, dropped_by_another_library]
)
def test_an_interrupt_ends_a_command_wherever_it_arrives(wait, run, monkeypatch, tmp_path):
    ended, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)
    begin = time.monotonic()

    def load(path):
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        wait()

    monkeypatch.setattr(jaxos4, "load_airframe", load)
    monkeypatch.setattr("jaxos4.cli._main.end_by_signal", lambda: ended.append("by the signal"))
    try:
        result = run(*SIMULATE)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (ended, result) == (["by the signal"], (128 + signal.SIGINT, "", ""))
    assert time.monotonic() - begin < 20
    assert list(tmp_path.iterdir()) == []


def test_a_command_that_is_interrupted_ends_by_the_signal(tmp_path):
    waits = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
import jaxos4
def load(path):
    print("here", flush=True)
    time.sleep(60)
jaxos4.load_airframe = load
"""
    line = [sys.executable, "-c", waits + COMMAND, *SIMULATE]
    process = subprocess.Popen(line, env=environment(), cwd=tmp_path, stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "here\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (-signal.SIGINT, "", "")
    assert list(tmp_path.iterdir()) == []


# Outputs that a command cannot use


INSPECT = ("inspect", "log.csv", "--report", "page.html")


@pytest.fixture
def log(tmp_path):
    """A short log, and the page that `INSPECT` makes of it."""
    t = 0.01 * np.arange(400)
    names = ["t", "p", "q", "r", *(f"omega{i}" for i in range(1, 5))]
    (tmp_path / "log.csv").write_bytes(table_csv(names, t, rates(t), speeds(t)))
    return tmp_path / "page.html"


def no_reader():
    """A pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    return open(writer, "w")


FULL = "jaxos4: standard output: No space left on device; print elsewhere. Files that you asked for are written.\n"


@pytest.mark.parametrize(
    ("output", "code", "said"),
    [(lambda: None, 0, ""), (lambda: open("/dev/full", "w"), 2, FULL), (no_reader, 1, "")],
    ids=["closed", "full", "no reader"],
)
def test_files_are_written_if_nothing_can_be_printed(output, code, said, run, log, monkeypatch):
    """A reader that has gone is no error of the program."""
    monkeypatch.setattr(sys, "stdout", output())
    assert run(*INSPECT) == (code, "", said)
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.close()
    assert log.stat().st_size > 10_000


@pytest.mark.slow
def test_a_command_runs_without_any_output(log):
    shell = ["sh", "-c", 'exec "$0" -c "$@" >&- 2>&-', sys.executable, COMMAND, *INSPECT]
    assert subprocess.run(shell, env=environment(), cwd=log.parent, check=False).returncode == 0
    assert log.stat().st_size > 10_000


def test_a_device_that_is_not_there_is_named(tmp_path):
    process = start(*SIMULATE, cwd=tmp_path, JAX_PLATFORMS="nonsense")
    assert process.returncode == 2
    assert process.stderr.startswith("jaxos4: JAX_PLATFORMS=nonsense: JAX finds no such device (")
    assert process.stderr.endswith("unset it, or set it to cpu.\n")
    assert process.stderr.count("\n") == 1
