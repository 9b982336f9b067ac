"""Signals over time that a result keeps of its flights, so that its page can be drawn again."""

import msgspec
import numpy as np
from jaxtyping import Float, Int

from .._custom_types import Arrays
from ..flight import POSITION
from ..models.state import CASCADE_ORDER
from .evaluation import Evaluation
from .frequency_response import significant


class Traces(Arrays, frozen=True, eq=False):
    """Signals of the fitted flights. Channels are in cascade order: p, q, r, phi, theta, psi, then x, vx, y, vy, z, vz.

    - `time`, `log`: of each sample, its time in its log [s] and the number of its log.
    - `rotors`: speeds [rad/s], or commands in the same unit.
    - `measured`: NaN: not measured, or not fitted. `predicted`: simulated; an OS4's only.
    - `disturbance`: what acts on each body rate besides the model [rad/s^2]; a vehicle's only.
    - `position`: measured [m], if it was.
    - `start_time`, `start_log`: the same as `time` and `log` for each start of the `Predictions`.
    """

    time: Float[np.ndarray, " samples"]
    log: Int[np.ndarray, " samples"]
    rotors: Float[np.ndarray, "samples 4"]
    measured: Float[np.ndarray, "samples channels"]
    predicted: Float[np.ndarray, "samples simulated"]
    disturbance: Float[np.ndarray, "samples disturbed"]
    position: Float[np.ndarray, "samples axes"]
    start_time: Float[np.ndarray, " starts"]
    start_log: Int[np.ndarray, " starts"]

    def thinned(self, most: int = 1200, *, digits: int = 5) -> "Traces":
        """At most `most` samples, each the first finite value of its block, with this many significant `digits`."""
        every = -(-self.time.size // most)
        blocks = np.arange(self.time.size) // every
        apart = self.log != self.log[::every][blocks]  # a block has the values of one log
        fewer = {"log": self.log[::every]}
        for name, values in msgspec.structs.asdict(self).items():
            if values.ndim == 2:
                rows = ((0, -len(values) % every), (0, 0))  # the last block may be shorter
                padded = np.pad(np.where(apart[:, None], np.nan, values), rows, constant_values=np.nan)
                cut = padded.reshape(len(padded) // every, every, values.shape[1])
                known = np.isfinite(cut)
                first = np.take_along_axis(cut, known.argmax(axis=1)[:, None], axis=1)[:, 0]
                fewer[name] = significant(np.where(known.any(axis=1), first, np.nan), digits)
        times = {"time": self.time[::every].round(digits), "start_time": self.start_time.round(digits)}
        return msgspec.structs.replace(self, **fewer | times)


def os4_traces(found: Evaluation) -> Traces:
    """The traces of a flight that was simulated at an answer."""
    flight, size = found.problem.flight, found.problem.size
    time, omega = np.asarray(flight.time, float), np.asarray(flight.omega, float)
    states, none = np.asarray(flight.states, float), np.zeros((time.size, 0))
    log = np.zeros(time.size, int)
    measured = states[:, CASCADE_ORDER[:size]]
    predicted = found.predicted[:, :size]
    return Traces(time, log, omega, measured, predicted, none, position_of(states), time[:0], log[:0]).thinned()


def position_of(states: Float[np.ndarray, "samples 12"]) -> Float[np.ndarray, "samples axes"]:
    """The measured positions, or nothing if there are none."""
    position = states[:, POSITION]
    return position if np.isfinite(position).all(axis=1).any() else position[:, :0]
