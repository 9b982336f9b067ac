"""Shots in C: compiled with the system's compiler and -O3 when the benchmark runs; one core."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.benchmarks.case import Case

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")


def compiler() -> str | None:
    """The path of a C compiler; `None` if there is none."""
    return next(filter(None, map(shutil.which, COMPILERS)), None)


def shots(case: Case) -> Callable[[], dict]:
    """The cost of each flight at its start, one after another."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "shots.so"
        source = Path(__file__).with_name("shots.c")
        subprocess.run([str(compiler()), *FLAGS, str(source), "-o", str(library), "-lm"], check=True)
        shoot = ctypes.CDLL(str(library)).shots
    shoot.argtypes = [ctypes.c_int] * 3 + [ctypes.c_double] * 2 + [ctypes.c_void_p] * 6
    shoot.restype = None
    arrays = [case.forcing, case.measured, 1 / case.sigma, case.first_states(), case.starts, np.zeros(case.flights)]
    arrays = [np.ascontiguousarray(array, dtype=np.float64) for array in arrays]
    pointers = [array.ctypes.data for array in arrays]
    sizes = case.flights, len(case.forcing), case.begin, case.dt, case.gravity

    def run() -> dict:
        shoot(*sizes, *pointers)
        return {"costs": arrays[-1]}

    return run
