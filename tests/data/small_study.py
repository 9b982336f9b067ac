"""A study of a few seconds, run in this process or by the command line in another process."""

import pathlib
import re
import subprocess
import sys

import xarray as xr
from helpers import COMMAND, PROGRESS, environment, how_we_compile

from jaxos4 import study

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
# Training of two steps: the network is bad, which does not matter here.
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
AIRFRAME = """
[airframe.mine]
mass = 0.6
inertia = [7e-3, 7e-3, 1.2e-2]
arm = 0.2
thrust_coefficient = 3e-5
drag_coefficient = 7e-7
rotor_inertia = 6e-5
"""


def specification(folder: pathlib.Path, text: str = SPECIFICATION) -> pathlib.Path:
    """Writes a specification to a file."""
    path = folder / "spec.toml"
    path.write_text(text)
    return path


def run_study(folder: pathlib.Path, text: str = SPECIFICATION) -> pathlib.Path:
    """Runs a study in this process."""
    out = folder / "whole"
    study.run_study(study.load_study(specification(folder, text)), out, "these tests")
    return out


def start(*arguments: str | pathlib.Path, code: str = COMMAND, devices: int = 1) -> subprocess.Popen[str]:
    """Starts another Python process with the command line, or with other code."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=environment(**how_we_compile(devices)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    """Returns the output of a process; it must succeed, and its error output is nothing but progress."""
    out, err = process.communicate(timeout=300)
    faults = [line for line in err.splitlines() if not re.fullmatch(PROGRESS, line)]
    assert (process.returncode, faults) == (0, []), err
    return out


def results(out: pathlib.Path) -> xr.Dataset:
    """The Dataset of a study without the name of the device."""
    with xr.open_dataset(out / "results.nc") as dataset:
        dataset = dataset.load()
    del dataset.attrs["device"]
    return dataset


def cells(out: pathlib.Path) -> dict[str, bytes]:
    """The bytes of every cell's file."""
    return {path.name: path.read_bytes() for path in (out / "cells").glob("[0-9]*.npz")}
