"""Opponents in C, compiled with the system's compiler when the benchmark runs: Levenberg-Marquardt, and shots.

The search has forward sensitivities and polynomial sines: what a processor can do at best. As the estimators of this
package, it fits the rates first, and then all channels. It ends when its next step promises to lower the cost by less
than `TOLERANCE`, and takes this step.
"""

import ctypes
import functools
import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from experiments.benchmarks.case import Case

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-O3", "-march=native", "-fPIC")
# Loops over lanes become vector instructions; numbers that are not finite stay what they are.
FAST = ("-ffast-math", "-fno-finite-math-only", "-fopenmp-simd")
# The order of the states in `lanes.h`: p, q, r, phi, theta, psi, vx, vy, vz, x, y, z.
ORDER = [7, 9, 11, 6, 8, 10, 1, 3, 5, 0, 2, 4]
COARSE = 1.0  # the tolerance of the fit to the rates
TOLERANCE = 0.02  # the next step leaves far less: its error is of second order
LANES = 8  # of shots


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


class _Data(ctypes.Structure):
    """`Data` of `fits.c`."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("flights", "steps", "begin")),
        *((name, ctypes.c_double) for name in ("dt", "gravity")),
        *((name, ctypes.c_void_p) for name in ("order", "forcing", "measured", "weights")),
        *((name, ctypes.c_void_p) for name in ("starts", "half_width", "first", "found")),
    )


def levenberg_marquardt(case: Case, *, lanes: int, cores: int = 1) -> Callable[[], dict]:
    """`lanes` flights at a time. With AVX2, four were faster than eight.

    With one lane, the sensitivities to several unknowns are computed at a time. `cores`: threads, each with its share
    of the flights.
    """
    fits = compiled("fits.c", *FAST, f"-DLANES={lanes}").fits
    fits.argtypes, fits.restype = [ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double], None
    first = case.first_states()[:, ORDER]
    found = np.zeros((case.flights, 20))
    order = np.array(ORDER, dtype=np.intc)
    shared = {"forcing": case.forcing, "weights": 1 / case.sigma[ORDER], "half_width": case.half_width}
    arrays = shared | {"measured": case.measured, "starts": case.starts, "first": first, "found": found}
    arrays = {name: np.ascontiguousarray(array, dtype=np.float64) for name, array in arrays.items()}
    threads = ThreadPoolExecutor(cores)

    def fit(part: slice) -> None:
        pointers = {name: x.ctypes.data if name in shared else x[part].ctypes.data for name, x in arrays.items()}
        count = len(found[part])
        sizes = {"flights": count, "steps": len(case.forcing), "begin": case.begin}
        data = _Data(**sizes, dt=case.dt, gravity=case.gravity, order=order.ctypes.data, **pointers)
        fits(case.known, ctypes.byref(data), COARSE, TOLERANCE)

    edges = np.linspace(0, case.flights, cores + 1).astype(int)
    parts = [slice(*pair) for pair in itertools.pairwise(edges) if pair[0] < pair[1]]

    def run() -> dict:
        found[:] = 0.0
        list(threads.map(fit, parts))
        states = np.empty_like(first)
        states[:, ORDER] = first + found[:, 8:] * case.sigma[ORDER]
        return {"parameters": case.starts + found[:, :8] * case.half_width, "first": states}

    return run


def plain(case: Case) -> Callable[[], dict]:
    """The cost of each flight at its start, one after another."""
    data = [case.forcing, case.measured, 1 / case.sigma, case.first_states(), case.starts]
    return _shots(compiled("shots.c").shots, case, case.flights, data, [np.zeros(case.flights)])


def lanes(case: Case, *, channels: str = "all", slope: bool = False, same_flight: bool = False) -> Callable[[], dict]:
    """`LANES` flights at a time, with the derivative along one direction if `slope`. The initial state is at rest.

    The measurements are put in the order in which they are read before the time counts. `same_flight`: all shots are
    compared with the first flight.
    """
    library = compiled("lane_shots.c", *FAST, f"-DLANES={LANES}")
    function = library[f"{'slopes' if slope else 'shots'}_{channels}{'_same' * same_flight}"]
    measured = case.measured[:, :, ORDER if channels == "all" else ORDER[:3]]
    measured = measured[0] if same_flight else in_lanes(measured, LANES)
    starts = in_lanes(case.starts, LANES)
    data = [case.forcing, measured, 1 / case.sigma[ORDER], np.zeros(12), starts, case.half_width]
    answers = [np.zeros((len(starts), LANES)), np.zeros((len(starts), LANES))]
    return _shots(function, case, len(starts), data, answers)


def _shots(function, case: Case, count: int, data: list[np.ndarray], answers: list[np.ndarray]) -> Callable[[], dict]:
    """A run of a C function on `data`; the first of its answers are the costs, and the second the slopes."""
    arrays = [np.ascontiguousarray(array, dtype=np.float64) for array in data] + answers
    function.argtypes = [ctypes.c_int] * 3 + [ctypes.c_double] * 2 + [ctypes.c_void_p] * len(arrays)
    function.restype = None

    def run() -> dict:
        pointers = [array.ctypes.data for array in arrays]
        function(count, len(case.forcing), case.begin, case.dt, case.gravity, *pointers)
        names = ("costs", "slopes")[: len(answers)]
        return {name: x.ravel()[: case.flights] for name, x in zip(names, answers, strict=True)}

    return run


def in_lanes(array: np.ndarray, lanes: int) -> np.ndarray:
    """(flights, ...) as (groups, ..., lanes). The last flight is repeated, so that all groups have the same number."""
    places = np.minimum(np.arange(-len(array) % lanes + len(array)), len(array) - 1).reshape(-1, lanes)
    return np.ascontiguousarray(np.moveaxis(array[places], 1, -1), dtype=np.float64)
