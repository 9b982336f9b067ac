"""A flight averaged to longer samples."""

import numpy as np
from jaxtyping import Float

from ..flight import Flight
from ..logs.resample import UNIFORM, root_mean_square

# Sample times that differ by less than this share are equal.
_EQUAL_STEPS = 1e-6
# A longer sample needs this share measured. Below one half, because the first and the last have half of their rows.
_MEASURED = 0.45


def averaged(flight: Flight, dt: float) -> Flight:
    """A flight averaged to samples of `dt` [s], see `average`; unchanged if its samples are not shorter."""
    if dt <= float(flight.dt) * (1 + _EQUAL_STEPS):
        return flight
    t, omega, channels = (np.asarray(x) for x in (flight.time, flight.omega, flight.recorded))
    voltage = None if flight.voltage is None else np.asarray(flight.voltage)
    rows = channels if voltage is None else np.column_stack([channels, voltage])
    time, omega, rows = average(t, omega, rows, dt)
    force = None if flight.specific_force is None else rows[:, 12:15]
    voltage = None if voltage is None else rows[:, 15]
    return Flight(time, omega, rows[:, :12], force, commanded=flight.commanded, voltage=voltage)


def average(
    t: Float[np.ndarray, " rows"],
    omega: Float[np.ndarray, "rows 4"],
    channels: Float[np.ndarray, "rows channels"],
    dt: float,
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 4"], Float[np.ndarray, "samples channels"]]:
    """Average uniformly sampled rows to longer samples of `dt` [s], from the first time on.

    Each measurement becomes the mean over `dt` around its time, which removes vibration above the new rate without a
    delay. It is missing (NaN) if less than about half of that time was measured. Each rotor speed becomes the root mean
    square over the sample that follows, as in `resample`. `t`: times [s]; `omega`: rotor speeds [rad/s].
    """
    own = (t[-1] - t[0]) / (t.size - 1)
    grid = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + UNIFORM) + 1)
    edges = np.append(t - own / 2, t[-1] + own / 2)
    ends = np.append(grid - dt / 2, grid[-1] + dt / 2)
    even = np.empty((grid.size, channels.shape[1]))
    for i, channel in enumerate(channels.T):
        measured = np.isfinite(channel)
        sums = np.append(0.0, np.cumsum(np.where(measured, channel, 0.0)))
        total, share = (np.diff(np.interp(ends, edges, x)) for x in (sums, np.append(0.0, np.cumsum(measured))))
        enough = share > _MEASURED * dt / own
        even[:, i] = np.where(enough, total / np.where(enough, share, 1.0), np.nan)
    return grid, root_mean_square(t, omega, grid, dt), even
