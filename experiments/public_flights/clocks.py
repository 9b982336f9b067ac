"""The clock of a motion capture beside that of a gyro, of a flight that was recorded by two systems.

The gyro turns the attitude that the motion capture saw before into the one that it saw after. The lag with which this
fits best is found, and the columns of the motion capture are moved by it.
"""

import numpy as np

import jaxos4
from jaxos4.flight import RATES
from jaxos4.forecast.measured import Measured
from jaxos4.recording import Recording
from jaxos4.rotations import deviation

# Half of the time over which turns are compared, and the largest lag [samples]; an error of more medians is an outlier.
HALF, MOST, OUTLIER = 5, 6, 3.0


def capture_lag(recording: Recording) -> float:
    """How late the motion capture is recorded, compared with the gyro [s]: by the rates of roll and pitch."""
    attitude = Measured.of(jaxos4.Flight(recording.time, recording.omega, recording.states)).states[:, 6:10]
    seen = np.stack(deviation(attitude[: -2 * HALF].T, attitude[2 * HALF :].T), axis=1)[:, :2]
    rates = np.nan_to_num(recording.states[:, RATES[:2]])
    turned = np.cumsum((rates[1:] + rates[:-1]) / 2, axis=0) * recording.dt
    turned = np.concatenate([np.zeros((1, 2)), turned])
    turned = turned[2 * HALF :] - turned[: -2 * HALF]
    lags, costs = np.arange(-MOST, MOST + 1), []
    for lag in lags:
        off = seen[MOST + lag : len(seen) - MOST + lag] - turned[MOST:-MOST]
        off = np.abs(off - np.nanmedian(off, axis=0))
        costs.append(np.nanmean(np.minimum(off, OUTLIER * np.nanmedian(off, axis=0))))
    best = int(np.clip(np.argmin(costs), 1, len(lags) - 2))
    before, least, after = costs[best - 1 : best + 2]  # the minimum of a parabola
    return float(recording.dt * (lags[best] + np.clip((before - after) / (before - 2 * least + after) / 2, -1, 1)))


def aligned(recording: Recording) -> Recording:
    """The recording with position, velocity and attitude on the clock of the gyro."""
    states, time = recording.states.copy(), recording.time + capture_lag(recording)
    for column in np.setdiff1d(np.arange(states.shape[1]), RATES):
        states[:, column] = np.interp(time, recording.time, recording.states[:, column])
    return recording._replace(states=states)
