"""A flight as all tools get it: commands or rotor speeds, gyro and vertical accelerometer at one sample time."""

from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter

import jaxos4
from jaxos4.flight import RATES
from jaxos4.recording import Recording

DT = 0.004  # s; faster logs are averaged to it, as jaxos4 does


class Log(NamedTuple):
    """Samples `dt` [s] apart of a vehicle whose airframe is known as well as its user knows it.

    - `omega`: commands that act from a sample on, or measured speeds at it (`commands` is False) [rad/s].
    - `rates`: measured p, q, r [rad/s]. `force`: the measured specific force along z [m/s^2].
    """

    dt: float
    omega: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    commands: bool
    airframe: jaxos4.Airframe

    @classmethod
    def of(cls, flight: Recording, airframe: jaxos4.Airframe, *, commands: bool) -> "Log":
        """The log of a recording. What was not measured in a sample is interpolated."""
        dt = max(DT, float(np.median(np.diff(flight.time))))
        time = flight.time[0] + dt * np.arange(int((flight.time[-1] - flight.time[0]) / dt))
        force = np.asarray(flight.specific_force)[:, 2]
        columns = np.column_stack([flight.omega, np.asarray(flight.states)[:, RATES], force])
        for column in columns.T:
            known = np.isfinite(column)
            column[~known] = np.interp(flight.time[~known], flight.time[known], column[known])
        if len(flight.time) > 1.2 * len(time):
            area = cumulative_trapezoid(columns, flight.time, axis=0, initial=0)
            edges = np.append(time, time[-1] + dt)
            columns = np.diff(_interpolated(edges, flight.time, area), axis=0) / dt
        else:
            columns = _interpolated(time, flight.time, columns)
        return cls(dt, columns[:, :4], columns[:, 4:7], columns[:, 7], commands, airframe)

    @property
    def noise(self) -> np.ndarray:
        """Standard deviations of the noise of p, q, r and the force: of their second differences."""
        second = np.diff(np.column_stack([self.rates, self.force]), 2, axis=0)
        return 1.4826 * np.median(np.abs(second), axis=0) / np.sqrt(6)

    @property
    def thrust_scale(self) -> float:
        """Thrust over squared rotor speed, by the airframe that is given [N s^2/rad^2]."""
        return float(self.airframe.thrust_coefficient)

    def delayed(self, delay: float) -> np.ndarray:
        """Commands, or speeds, that act later."""
        time = self.dt * np.arange(len(self.omega))
        return _interpolated(time - delay, time, self.omega)

    def speeds(self, lag: float, delay: float) -> np.ndarray:
        """Rotor speeds at the samples. Speeds that were measured have no lag."""
        return followed(self.delayed(delay), lag, self.dt) if self.commands else self.delayed(delay)


def followed(wanted: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """First-order systems that follow values which are held from sample to sample."""
    share = np.exp(-dt / max(lag, 1e-4))
    begin = share * wanted[:1]
    late = np.concatenate([wanted[:1], wanted[:-1]])
    return lfilter([1 - share], [1, -share], late, axis=0, zi=begin)[0]


def _interpolated(at: np.ndarray, time: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(at, time, column) for column in columns.T])


class Fit(NamedTuple):
    """Moments of inertia with their standard deviations [kg m^2], and the warnings of the tool."""

    inertia: np.ndarray
    std: np.ndarray
    warnings: list[str]
