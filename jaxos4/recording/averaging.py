"""A flight averaged to longer samples."""

import numpy as np
from jaxtyping import Float

from ..flight import Flight
from ..logs.resample import UNIFORM, root_mean_square

# Sample times that differ by less than this share are one: as in `join`.
_SAME_STEP = 1e-6
_HALF = 0.45  # of a coarser sample: less of it measured is not measured; the first and the last have half of theirs


def averaged(flight: Flight, dt: float) -> Flight:
    """A flight on a coarser grid of step `dt` [s]: see `average`. Itself where its own step is no finer."""
    if dt <= float(flight.dt) * (1 + _SAME_STEP):
        return flight
    t, omega, channels = (np.asarray(x) for x in (flight.time, flight.omega, flight.channels))
    time, omega, channels = average(t, omega, channels, dt)
    force = None if flight.specific_force is None else channels[:, 12:]
    return Flight(time, omega, channels[:, :12], force, commanded=flight.commanded)


def average(
    t: Float[np.ndarray, " rows"],
    omega: Float[np.ndarray, "rows 4"],
    channels: Float[np.ndarray, "rows channels"],
    dt: float,
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 4"], Float[np.ndarray, "samples channels"]]:
    """Rows on a uniform grid on a coarser one, of step `dt` [s], from their first time on.

    Each measurement becomes the mean over `dt` around its time, so that vibration above the new rate does not fold down
    and no phase is lost; NaN where less than half of that was measured. Rotor speeds become root mean squares over the
    sample that follows, as in `resample`.
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
        told = share > _HALF * dt / own
        even[:, i] = np.where(told, total / np.where(told, share, 1.0), np.nan)
    return grid, root_mean_square(t, omega, grid, dt), even
