"""CasADi: single and multiple shooting with a Gauss-Newton Hessian and IPOPT, after CasADi's example `sysid.py`.

As that example recommends, one step is expanded into scalar operations, `mapaccum` and `map` build the trajectory, the
decision variables are scaled, and multiple shooting begins at the measured states.
"""

import multiprocessing
import time
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np

from experiments.benchmarks.case import Case, step

COMPILED = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O3", "-march=native"]}}
# With a tighter tolerance, the default of 1e-8, the costs are the same to 1e-8.
OPTIONS = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-4}


def single(case: Case, compiled: bool = False, cores: int = 1) -> Callable[[], dict]:
    """The unknowns are the parameters, and the initial state if it is free. `compiled`: by the C compiler.

    `cores`: processes that share the flights: IPOPT crashed when it solved in two threads.
    """
    steps = len(case.forcing)
    start, measured = casadi.MX.sym("start", 8), casadi.MX.sym("measured", 12, steps + 1)
    scaled, offset = casadi.MX.sym("scaled", 8), casadi.MX.sym("offset", 0 if case.known else 12)
    alpha = start + scaled * case.half_width
    first = casadi.DM.zeros(12) if case.known else measured[:, 0] + offset * case.sigma
    following = _one_step(case).mapaccum("trajectory", steps)(first, case.forcing.T, casadi.repmat(alpha, 1, steps))
    errors = casadi.vec((casadi.horzcat(first, following) - measured)[:, case.begin :] / _tiled(case, steps + 1))
    unknowns, data = casadi.vertcat(scaled, offset), casadi.vertcat(start, casadi.vec(measured))
    solver = gauss_newton(errors, unknowns, data, COMPILED if compiled else None)
    return _answers(case, solver, unknowns.numel(), cores)


def multiple(case: Case) -> Callable[[], dict]:
    """All states are unknowns as well, and equality constraints close the gaps."""
    steps = len(case.forcing)
    start, measured = casadi.MX.sym("start", 8), casadi.MX.sym("measured", 12, steps + 1)
    scaled, offsets = casadi.MX.sym("scaled", 8), casadi.MX.sym("offsets", 12, steps + 1 - case.begin)
    alpha = start + scaled * case.half_width
    states = measured[:, case.begin :] + offsets * _tiled(case, steps + 1)
    if case.known:
        states = casadi.horzcat(casadi.DM.zeros(12), states)
    following = _one_step(case).map(steps)(states[:, :-1], case.forcing.T, casadi.repmat(alpha, 1, steps))
    gaps = casadi.vec((following - states[:, 1:]) / casadi.repmat(casadi.DM(case.sigma), 1, steps))
    unknowns, data = casadi.veccat(scaled, offsets), casadi.vertcat(start, casadi.vec(measured))
    solver = gauss_newton(casadi.vec(offsets), unknowns, data, gaps=gaps)
    return _answers(case, solver, unknowns.numel(), lbg=0, ubg=0)


def _answers(case: Case, solver: casadi.Function, unknowns: int, cores: int = 1, **limits: float) -> Callable[[], dict]:
    """All flights, one after another; or by several processes, whose processor time is counted `elsewhere`."""
    zero = np.zeros(unknowns)

    def solve(which: int) -> np.ndarray:
        data = np.concatenate([case.starts[which], case.measured[which].ravel()])
        return np.asarray(solver(x0=zero, p=data, **limits)["x"]).ravel()

    each = _on_cores(solve, cores) if cores > 1 else lambda whiches: ([solve(which) for which in whiches], 0.0)

    def run() -> dict:
        found, elsewhere = each(range(case.flights))
        return case.answer(np.array(found)) | {"elsewhere": elsewhere}

    return run


def _on_cores(solve: Callable[[int], np.ndarray], cores: int) -> Callable[[range], tuple[list[np.ndarray], float]]:
    """The answers for several flights by processes that begin as copies of this one, and their processor time [s]."""
    pool = multiprocessing.get_context("fork").Pool(cores, _TASK.append, (solve,))

    def each(flights: range) -> tuple[list[np.ndarray], float]:
        found = pool.map(_timed, flights, chunksize=1)
        return [answer for answer, _ in found], sum(seconds for _, seconds in found)

    return each


_TASK: list[Callable[[int], np.ndarray]] = []  # of a process of `_on_cores`


def _timed(which: int) -> tuple[np.ndarray, float]:
    begin = time.process_time()
    answer = _TASK[0](which)
    return answer, time.process_time() - begin


def _one_step(case: Case) -> casadi.Function:
    state, forcing, alpha = (casadi.SX.sym(name, size) for name, size in (("x", 12), ("u", 4), ("a", 8)))
    pieces = (casadi.vertsplit(part) for part in (state, forcing, alpha))
    following = casadi.vertcat(*step(casadi, *pieces, case.dt, case.gravity))
    return casadi.Function("one_step", [state, forcing, alpha], [following])


def _tiled(case: Case, samples: int) -> casadi.DM:
    return casadi.repmat(casadi.DM(case.sigma), 1, samples - case.begin)


def gauss_newton(
    errors: casadi.MX,
    unknowns: casadi.MX,
    data: casadi.MX,
    how: dict[str, Any] | None = None,
    gaps: casadi.MX | None = None,
    iterations: int = 3000,
):
    """IPOPT with the Hessian J^T J of the residuals. `how`: options of the compiler. `iterations`: at most."""
    slope = casadi.jacobian(errors, unknowns)
    factor, multipliers = casadi.MX.sym("factor"), casadi.MX.sym("multipliers", 0 if gaps is None else gaps.numel())
    hessian = casadi.Function(
        "nlp_hess_l",
        {
            "x": unknowns,
            "p": data,
            "lam_f": factor,
            "lam_g": multipliers,
            "triu_hess_gamma_x_x": factor * casadi.triu(slope.T @ slope),
        },
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
        how or {},
    )
    problem = {"x": unknowns, "p": data, "f": casadi.dot(errors, errors) / 2}
    if gaps is not None:
        problem["g"] = gaps
    options = {**OPTIONS, **(how or {}), "ipopt.max_iter": iterations, "hess_lag": hessian}
    return casadi.nlpsol("solver", "ipopt", problem, options)
