"""Rates driven by Ornstein-Uhlenbeck disturbances: exact moments by Van Loan (1978), and a dense joint Gaussian."""

import numpy as np
import scipy.linalg


def piece(time, tau, *, of=None):
    """How (integral of the disturbance, disturbance, sum) move in a time, and the covariance that noise adds.

    `of`: 0 or 1: this state is summed; by default none. By Van Loan (1978), for a disturbance of unit variance.
    """
    drift, noise = np.array([[0.0, 1.0, 0.0], [0.0, -1 / tau, 0.0], [0.0, 0.0, 0.0]]), np.diag([0.0, 2 / tau, 0.0])
    if of is not None:
        drift[2, of] = 1.0
    whole = scipy.linalg.expm(np.block([[-drift, noise], [np.zeros((3, 3)), drift.T]]) * time)
    moved = whole[3:, 3:].T
    return moved, moved @ whole[:3, 3:]


def sample(dt, tau, begin, length, measured):
    """The same over one sample, with the measurement instead of the sum.

    `measured`: 0: the integral of the disturbance, as a rate. 1: the disturbance, as a specific force. The mean over
    the window is measured, or the value at its beginning.
    """
    window = piece(length, tau, of=measured) if length else (np.eye(3), np.zeros((3, 3)))
    if length:
        window = [np.diag([1, 1, 1 / length]) @ window[0], np.diag([1, 1, 1 / length]) @ window[1]]
        window[1] = window[1] @ np.diag([1, 1, 1 / length])
    else:
        window[0][2, measured] = 1.0
    total, added = np.eye(3), np.zeros((3, 3))
    for moved, noise in (piece(begin, tau), window, piece(dt - begin - length, tau)):
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
