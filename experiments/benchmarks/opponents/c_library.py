"""Opponents in C: compiled with the system's compiler when the benchmark runs."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-O3", "-march=native", "-fPIC")
# Loops over lanes become vector instructions; numbers that are not finite stay what they are.
FAST = ("-ffast-math", "-fno-finite-math-only", "-fopenmp-simd")
# The order of the states in `lanes.h`: p, q, r, phi, theta, psi, vx, vy, vz, x, y, z.
ORDER = [7, 9, 11, 6, 8, 10, 1, 3, 5, 0, 2, 4]


def compiler() -> str | None:
    """The path of a C compiler; `None` if there is none."""
    return next(filter(None, map(shutil.which, COMPILERS)), None)


@functools.cache
def compiled(source: str, *flags: str) -> ctypes.CDLL:
    """The library of a C file of this folder.

    It is linked without the flags: a library that is linked with `-ffast-math` makes the whole process that loads it
    round numbers below 2e-308 to 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        object_file, library = Path(folder) / "opponent.o", Path(folder) / "opponent.so"
        path = Path(__file__).with_name(source)
        subprocess.run([str(compiler()), *FLAGS, *flags, "-c", str(path), "-o", str(object_file)], check=True)
        subprocess.run([str(compiler()), "-shared", str(object_file), "-o", str(library), "-lm"], check=True)
        return ctypes.CDLL(str(library))


def in_lanes(array: np.ndarray, lanes: int) -> np.ndarray:
    """(flights, ...) as (groups, ..., lanes). The last flight is repeated, so that all groups have the same number."""
    places = np.minimum(np.arange(-len(array) % lanes + len(array)), len(array) - 1).reshape(-1, lanes)
    return np.ascontiguousarray(np.moveaxis(array[places], 1, -1), dtype=np.float64)
