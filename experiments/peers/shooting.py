"""Multiple shooting in CasADi, compiled: Gauss-Newton in IPOPT, after CasADi's example `sysid.py`.

The flight is cut into windows whose initial body rates are unknowns too; constraints close the gaps between windows if
`closed`. The other unknowns are the thrust coefficient, the moments of inertia, a torque offset and a damping of each
axis, the rotors' inertia, their lag (if commands are logged) and their delay. Residuals are weighted by the noise of
the sensors in the first pass, and by the residuals of the pass before in the others.
"""

import functools
from collections.abc import Callable

import casadi
import numpy as np
from scipy.linalg import null_space

from experiments.benchmarks.opponents.casadi_fit import gauss_newton
from experiments.peers.log import Fit, Log

SETTINGS = (
    *({"window": window, "closed": False} for window in (0.2, 0.5, 2.0)),
    {"window": 1.0, "closed": True},
)
COMPILED = {
    "jit": True,
    "compiler": "shell",
    "jit_options": {"flags": ["-O1"]},
}  # -O3 takes a minute, and gains nothing
# Thrust coefficient, Ix, Iy, Iz, rotor inertia, all over those given; lag over 0.05 s; offsets [rad/s^2] and dampings
# [1/s] of the axes; samples by which the delay is longer than a whole number of samples that is known.
START = np.array([*[1.0] * 5, 0.8, *[0.0] * 7])
LOWEST = np.array([*[0.1] * 4, -10.0, 0.02, *[-100.0] * 6, -1.0])
HIGHEST = np.array([*[10.0] * 4, 10.0, 10.0, *[100.0] * 6, 2.0])
ROTOR, LAG, DELAY, SHARED = 4, 5, 12, 13
ITERATIONS = 60  # of IPOPT in a pass; good flights need less than 20
PASSES = 5  # at most; the delay changes its whole samples in some of them


def _turn(rates: casadi.SX, shared: casadi.SX, known: casadi.SX, squares: casadi.SX, spins: casadi.SX) -> casadi.SX:
    """Angular accelerations. `spins`: the rotors' speeds, and their changes [1/s], by their turning directions."""
    p, q, r = casadi.vertsplit(rates)
    ix, iy, iz = casadi.vertsplit(known[12:15] * shared[1:4])
    torques = casadi.vertsplit(shared[0] * casadi.reshape(known[:12], 3, 4) @ squares)
    rotor, (total, change) = known[15] * shared[ROTOR], casadi.vertsplit(spins)
    roll = (torques[0] + (iy - iz) * q * r - rotor * q * total) / ix
    pitch = (torques[1] + (iz - ix) * p * r + rotor * p * total) / iy
    yaw = (torques[2] + (ix - iy) * p * q - rotor * change) / iz
    return casadi.vertcat(roll, pitch, yaw) + shared[6:9] - shared[9:12] * rates


def _step(dt: float) -> casadi.Function:
    """One Runge-Kutta step of the body rates."""
    names = (("rates", 3), ("shared", SHARED), ("known", 21), ("squares", 4), ("spins", 2))
    rates, *others = symbols = [casadi.SX.sym(name, size) for name, size in names]
    first = _turn(rates, *others)
    second = _turn(rates + dt / 2 * first, *others)
    third = _turn(rates + dt / 2 * second, *others)
    fourth = _turn(rates + dt * third, *others)
    return casadi.Function("step", symbols, [rates + dt / 6 * (first + 2 * second + 2 * third + fourth)])


