"""Which disturbance do gusts make of the thrust? Its scale by maximum likelihood, for disturbances of two orders.

The specific force along z is the thrust of the measured rotor speeds times `gain`, an offset, white noise of the
sensor, and a disturbance: of first order (an Ornstein-Uhlenbeck process, as in filter error), or of second order (the
same behind a low-pass filter). Both are whitened by their innovations model, ARMA(1, 1) or ARMA(2, 2), whose poles and
zeros are real and searched; the rest is linear regression. The true gain is 1.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

import jaxos4
from experiments.monte_carlo import plus_minus, print_table, statistics
from experiments.rotorpy.flights import VEHICLE, fly
from experiments.shared import Count, Seed

# Time constants of poles, then of zeros, at which searches start, in samples.
STARTS = {1: [(125.0, 2.0)], 2: [(125.0, 5.0, 2.0, 2.0), (125.0, 5.0, 1.1, 5.0)]}
SETTLING = 200  # samples


class Fit(NamedTuple):
    """The gain, its standard deviation, and the logarithm of the likelihood, up to a constant of the flight."""

    gain: float
    std: float
    likelihood: float


def fit(force: np.ndarray, thrust: np.ndarray, order: int) -> Fit:
    """The gain of the thrust with a disturbance of this order."""
    columns = np.column_stack([force, thrust, np.ones_like(force)])

    def whitened(logs: np.ndarray) -> np.ndarray:
        roots = np.exp(-np.exp(-logs))
        return lfilter(np.poly(roots[:order]), np.poly(roots[order:]), columns, axis=0)[SETTLING:]

    def solved(white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        known = white[:, 1:]
        linear = np.linalg.lstsq(known, white[:, 0], rcond=None)[0]
        return linear, white[:, 0] - known @ linear

    def cost(logs: np.ndarray) -> float:
        _, left = solved(whitened(logs))
        return left.size / 2 * np.log(left @ left / left.size)

    settings = {"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-3}
    every = [minimize(cost, np.log(start), method="Nelder-Mead", options=settings) for start in STARTS[order]]
    best = min(every, key=lambda one: one.fun)
    white = whitened(best.x)
    linear, left = solved(white)
    covariance = np.linalg.inv(white[:, 1:].T @ white[:, 1:]) * left.var()
    return Fit(float(linear[0]), float(np.sqrt(covariance[0, 0])), -float(best.fun))


def thrust_of(flight: jaxos4.Flight) -> np.ndarray:
    """Thrust per mass of the measured rotor speeds, by the true coefficient [m/s^2]."""
    return float(VEHICLE.thrust_coefficient) / float(VEHICLE.mass) * np.square(flight.omega).sum(axis=1)


def main(flights: Count = 20, gust: float = 1.5, duration: float = 20.0, seed: Seed = 48) -> None:
    """Fit the scale of the thrust of RotorPy's Hummingbird in gusts.

    - `gust`: Standard deviation of the wind along each axis [m/s].
    """
    flown = [fly(gust, duration, seed, i) for i in range(flights)]
    found = {order: [fit(np.asarray(f.specific_force)[:, 2], thrust_of(f), order) for f in flown] for order in STARTS}
    lines = []
    for order, fits in found.items():
        error, std = np.array([(one.gain - 1, one.std) for one in fits]).T
        better = np.array([one.likelihood - first.likelihood for one, first in zip(fits, found[1], strict=True)])
        row, apart = statistics(error, std), f"{np.median(np.abs(error) / std):.1f}"
        lines.append((str(order), plus_minus(row), apart, f"{100 * row['covered']:.0f}", f"{better.mean():.0f}"))
    headings = "order", "thrust too large [%]", "median error / std", "95 % intervals that hold [%]", "log-likelihood"
    print_table(f"scale of the thrust by the disturbance, {flights} flights", headings, lines)
