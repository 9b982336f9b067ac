"""Shots in C on one core: plain, with the library's sines; and several flights at a time, with polynomial sines."""

import ctypes
from collections.abc import Callable

import numpy as np

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.c_library import FAST, ORDER, compiled, in_lanes

LANES = 8


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