@functools.cache
def _program(windows: int, steps: int, dt: float, closed: bool) -> tuple[Callable, casadi.Function]:
    """The solver, and residuals with their Jacobian, for all flights of this length."""
    samples = windows * steps + 1
    shared, offsets = casadi.MX.sym("shared", SHARED), casadi.MX.sym("offsets", 3, windows)
    near, measured = casadi.MX.sym("near", 16, samples), casadi.MX.sym("measured", 4, samples)
    begun, known, weights = (
        casadi.MX.sym(name, *size) for name, size in (("b", (3, windows)), ("k", (21,)), ("w", (4,)))
    )

    x = shared[DELAY]
    cubic = (
        -x * (x - 1) * (x - 2) / 6,
        (x + 1) * (x - 1) * (x - 2) / 2,
        -(x + 1) * x * (x - 2) / 2,
        (x + 1) * x * (x - 1) / 6,
    )
    omega = casadi.horzcat(*(weight * casadi.DM.eye(4) for weight in cubic)) @ near
    speed, wanted, share = (casadi.SX.sym(name, size) for name, size in (("w", 4), ("u", 4), ("s", 1)))
    follow = casadi.Function("follow", [speed, wanted, share], [share * speed + (1 - share) * wanted])
    shares = casadi.repmat(casadi.exp(-dt / (0.05 * shared[LAG])), 1, samples - 1)
    omega = casadi.horzcat(omega[:, 0], follow.mapaccum("rotors", samples - 1)(omega[:, 0], omega[:, :-1], shares))
    begin, end = omega[:, :-1], omega[:, 1:]
    squares = (begin * begin + begin * end + end * end) / 3
    turning = known[17:].T
    spins = casadi.vertcat(turning @ (begin + end) / 2, turning @ (end - begin) / dt)

    starts, times = begun + offsets, casadi.repmat
    chain = _step(dt).mapaccum("chain", steps).map(windows)
    later = chain(starts, times(shared, 1, samples - 1), times(known, 1, samples - 1), squares, spins)
    inner = [k for k in range(samples - 1) if (k + 1) % steps]
    force = known[16] * shared[0] * casadi.sum1(begin * begin)
    errors = [
        (starts - measured[:3, 0:-1:steps]) / times(weights[:3], 1, windows),
        (later[:, inner] - measured[:3, [k + 1 for k in inner]]) / times(weights[:3], 1, len(inner)),
        (force - measured[3, :-1]) / times(weights[3], 1, samples - 1),
    ]
    residuals, unknowns = casadi.veccat(*errors), casadi.veccat(shared, offsets)
    data = casadi.veccat(near, measured, begun, known, weights)
    gaps = casadi.vec(later[:, steps - 1 : -1 : steps] - starts[:, 1:])
    slopes = casadi.jacobian(residuals, unknowns), casadi.jacobian(gaps, unknowns)
    solver = gauss_newton(residuals, unknowns, data, COMPILED, gaps if closed else None, ITERATIONS)
    return solver, casadi.Function("residuals", [unknowns, data], [residuals, *slopes])


def fit(log: Log, window: float, closed: bool) -> Fit:
    """Moments of inertia by windows of this length [s]."""
    steps = round(window / log.dt)
    windows = (len(log.omega) - 1) // steps
    samples = windows * steps + 1
    solve, evaluate = _program(windows, steps, log.dt, closed)
    airframe = log.airframe
    mixer, inertia = np.asarray(airframe.mixer), np.asarray(airframe.inertia)
    known = [*mixer[:3].T.ravel(), *inertia, float(airframe.rotor_inertia), log.thrust_scale / float(airframe.mass)]
    known += np.asarray(airframe.rotor_spins).tolist()
    measured = np.column_stack([log.rates, log.force])[:samples]
    begun = measured[: samples - 1 : steps, :3]
    lowest, highest = (np.append(end, np.full(3 * windows, sign)) for end, sign in ((LOWEST, -10.0), (HIGHEST, 10.0)))
    if not log.commands:
        highest[LAG] = lowest[LAG]  # so short that measured speeds are those at the sample before
    if known[15] == 0:
        lowest[ROTOR] = highest[ROTOR] = 1.0
    found, base, weights = np.append(START, np.zeros(3 * windows)), 1, log.noise
    limits = {"lbg": 0, "ubg": 0} if closed else {}
    for _ in range(PASSES):
        near = np.hstack([log.delayed((base + i) * log.dt)[:samples] for i in range(-1, 3)])
        data = np.concatenate([near.ravel(), measured.ravel(), begun.ravel(), known, weights])
        found = np.asarray(solve(x0=found, p=data, lbx=lowest, ubx=highest, **limits)["x"]).ravel()
        ended, before = solve.stats()["return_status"], weights
        residuals = np.asarray(evaluate(found, data)[0]).ravel()
        rates, force = residuals[: 3 * (samples - 1)].reshape(-1, 3), residuals[3 * (samples - 1) :]
        weights = weights * np.sqrt(np.mean(np.square(np.column_stack([rates, force])), axis=0))
        moved = round(np.clip(found[DELAY] - 0.5, -2, 2)) if not -0.98 < found[DELAY] < 1.98 else 0
        base, found[DELAY] = base + moved, found[DELAY] - moved
        if not moved and np.allclose(weights, before, rtol=0.05):
            break
    _, slope, linked = map(np.asarray, evaluate(found, data))
    free = lowest < highest
    ways = null_space(linked[:, free]) if closed else np.eye(free.sum())
    reached = slope[:, free] @ ways
    variance = np.zeros(len(found))
    variance[free] = np.diagonal(ways @ np.linalg.pinv(reached.T @ reached) @ ways.T)
    share = np.sqrt(variance[1:4])
    stuck = (found[:SHARED] < lowest[:SHARED] + 1e-3) | (found[:SHARED] > highest[:SHARED] - 1e-3)
    warnings = [] if ended in ("Solve_Succeeded", "Solved_To_Acceptable_Level") else [ended]
    warnings += ["a parameter is at its limit"] * bool((stuck & free[:SHARED]).any())
    return Fit(inertia * found[1:4], inertia * share, warnings)
