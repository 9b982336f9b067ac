"""The check of the sensors' clocks: the one that is recorded late or early."""

import math

import numpy as np

from .evidence import Evidence
from .finding import INERTIAS, Finding

_SENSORS = ("gyro", "accelerometer", "attitude")
_QUANTITIES = {"gyro": INERTIAS, "accelerometer": (*INERTIAS, "thrust", "motors"), "attitude": ("attitude",)}
_FOLLOWS, _COHERENT = 0.2, (0.2, 0.03)  # shares that gyro explains of attitude, and rotors of gyro and accelerometer
# Errors of delays that are none of the clock's [s]: filters, gusts that a controller answers, lags of the rotors.
_FILTERS, _GUSTS, _USUAL_LAG, _LAGS = 0.003, 0.004, 0.05, 0.025
_LIKELIER = 6.0  # difference of chi^2: a cause 20 times less likely than another is left out


def sensor_clocks(evidence: Evidence) -> Finding | None:
    """Gyro, accelerometer or attitude at another time than the others.

    Each delay is a difference of two clocks, those of the rotors included. The sensor that is named explains all
    delays best if all other clocks are right. Several are named if they explain them alike.
    """
    turns, response, limits = evidence.turns, evidence.response, evidence.limits
    # How much of each clock is in a delay, the delay, and its error without and with what is no error of a clock [s].
    delays: list[tuple[tuple[float, float, float], float, float, float]] = []
    differ = False
    if turns is not None and turns.explained[:2].max() > _FOLLOWS:
        late, error = float(turns.delay.value), float(turns.delay.error)
        delays.append(((-1, 0, 1), late, error, _FILTERS))
        differ |= abs(late) > max(limits.late_attitude, limits.standard_errors * error)
    if response is not None and response.coherent[:2].max() > _COHERENT[0]:
        gyro, force, between = zip(response.delays.value.tolist(), response.delays.error.tolist(), strict=True)
        lag, usual = (_USUAL_LAG - response.lag, _LAGS) if response.lag else (0.0, _GUSTS)
        delays.append(((1, 0, 0), gyro[0] - lag, gyro[1], usual))
        if response.coherent[2] > _COHERENT[1]:
            delays.append(((1, -1, 0), *between, _GUSTS))
            differ |= abs(between[0]) > max(limits.delay, limits.standard_errors * between[1])
    if not differ:
        return None
    clocks, late = np.array([each[0] for each in delays]), np.array([each[1] for each in delays])
    error = np.array([math.hypot(*each[2:]) for each in delays])
    weights = clocks / error[:, None]
    measured = np.abs(clocks).any(axis=0)
    wrong = (weights.T @ (late / error)) / np.where(measured, np.square(weights).sum(axis=0), 1.0)
    misfit = np.where(measured, np.square(late[:, None] / error[:, None] - weights * wrong).sum(axis=0), np.inf)
    named = np.flatnonzero(misfit < misfit.min() + _LIKELIER)
    named = named[np.argsort(misfit[named])]
    causes = [
        f"the {_SENSORS[i]} is recorded {1e3 * abs(wrong[i]):.0f} ms {'late' if wrong[i] > 0 else 'early'}"
        for i in named
    ]
    spread = 2e3 / math.sqrt(np.square(weights[:, named[0]]).sum())
    return Finding(
        "_or_".join(_SENSORS[i] for i in named) + "_clock",
        ", or ".join(causes),
        f"{1e3 * wrong[named[0]]:.1f} +- {spread:.1g} ms",
        "shift its time stamps, or log it without a filter",
        tuple(dict.fromkeys(quantity for i in named for quantity in _QUANTITIES[_SENSORS[i]])),
        bool(abs(wrong[named[0]]) > limits.late),
    )
