"""The check of the clocks: the sensor, or the motors, that are recorded late or early."""

import math
from typing import NamedTuple

import numpy as np

from .evidence import Evidence
from .finding import INERTIAS, Finding

CLOCK = "_clock"
"""The end of the name of a finding about clocks."""
_CLOCKS = ("gyro", "accelerometer", "attitude", "motors")
_VERBS = dict.fromkeys(_CLOCKS, "is") | {"motors": "are"}
_QUANTITIES = {
    "gyro": INERTIAS,
    "accelerometer": (*INERTIAS, "thrust", "motors"),
    "attitude": ("attitude",),
    "motors": ("motors",),
}
_FOLLOWS, _COHERENT = 0.2, (0.2, 0.03)  # shares that gyro explains of attitude, and rotors of gyro and accelerometer
# Standard deviations of delays that are no error of a clock [s]: filters, gusts that a controller answers, and the lag
# and delay of rotors that follow commands, about their mean.
_FILTERS, _GUSTS, _USUAL_LAG, _LAGS = 0.003, 0.004, 0.05, 0.025
_LIKELIER = 6.0  # difference of chi^2: a cause 20 times less likely than another is left out


class _Delay(NamedTuple):
    """How much of each clock is in a delay, the delay and its standard error [s], and what is no error of a clock."""

    clocks: tuple[int, int, int, int]
    late: float
    error: float
    usual: float


def sensor_clocks(evidence: Evidence) -> Finding | None:
    """One clock that differs from the others.

    Each measured delay is a difference of two clocks. The clock that is named explains all delays best if the other
    clocks are right. Several are named if they explain them alike.
    """
    delays, differ = _delays(evidence)
    if not differ:
        return None
    clocks, late = np.array([each.clocks for each in delays]), np.array([each.late for each in delays])
    error = np.array([math.hypot(each.error, each.usual) for each in delays])
    weights = clocks / error[:, None]
    measured = np.abs(clocks).any(axis=0)
    squares = np.where(measured, np.square(weights).sum(axis=0), 1.0)
    wrong = weights.T @ (late / error) / squares
    misfit = np.where(measured, np.square((late / error)[:, None] - weights * wrong).sum(axis=0), np.inf)
    best = np.argsort(misfit)
    named = [i for i in best if misfit[i] < misfit[best[0]] + _LIKELIER]
    causes = [
        f"the {_CLOCKS[i]} {_VERBS[_CLOCKS[i]]} recorded {1e3 * abs(wrong[i]):.0f} ms "
        f"{'late' if wrong[i] > 0 else 'early'}"
        for i in named
    ]
    names = [_CLOCKS[i] for i in named]
    return Finding(
        "_or_".join(names) + CLOCK,
        ", or ".join(causes),
        f"{1e3 * wrong[best[0]]:.1f} +- {2e3 / math.sqrt(squares[best[0]]):.2g} ms",
        "shift the time stamps, or log without a filter",
        tuple(dict.fromkeys(quantity for name in names for quantity in _QUANTITIES[name])),
        # The delay of the motors is estimated with the other parameters.
        bool(abs(wrong[best[0]]) > evidence.limits.late and "motors" not in names),
    )


def _delays(evidence: Evidence) -> tuple[list[_Delay], bool]:
    """The delays that the log shows, and whether one of them is a finding."""
    turns, response, limits = evidence.turns, evidence.response, evidence.limits
    delays, differ = [], False
    if turns is not None and turns.explained[:2].max() > _FOLLOWS:
        late, error = float(turns.delay.value), float(turns.delay.error)
        delays.append(_Delay((-1, 0, 1, 0), late, error, _FILTERS))
        differ |= abs(late) > max(limits.late_attitude, limits.standard_errors * error)
    if response is not None and response.coherent[:2].max() > _COHERENT[0]:
        gyro, _, between = zip(response.delays.value.tolist(), response.delays.error.tolist(), strict=True)
        late, usual = gyro[0], _GUSTS
        if response.lag:  # commands: the rotors' own lag and delay are unknown
            late, usual = gyro[0] + response.lag - _USUAL_LAG, _LAGS
        delays.append(_Delay((1, 0, 0, -1), late, gyro[1], usual))
        before = min(gyro[0] + response.lag, 0.0) if response.lag else gyro[0]
        differ |= abs(before) > max(limits.late, limits.standard_errors * gyro[1])
        if response.coherent[2] > _COHERENT[1] and math.isfinite(between[1]):
            delays.append(_Delay((1, -1, 0, 0), *between, _GUSTS))
            differ |= abs(between[0]) > max(limits.delay, limits.standard_errors * between[1])
    return delays, differ
