"""Kills, full disks, damaged files and simultaneous runs: no result of a study is lost or altered."""

import errno
import os
import pathlib
import random
import shutil
import signal
import time

import jax
import pytest
import xarray as xr
from helpers import COMMAND, refused
from small_study import SPECIFICATION, cells, finish, results, run_study, specification, start

from jaxos4.study import load_study
from jaxos4.study.dataset import open_store, read_store


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The study in one run, without interruption."""
    jax.clear_caches()  # programs of other modules may have another level of optimisation: other last digits
    return run_study(tmp_path_factory.mktemp("study"))


@pytest.fixture
def copy(whole, tmp_path):
    """A copy of the finished study to damage; `spec.toml` is beside it."""
    specification(tmp_path)
    return pathlib.Path(shutil.copytree(whole, tmp_path / "out"))


def written(out: pathlib.Path) -> dict[str, int]:
    """When each finished cell was written."""
    return {path.name: path.stat().st_mtime_ns for path in out.glob("cells/[0-9]*.npz")}


@pytest.mark.slow
def test_a_study_is_the_same_after_any_number_of_kills_and_on_any_number_of_devices(whole, tmp_path):
    """The processes that are killed have one device; the process that finishes the study has two."""
    out, moments, kills = tmp_path / "out", random.Random(1), 0
    command = ("study", specification(tmp_path), "--out", out)
    count, before = load_study(tmp_path / "spec.toml").count, 0
    while kills < 2:
        process = start(*command)
        # The first kill comes during the start, the second after some cells.
        deadline = time.monotonic() + (moments.uniform(0, 2) if kills == 0 else 120)
        wanted = before + moments.randint(1, 6)
        while process.poll() is None and time.monotonic() < deadline and len(list(out.glob("cells/*.npz"))) < wanted:
            time.sleep(moments.uniform(0, 0.02))
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL  # it was at work
        kills, before = kills + 1, len(list(out.glob("cells/*.npz")))
        assert before < count
    assert 0 < before < count / 2  # most cells are left for two devices
    finished = written(out)
    assert "190 estimates" in finish(start(*command, devices=2))
    xr.testing.assert_identical(results(out), results(whole))
    assert cells(out) == cells(whole)
    assert finished.items() <= written(out).items()  # no finished cell is computed again


@pytest.mark.slow
def test_an_interrupt_ends_a_study_at_once_with_one_line_and_the_same_command_resumes(whole, tmp_path):
    # A long training runs in a thread that cannot be interrupted.
    text = (
        SPECIFICATION.replace('["equation-error"]', '["equation-error", "network"]') + "[network]\nsteps = 1_000_000\n"
    )
    out, command = tmp_path / "out", ("study", specification(tmp_path, text), "--out", tmp_path / "out")
    # A shell's background jobs ignore Ctrl-C, and so do their children.
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {COMMAND}"
    process, deadline = start(*command, code=code, devices=2), time.monotonic() + 120
    while not list(out.glob("cells/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    line = f"jaxos4: {out}: interrupted; run the same command again to continue.\n"
    assert (process.returncode, err) == (-signal.SIGINT, line)
    finished = cells(out)
    assert finished.items() <= cells(whole).items()
    assert read_store(out).device.startswith("2 x")
    assert len(read_store(out).missing()) == 96 - len(finished)


class InterruptedAtItsEnd:
    """Is interrupted where Python drops the exception."""

    def __del__(self):
        raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupt_that_python_drops_ends_a_study_too(whole, copy, run, monkeypatch):
    (copy / "results.nc").unlink()
    (copy / "cells/00000019.npz").unlink()
    write = pathlib.Path.write_bytes

    def interrupted(path: pathlib.Path, data: bytes) -> int:
        InterruptedAtItsEnd()
        time.sleep(10)  # the interrupt is raised again
        return write(path, data)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_bytes", interrupted)
        patch.setattr(signal, "raise_signal", lambda _: None)  # would end the tests
        code, _, err = run("study", "spec.toml", "--out", "out")
    assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    signal.signal(signal.SIGINT, handler)
    assert (code, err) == (130, "jaxos4: out: interrupted; run the same command again to continue.\n")
    assert cells(copy).items() < cells(whole).items()
    assert not (copy / "results.nc").exists()
    assert run("study", "spec.toml", "--out", "out")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after", "name"), [(0, "00000019.npz"), (1, "00000040.npz"), (2, "results.nc"), (0, "study.json")]
)
def test_a_full_disk_is_one_line_and_the_study_resumes_later(whole, copy, run, monkeypatch, after, name):
    write, written, new = pathlib.Path.write_bytes, [], name == "study.json"
    if new:
        shutil.rmtree(copy)
    for place in () if new else ("results.nc", "cells/00000019.npz", "cells/00000040.npz"):
        (copy / place).unlink()

    def until_full(path: pathlib.Path, data: bytes) -> int:
        if len(written) == after:
            write(path, bytes(data)[:100])
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written.append(path)
        return write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_bytes", until_full)
        refused(run("study", "spec.toml", "--out", "out"), name, "No space left on device")
    assert len(list(copy.rglob("*.npz"))) == (0 if new else 46 + after)
    assert not list(copy.rglob(".*"))
    assert run("study", "spec.toml", "--out", "out", *(["--dry-run"] if new else []))[0] == 0
    if not new:
        assert cells(copy) == cells(whole)
        xr.testing.assert_identical(results(copy), results(whole))


@pytest.mark.slow
def test_a_second_run_is_refused_during_the_first_and_where_nothing_can_be_written(copy, run, monkeypatch):
    command = ("study", "spec.toml", "--out", "out")
    with open_store(copy, load_study(copy.parent / "spec.toml"), "the first"):
        refused(run(*command), "out", "another run is at work")
        code, out, _ = run(*command, "--dry-run")
        assert (code, "0 of 48 cells" in out) == (0, True)
    assert run(*command)[0] == 0
    # Root may write anywhere, so that the refusal must be simulated.
    monkeypatch.setattr("os.access", lambda path, mode, **options: mode != os.W_OK)
    (copy.parent / "empty").mkdir()
    refused(run(*command[:-1], "empty"), "study.json", "not writable")


@pytest.mark.slow
def test_a_damaged_cell_is_named_and_is_computed_again_once_deleted(copy, whole, run):
    cell, older = copy / "cells" / "00000030.npz", (copy / "results.nc").read_bytes()
    data, other = cell.read_bytes(), whole / "cells" / "00000023.npz"  # three flights, where four belong
    array = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (0,), }".ljust(128, b" ")
    for damaged in (data[: len(data) // 2], b"\0" * 99, b"", array, other.read_bytes()):
        cell.write_bytes(damaged)
        refused(run("study", "spec.toml", "--out", "out"), str(cell.relative_to(copy.parent)), "delete it")
        assert (copy / "results.nc").read_bytes() == older
    cell.unlink()
    assert run("study", "spec.toml", "--out", "out")[0] == 0
    assert cells(copy) == cells(whole)


@pytest.mark.slow
def test_half_written_files_of_a_killed_run_are_no_obstacle(copy, whole, run):
    for place in (".study.0123abcd.part.json", ".results.0123abcd.part.nc", "cells/.00000003.0123abcd.part.npz"):
        (copy / place).write_bytes(b"half")
    (copy / "cells" / "00000003.npz").unlink()
    # A kill before the specification was written, and a kill before the Dataset was written.
    (copy / "results.nc").unlink()
    assert run("study", "spec.toml", "--out", "out")[0] == 0
    assert not list(copy.rglob(".*"))
    xr.testing.assert_identical(results(copy), results(whole))
    early = copy.parent / "early"
    early.mkdir()
    (early / ".study.0123abcd.part.json").write_bytes(b"half")
    (early / "lock").touch()
    code, out, _ = run("study", "spec.toml", "--out", "early", "--dry-run")
    assert (code, "48 of 48 cells" in out) == (0, True)
    with open_store(early, load_study(copy.parent / "spec.toml"), "d") as store:
        assert len(store.missing()) == 48
    assert not list(early.glob(".*"))
