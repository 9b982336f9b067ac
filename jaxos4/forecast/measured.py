"""The measurements of a flight, with the attitude as a quaternion; and the simple predictions for comparison."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..flight import ANGLES, POSITION, RATES, STATE_NAMES, VELOCITY, Flight
from ..recording.sensor_errors import white_noise
from ..rotations import attitude_quaternion, conjugate, quaternion_product, rotated
from .flight_prediction import known_mean
from .motion import PARTS, departures


class Measured(NamedTuple):
    """The measurements of a flight. NaN: not measured.

    - `states`: see `jaxos4.forecast.motion.PARTS`.
    - `force`: specific force [m/s^2].
    - `omega`: rotor speeds or commands [rad/s]. `stretch`: the number of each sample's stretch. `dt`: sample time [s].
    - `noise`: standard deviation of the white noise of position, velocity, attitude and rates; 0 if not measured.
    """

    states: Float[np.ndarray, "samples 13"]
    force: Float[np.ndarray, "samples 3"]
    omega: Float[np.ndarray, "samples 4"]
    stretch: Int[np.ndarray, " samples"]
    dt: float
    noise: Float[np.ndarray, "12"]

    @classmethod
    def of(cls, flight: Flight) -> "Measured":
        """The measurements of a flight."""
        recorded = np.asarray(flight.states)
        position, velocity, angles, rates = (recorded[:, places] for places in (POSITION, VELOCITY, ANGLES, RATES))
        attitude = np.stack(attitude_quaternion(angles), axis=1)
        columns = np.concatenate([position, velocity, angles, rates], axis=1).T
        noise = np.nan_to_num([white_noise(column, 4) for column in columns])
        states = np.concatenate([position, velocity, attitude, rates], axis=1)
        force = flight.recorded[:, len(STATE_NAMES) :]
        return cls(states, force, np.asarray(flight.omega), np.asarray(flight.stretch_numbers), float(flight.dt), noise)

    def accelerations(self, gravity: float) -> Float[np.ndarray, "samples 6"]:
        """From each sample to the next: p', q', r' [rad/s^2], and the specific force that velocity implies [m/s^2]."""
        change = np.diff(self.states, axis=0) / self.dt
        change[np.diff(self.stretch) != 0] = np.nan
        force = rotated(conjugate(self.states[:-1, 6:10].T), tuple((change[:, 3:6] + [0.0, 0.0, gravity]).T))
        return np.pad(np.hstack([change[:, 10:], np.stack(force, 1)]), ((0, 1), (0, 0)), constant_values=np.nan)

    def has(self, part: str) -> bool:
        """Whether all components of a part of the state were measured at some time."""
        return bool(np.isfinite(self.states[:, PARTS[part]]).any(axis=0).all())

    @property
    def first_half(self) -> "Measured":
        """The first half of the samples."""
        half = slice(len(self.stretch) // 2)
        parts = {name: getattr(self, name)[half] for name in ("states", "force", "omega", "stretch")}
        return self._replace(**parts)

    def contradictions(
        self, start: Int[np.ndarray, " starts"], steps: int, gravity: float
    ) -> Float[np.ndarray, "steps 9"]:
        """How far position, velocity and attitude are from dead reckoning with gyro and accelerometer, without a model.

        Sensors contradict each other by noise of any colour, or by shifted clocks; the accelerometer's mean error does
        not count.

        **Returns:** the standard deviation after each step, less the part that the white noise of gyro and
        accelerometer causes. It is at least the noise of start and end together, and equal to it for fewer than ten
        starts.
        """
        rows, dt, down = start[:, None] + np.arange(steps + 1), self.dt, np.array([0.0, 0.0, gravity])
        begin, rates = self.states[start], self.states[rows[:, 1:], 10:]
        turning = _moved(begin, rates, np.zeros_like(rates), dt)[..., 6:10]
        attitude = np.moveaxis(np.concatenate([begin[:, None, 6:10], turning], axis=1), -1, 0)
        force = self.force + known_mean(self.accelerations(gravity)[:, 3:] - self.force)
        push = np.stack(rotated(attitude, tuple(np.moveaxis(force[rows], -1, 0))), axis=-1) - down
        velocity = begin[:, None, 3:6] + dt * np.cumsum((push[:, 1:] + push[:, :-1]) / 2, axis=1)
        reckoned = _moved(begin, rates, velocity, dt)
        departed = np.abs(departures(reckoned, self.states[rows[:, 1:]]))[..., :9]
        one_sigma = 0.6827  # the share of a Gaussian within one standard deviation
        enough = np.isfinite(departed).sum(axis=0) >= 10
        size = np.nanquantile(np.where(enough, departed, 0.0), one_sigma, axis=0)
        seconds, white = dt * np.arange(1, steps + 1)[:, None], np.nan_to_num([white_noise(x, 4) for x in self.force.T])
        jerky, gyro = white**2 * dt * seconds, self.noise[9:] ** 2 * dt * seconds
        known = np.concatenate([jerky * seconds**2 / 3, jerky, gyro], axis=1)
        least = np.repeat(2 * self.noise[None, :9] ** 2, steps, axis=0)
        least[:, :3] += (self.noise[3:6] * seconds) ** 2
        return np.sqrt(np.maximum(size**2 - known, least))


def constant_rates(
    begin: Float[np.ndarray, "starts 13"], steps: int, dt: float
) -> Float[np.ndarray, "starts steps 13"]:
    """The states if velocity and body rates stay as they were measured."""
    return _moved(begin, np.repeat(begin[:, None, 10:], steps, 1), np.repeat(begin[:, None, 3:6], steps, 1), dt)


def regressed(
    trained: Measured,
    begin: Float[np.ndarray, "starts 13"],
    omega: Float[np.ndarray, "starts steps 4"],
    dt: float,
    gravity: float,
) -> Float[np.ndarray, "starts steps 13"] | None:
    """The states by a regression, one step after another; `None` if the flight `trained` measured too little.

    It is linear in rates, velocity and squared rotor speeds. A velocity that was not measured stays constant.
    """
    moves = trained.has("velocity")
    features, targets = _features(trained.states, trained.omega, moves), trained.accelerations(gravity)
    targets = targets if moves else targets[:, :3]
    usable = np.isfinite(features).all(axis=1) & np.isfinite(targets).all(axis=1)
    if usable.sum() <= features.shape[1]:
        return None
    scale = np.maximum(np.abs(features[usable]).max(axis=0), 1e-12)
    weights = np.linalg.lstsq(features[usable] / scale, targets[usable])[0]
    states, now = [], begin
    for speeds in np.moveaxis(omega, 1, 0):
        found = (_features(now, speeds, moves) / scale) @ weights
        rate, velocity = np.clip(now[:, 10:] + dt * found[:, :3], -1e3, 1e3), now[:, 3:6]
        if moves:
            push = np.stack(rotated(now[:, 6:10].T, tuple(found[:, 3:].T)), axis=1)
            velocity = velocity + dt * (push - [0.0, 0.0, gravity])
        now = _moved(now, rate[:, None], velocity[:, None], dt)[:, 0]
        states.append(now)
    return np.stack(states, axis=1)


def _features(states: np.ndarray, omega: np.ndarray, moves: bool) -> np.ndarray:
    rates, one = states[:, 10:], np.ones((len(states), 1))
    velocity = [np.stack(rotated(conjugate(states[:, 6:10].T), tuple(states[:, 3:6].T)), axis=1)] if moves else []
    return np.concatenate([one, rates, *velocity, omega**2], axis=1)


def _moved(
    begin: Float[np.ndarray, "starts 13"],
    rates: Float[np.ndarray, "starts steps 3"],
    velocity: Float[np.ndarray, "starts steps 3"],
    dt: float,
) -> Float[np.ndarray, "starts steps 13"]:
    """The states with these rates and velocities, which change linearly over a step."""

    def means(first: np.ndarray, rest: np.ndarray) -> np.ndarray:
        whole = np.concatenate([first[:, None], rest], axis=1)
        return (whole[:, 1:] + whole[:, :-1]) / 2

    position = begin[:, None, :3] + dt * np.cumsum(means(begin[:, 3:6], velocity), axis=1)
    turns, attitude, attitudes = dt * means(begin[:, 10:], rates), tuple(begin[:, 6:10].T), []
    for turn in np.moveaxis(turns, 1, 0):
        angle = np.linalg.norm(turn, axis=1)
        axis = turn * (np.sinc(angle / (2 * np.pi)) / 2)[:, None]
        attitude = quaternion_product(attitude, (np.cos(angle / 2), *axis.T))
        attitudes.append(np.stack(attitude, axis=1))
    return np.concatenate([position, velocity, np.stack(attitudes, axis=1), rates], axis=2)
