"""Ctrl-C and outputs that cannot be written: how a command ends, wherever it is."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers import COMMAND, ROOT
from recorded_logs import rates, speeds, table_csv

# A command that waits: what happens to the interrupt that arrives there.
DROPPED = {
    "raised": "time.sleep(60)",
    "in a finaliser": "Waits()\ntime.sleep(60)",
    "in the callback of a weak reference": "weakref.finalize(Empty(), time.sleep, 1.5)\ntime.sleep(60)",
    "as another error": "try: time.sleep(60)\nexcept BaseException: raise AttributeError",
    "by another library": "try: time.sleep(60)\nexcept BaseException: pass",
}
WAITING = """
import signal, time, typer, weakref
class Empty: pass
class Waits:
    def __del__(self): time.sleep(60)
def load(path):
    print("here", flush=True)
{}
    raise typer.Exit
signal.signal(signal.SIGINT, signal.default_int_handler)
import jaxos4
jaxos4.load_airframe = load
"""


pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals, and closes outputs as a shell does")


def environment():
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]]), "JAX_PLATFORMS": "cpu"}


@pytest.mark.parametrize(
    "where", [pytest.param(each, marks=[pytest.mark.slow] * (each != "raised")) for each in DROPPED]
)
def test_an_interrupt_ends_a_command_by_the_signal_wherever_it_arrives(where, tmp_path):
    body = "\n".join(f"    {line}" for line in DROPPED[where].splitlines())
    line = [sys.executable, "-c", WAITING.format(body) + COMMAND, "simulate", "--out", "flight.csv"]
    process = subprocess.Popen(line, env=environment(), cwd=tmp_path, stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "here\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (-signal.SIGINT, "", "")
    assert list(tmp_path.iterdir()) == []


# Outputs and folders that a command cannot use


@pytest.fixture
def inspect(tmp_path):
    """Runs `jaxos4 inspect LOG --report page.html` by a shell, with what stands behind it, in an environment."""
    t = 0.01 * np.arange(400)
    names = ["t", "p", "q", "r", *(f"omega{i}" for i in range(1, 5))]
    (tmp_path / "log.csv").write_bytes(table_csv(names, t, rates(t), speeds(t)))

    def call(behind="", **variables):
        line = f'exec "$0" -c "$1" inspect log.csv --report page.html {behind}'
        shell = ["sh", "-c", line, sys.executable, COMMAND]
        done = subprocess.run(
            shell, env=environment() | variables, cwd=tmp_path, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout, done.stderr

    return call


@pytest.mark.parametrize(
    ("behind", "code", "said"),
    [
        pytest.param(">&-", 0, "", marks=pytest.mark.slow),
        pytest.param(">&- 2>&-", 0, "", marks=pytest.mark.slow),
        (">/dev/full", 2, "jaxos4: standard output: No space left on device; print elsewhere. Files"),
    ],
)
def test_files_are_written_if_nothing_can_be_printed(behind, code, said, inspect, tmp_path):
    found, out, err = inspect(behind)
    assert (found, out) == (code, "")
    assert err.startswith(said)
    assert err.count("\n") == (said != "")
    assert (tmp_path / "page.html").stat().st_size > 10_000


def test_a_device_that_is_not_there_is_named(inspect):
    code, _, err = inspect(JAX_PLATFORMS="nonsense")
    assert code == 2
    assert err.startswith("jaxos4: JAX_PLATFORMS=nonsense: JAX finds no such device (")
    assert err.endswith("unset it, or set it to cpu.\n")
    assert err.count("\n") == 1


@pytest.mark.slow
def test_programs_are_kept_only_where_nobody_else_can_write(inspect, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    folder = tmp_path / "cache/jaxos4"
    (folder / "compiled").mkdir(parents=True)
    home = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    for open_one, mode in ((folder, 0o777), (folder / "compiled", 0o770)):
        open_one.chmod(mode)
        code, _, err = inspect(**home)
        assert (code, list((folder / "compiled").iterdir())) == (0, [])
        assert err.startswith(f"jaxos4: {open_one}: others can write to it, so it keeps no programs;")
        open_one.chmod(0o700)
    assert inspect(**home)[::2] == (0, "")


@pytest.mark.slow
def test_nothing_is_kept_without_a_home_folder(inspect, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert inspect(HOME="~")[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.csv", "page.html"]


@pytest.mark.parametrize(
    "line",
    [
        "predict r.json f.csv --horizon 1e300",
        "predict r.json f.csv --spacing 1e300",
        "design --out i.csv --slowest 1e300",
        "simulate --out f.csv --duration 1e300",
        "estimate f.csv --end -1e300",
        "train f.csv --out n.npz --noise 1 inf",
        "export r.json --to urdf --samples 10000000000",
    ],
)
def test_a_number_that_is_far_too_large_is_refused_by_its_option(line, run):
    *_, option, value = line.replace("1 inf", "inf").split()
    shown = f"{float(value):g}"
    assert run(*line.split())[::2] == (2, f"jaxos4: {option}: must lie within +-1e+09, got {shown}.\n")


@pytest.mark.parametrize("folder", [".", ".."])
def test_a_folder_that_is_no_study_is_refused_by_its_name(folder, run):
    assert run("report", folder)[::2] == (
        2,
        f"jaxos4: {folder}: holds no results.nc; give a folder that `jaxos4 study` wrote.\n",
    )
