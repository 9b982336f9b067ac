"""A study that takes seconds, run in this process or by the command line in another, and compared."""

import os
import pathlib
import subprocess
import sys

import jax
import xarray as xr

from jaxos4.study import carry_out, load_study

SPECIFICATION = """
title = "A small study"
durations = [0.5]
scales = [0.1, 1.0]
channels = ["rates"]
estimators = ["equation-error"]
truth = "drawn"
flights = 95
batch = 4
seed = 3
"""
# Training of two steps: bad, and the same as a long one in all that is asked here.
NETWORKED = """
title = "A small study with a network"
durations = [0.5]
scales = [1.0]
channels = ["rates"]
estimators = ["network"]
truth = "drawn"
flights = 95
batch = 4
[network]
steps = 2
held_out = 1000
"""
COMMAND = "from jaxos4.cli import main; main()"


def specification(folder: pathlib.Path, text: str = SPECIFICATION) -> pathlib.Path:
    """A specification as a file."""
    path = folder / "spec.toml"
    path.write_text(text)
    return path


def run_study(folder: pathlib.Path, text: str = SPECIFICATION) -> pathlib.Path:
    """A whole study, in this process."""
    out = folder / "whole"
    carry_out(load_study(specification(folder, text)), out, "these tests")
    return out


def environment(devices: int = 1) -> dict[str, str]:
    """Of another process: its devices, and the compiled programs that it shares with this one."""
    return os.environ | {
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.values["jax_compilation_cache_dir"]),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
        "PYTHONPATH": os.pathsep.join([str(pathlib.Path(__file__).resolve().parents[1]), *sys.path[1:]]),
    }


def start(*arguments: str | pathlib.Path, code: str = COMMAND, devices: int = 1) -> subprocess.Popen[str]:
    """Another process of this Python: the command line, or other code."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=environment(devices),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    """What it printed; it must end well, and without a word on its error output."""
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, ""), err
    return out


def results(out: pathlib.Path) -> xr.Dataset:
    """The Dataset of a study, but for what computed it."""
    with xr.open_dataset(out / "results.nc") as dataset:
        dataset = dataset.load()
    del dataset.attrs["device"]
    return dataset


def cells(out: pathlib.Path) -> dict[str, bytes]:
    """The bytes of every cell."""
    return {path.name: path.read_bytes() for path in (out / "cells").glob("[0-9]*.npz")}
