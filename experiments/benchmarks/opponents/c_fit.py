"""Levenberg-Marquardt in C, with forward sensitivities and polynomial sines: what a processor can do at best.

As the estimators of this package, it fits the rates first, and then all channels. A search ends when its next step
promises to lower the cost by less than `TOLERANCE`; it takes this step.
"""

import ctypes
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.c_library import FAST, ORDER, compiled

COARSE = 1.0  # the tolerance of the fit to the rates
TOLERANCE = 0.02  # the next step leaves far less: its error is of second order


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
