"""Rates and forces driven by Ornstein-Uhlenbeck disturbances: exact moments by Van Loan (1978), a dense Gaussian."""

import numpy as np
import scipy.linalg


def piece(time, tau, smoothing=None, *, summed=False):
    """How (rate or force, disturbance, sum) move in a time, and the covariance that noise adds.

    `smoothing`: of a force; by default the first state is a rate, the integral of the disturbance. `summed`: whether it
    is summed. By Van Loan (1978), for a disturbance of unit variance.
    """
    driven = (0.0, 1.0) if smoothing is None else (-1 / smoothing, 1 / smoothing)
    drift, noise = np.array([[*driven, 0.0], [0.0, -1 / tau, 0.0], [0.0, 0.0, 0.0]]), np.diag([0.0, 2 / tau, 0.0])
    drift[2, 0] = float(summed)
    whole = scipy.linalg.expm(np.block([[-drift, noise], [np.zeros((3, 3)), drift.T]]) * time)
    moved = whole[3:, 3:].T
    return moved, moved @ whole[:3, 3:]


def sample(dt, tau, begin, length, smoothing=None):
    """The same over one sample, with the measurement instead of the sum: the mean over the window, or an instant."""
    window = piece(length, tau, smoothing, summed=True) if length else (np.eye(3), np.zeros((3, 3)))
    if length:
        window = [np.diag([1, 1, 1 / length]) @ window[0], np.diag([1, 1, 1 / length]) @ window[1]]
        window[1] = window[1] @ np.diag([1, 1, 1 / length])
    else:
        window[0][2, 0] = 1.0
    total, added = np.eye(3), np.zeros((3, 3))
    for moved, noise in (piece(begin, tau, smoothing), window, piece(dt - begin - length, tau, smoothing)):
        total, added = moved @ total, moved @ added @ moved.T + noise
    return total, added


def transition(strength, tau, dt):
    """State transition and added covariance of a rate and the disturbance that drives it."""
    moved, added = piece(dt, tau)
    return moved[:2, :2], strength**2 * added[:2, :2]


def joint_cost(off, moved, added, first, sensor, *, seen):
    """Minus the logarithm of the density of the measurements `off`, without its constant; NaN: not measured.

    `first`: the covariance of the state at the first measurement. State number `seen` is measured, with the noise
    `sensor`.
    """
    samples, own = len(off), first
    covariance = sensor**2 * np.eye(samples)
    for k in range(samples):
        ahead = own
        for j in range(k, samples):
            covariance[k, j] += ahead[seen, seen]
            covariance[j, k] = covariance[k, j]
            ahead = moved @ ahead
        own = moved @ own @ moved.T + added
    known = ~np.isnan(off)
    dense, off = covariance[np.ix_(known, known)], off[known]
    return (off @ np.linalg.solve(dense, off) + np.linalg.slogdet(dense)[1]) / 2
