"""What a log says beside the samples of its flight: how often it was really written, and facts about the vehicle."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SLOWEST_RATE = 40.0
"""The fewest samples a second of motors and gyro that identify a vehicle [Hz].

Rotors follow their commands with a lag of 20 to 80 ms. Commands one lag apart or further tell too little of the speeds
between them. In closed loop, with the lag and delay that fit best, commands at 10 Hz make inertias 1.4 to 2.1 times too
large, commands at 20 Hz 1.1 to 1.2 times; at 40 Hz the error is below 6 %.
"""

_JITTER = 0.95  # a log at a nominal rate may be this much slower
_PAUSE = 1.0  # [s]; a longer time between samples is a pause of the log, and not its rate
_FEWEST_CHANGES, _REGULAR = 20, 0.6  # so many steps, of which most are equal up to this share, are a rate
_FASTER = "log motors and gyro at 100 Hz or more, and fly again"


class Sampling(NamedTuple):
    """How often something was written to the log: its `source`, as the log names it, and its `rate` [Hz]."""

    source: str
    rate: float


class LogFacts(NamedTuple):
    """What a log says beside the flight. `None`: the log does not say it.

    - `motors`, `gyro`: how often rotor speeds or commands, and body rates, were written, before any resampling.
    - `faster`: what to do so that the vehicle writes them more often.
    - `landed`: from when to when the vehicle itself says that it is on the ground [s], in the flight's time.
    - `rotor_positions`: x forward and y left of each rotor [m], in the order of the rotors in the flight.
    - `rotor_spins`: +1 for counter-clockwise seen from above, -1 for clockwise.
    - `cells`: of the battery, in series.
    """

    motors: Sampling | None = None
    gyro: Sampling | None = None
    faster: str = _FASTER
    landed: tuple[tuple[float, float], ...] = ()
    rotor_positions: tuple[tuple[float, float], ...] | None = None
    rotor_spins: tuple[float, ...] | None = None
    cells: int | None = None

    @property
    def too_slow(self) -> str:
        """Why the log was written too rarely to identify a vehicle, and what to do; empty if it was not."""
        every = (("the motors", self.motors), ("the gyro", self.gyro))
        slow = [
            f"{what} {'was' if what == 'the gyro' else 'were'} logged at {sampling.rate:.2g} Hz ({sampling.source})"
            for what, sampling in every
            if sampling is not None and not fast_enough(sampling.rate)
        ]
        if not slow:
            return ""
        return (
            f"{' and '.join(slow)}, too rarely to identify a vehicle: rotors answer within 20 to 80 ms, which needs "
            f"{SLOWEST_RATE:g} Hz or more; {self.faster}"
        )


def fast_enough(rate: float) -> bool:
    """Whether samples at this rate [Hz] identify a vehicle."""
    return rate >= _JITTER * SLOWEST_RATE


def logged_rate(t: Float[np.ndarray, " samples"]) -> float:
    """How often samples at the times `t` [s] were written [Hz]. For half of the time, samples come at least this often.

    A burst of samples does not count as a high rate. Pauses of more than a second do not count, unless there is nothing
    else.
    """
    steps = np.diff(t)
    steps = np.sort(steps[(steps > 0) & (steps <= _PAUSE)] if (steps <= _PAUSE).any() else steps)
    total = np.cumsum(steps)
    if total.size == 0 or total[-1] <= 0:
        return 0.0
    return 1.0 / float(steps[np.searchsorted(total, total[-1] / 2)])


def held_regularly(t: Float[np.ndarray, " changes"]) -> bool:
    """Whether values that change at the times `t` [s] were written at a fixed rate and held in between."""
    steps = np.diff(t)
    if steps.size < _FEWEST_CHANGES:
        return False
    low, middle, high = np.quantile(steps, [0.1, 0.5, 0.9])
    return bool(high - low <= _REGULAR * middle)
