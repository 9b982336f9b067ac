"""A prediction of a flight: its states and band, what was measured, simple predictions, and how they compare."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._custom_types import finite_or_none
from .._files import write_atomically, write_netcdf
from .._version import __version__
from ..errors import InputError
from ..flight import ANGLES, POSITION, RATES, STATE_NAMES, VELOCITY, Flight
from ..recording.sensor_errors import white_noise
from ..rotations import attitude_quaternion, conjugate, quaternion_product, rotated
from .motion import PARTS, departures

if TYPE_CHECKING:
    import xarray as xr

QUANTITIES: dict[str, tuple[str, list[int]]] = {
    "position": ("m", [0, 1, 2]),
    "velocity": ("m/s", [3, 4, 5]),
    "attitude": ("rad", [6, 7, 8]),
    "rates": ("rad/s", [9, 10, 11]),
    "p": ("rad/s", [9]),
    "q": ("rad/s", [10]),
    "r": ("rad/s", [11]),
}
"""The compared quantities: the unit, and the components of an error."""

_AXES = {"attitude": ("component", ["w", "x", "y", "z"]), "rates": ("rate", ["p", "q", "r"])}


class Quality(NamedTuple):
    """The mean absolute error of one quantity by horizon, in its unit, over all starts. NaN: nothing was measured.

    - `error`: the length of the error's vector, of the attitude the angle. `unaware`: without the disturbance at the
      start.
    - `constant`: if velocity and body rates stay constant. `regression`: of the regression; NaN if there is none.
    - `coverage`: the share of measured components inside the 95 % band.
    """

    error: Float[np.ndarray, " horizons"]
    unaware: Float[np.ndarray, " horizons"]
    constant: Float[np.ndarray, " horizons"]
    regression: Float[np.ndarray, " horizons"]
    coverage: Float[np.ndarray, " horizons"]

    @property
    def sums(self) -> dict[str, float]:
        """The sum of each error over all horizons."""
        return {name: float(getattr(self, name).sum()) for name in self._fields[:-1]}


class FlightPrediction(NamedTuple):
    """Predictions of a flight from many starts, open loop, with the recorded rotor speeds. Made by `jaxos4.predict`.

    States are arrays of 13: position [m] and velocity [m/s] in the earth frame, the attitude as the quaternion w, x, y,
    z from body to earth, body rates [rad/s]. NaN: not measured.

    - `found`, `flight`: names of the result and of the flight.
    - `time`: time of each start in the log [s]. `horizons`: time from the start to the prediction [s].
    - `begin`: the state at the start.
    - `predicted`: with the disturbance at the start that the filters know. `unaware`: without.
    - `half_width`: half the width of the 95 % band of measurements: position, velocity, attitude as a small rotation
      about the body's axes [rad], rates.
    - `measured`: the states at each horizon.
    - `constant`, `regression`: the states by simple predictions. `None`: the flight says too little for a regression.
    - `missing`: the quantities that were not measured, and are not compared.
    - `seed`: random seed of the band's draws. `notes`: on the result and the data.
    """

    found: str
    flight: str
    time: Float[np.ndarray, " starts"]
    horizons: Float[np.ndarray, " horizons"]
    begin: Float[np.ndarray, "starts 13"]
    predicted: Float[np.ndarray, "starts horizons 13"]
    unaware: Float[np.ndarray, "starts horizons 13"]
    half_width: Float[np.ndarray, "starts horizons 12"]
    measured: Float[np.ndarray, "starts horizons 13"]
    constant: Float[np.ndarray, "starts horizons 13"]
    regression: Float[np.ndarray, "starts horizons 13"] | None
    missing: tuple[str, ...]
    seed: int
    notes: tuple[str, ...]

    @property
    def quality(self) -> dict[str, Quality]:
        """The errors of each measured quantity."""
        every = (self.predicted, self.unaware, self.constant, self.regression)
        off = [departures(np.full_like(self.measured, np.nan) if x is None else x, self.measured) for x in every]
        inside = np.where(np.isfinite(off[0]), np.abs(off[0]) <= self.half_width, np.nan)

        def mean(departed: np.ndarray, name: str) -> np.ndarray:
            length = np.linalg.norm(departed[..., QUANTITIES[name][1]], axis=-1)
            return known_mean(2 * np.arcsin(np.minimum(length / 2, 1.0)) if name == "attitude" else length)

        return {
            name: Quality(*(mean(x, name) for x in off), coverage=known_mean(inside)[..., columns].mean(axis=-1))
            for name, (_, columns) in QUANTITIES.items()
            if name not in self.missing
        }

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings: what `jaxos4 predict --json` writes."""
        quantities = {
            name: {"unit": QUANTITIES[name][0]}
            | {field: [finite_or_none(x) for x in values] for field, values in quality._asdict().items()}
            | {"sum": {field: finite_or_none(x) for field, x in quality.sums.items()}}
            for name, quality in self.quality.items()
        }
        return {
            "found": self.found,
            "flight": self.flight,
            "starts": self.time.size,
            "horizons": self.horizons.tolist(),
            "quantities": quantities,
            "missing": list(self.missing),
            "notes": list(self.notes),
            "seed": self.seed,
            "version": __version__,
        }

    def to_dataset(self) -> "xr.Dataset":
        """The predictions as an xarray Dataset. A quantity that was not measured is left out."""
        import xarray as xr

        coordinates: dict[str, Any]
        variables, both = {}, ("start", "horizon")
        coordinates = {"start": ("start", self.time, {"units": "s"}), "axis": ["x", "y", "z"]}
        coordinates |= {"horizon": ("horizon", self.horizons, {"units": "s"})}
        for name, places in PARTS.items():
            if name in self.missing:
                continue
            unit, errors = QUANTITIES[name]
            axis, labels = _AXES.get(name, ("axis", ["x", "y", "z"]))
            rows = {"": self.predicted, "_unaware": self.unaware, "_measured": self.measured}
            for suffix, states in rows.items():
                unit_of = "1" if name == "attitude" else unit
                variables[name + suffix] = ((*both, axis), states[..., places], {"units": unit_of})
            across = axis if name != "attitude" else "axis"
            variables[f"{name}_half_width"] = ((*both, across), self.half_width[..., errors], {"units": unit})
            coordinates[axis] = labels
        about = {"found": self.found, "flight": self.flight, "seed": self.seed, "version": __version__}
        return xr.Dataset(variables, coords=coordinates, attrs=about | {"notes": "\n".join(self.notes)})

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write netCDF (`.nc`) or CSV (`.csv`), a row for each start and horizon. Raises `InputError` or `OSError`."""
        check_suffix(path, ".nc", ".csv")
        if Path(path).suffix == ".nc":
            write_netcdf(path, self.to_dataset(), 1)
            return
        names, columns = zip(*self._columns(), strict=True)
        with write_atomically(path) as beside, beside.open("w", encoding="utf-8") as file:
            file.write(",".join(names) + "\n")
            for row in np.stack(columns, axis=1).tolist():
                file.write(",".join("" if x != x else f"{x:.9g}" for x in row) + "\n")

    def _columns(self) -> Iterator[tuple[str, np.ndarray]]:
        """The columns of the CSV."""
        shape = self.predicted.shape[:2]
        yield "t", np.broadcast_to(self.time[:, None], shape).ravel()
        yield "horizon", np.broadcast_to(self.horizons, shape).ravel()
        names = "x y z vx vy vz qw qx qy qz p q r".split()
        kept = [i for name, places in PARTS.items() if name not in self.missing for i in places]
        for suffix, states in (("", self.predicted), ("_measured", self.measured)):
            yield from ((names[i] + suffix, states[..., i].ravel()) for i in kept)
        names = "x y z vx vy vz turn_x turn_y turn_z p q r".split()
        kept = [i for name in PARTS if name not in self.missing for i in QUANTITIES[name][1]]
        yield from ((f"{names[i]}_half_width", self.half_width[..., i].ravel()) for i in kept)


def check_suffix(path: str | os.PathLike[str], *suffixes: str) -> None:
    """Refuse a file whose name does not end with one of the suffixes."""
    if Path(path).suffix not in suffixes:
        raise InputError(f"{path}: the name says the format; give one that ends with {' or '.join(suffixes)}.")


def known_mean(values: Float[np.ndarray, "starts *rest"]) -> Float[np.ndarray, "*rest"]:
    """The mean over the starts of what was measured; NaN if nothing was."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


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
        self, start: Int[np.ndarray, " starts"], steps: int, gravity: float, *, fewest: int = 10
    ) -> Float[np.ndarray, "steps 9"]:
        """How far position, velocity and attitude are from dead reckoning with gyro and accelerometer, without a model.

        Sensors contradict each other by noise of any colour, or by shifted clocks; the accelerometer's mean error does
        not count.

        **Returns:** the standard deviation after each step, less the part that the white noise of gyro and
        accelerometer causes. It is at least the noise of start and end together, and equal to it for fewer than
        `fewest` starts.
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
        enough = np.isfinite(departed).sum(axis=0) >= fewest
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
