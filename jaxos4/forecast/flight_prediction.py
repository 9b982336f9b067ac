"""A prediction of a flight: states, band, errors compared with simple predictions, tables and files."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._custom_types import finite_or_none
from .._files import write_atomically, write_netcdf
from .._version import __version__
from ..errors import InputError
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

        variables, both = {}, ("start", "horizon")
        coordinates: dict[str, Any] = {"start": ("start", self.time, {"units": "s"}), "axis": ["x", "y", "z"]}
        coordinates |= {"horizon": ("horizon", self.horizons, {"units": "s"})}
        for name, places in PARTS.items():
            if name in self.missing:
                continue
            unit, errors = QUANTITIES[name]
            axis, labels = _AXES.get(name, ("axis", ["x", "y", "z"]))
            units = {"units": "1" if name == "attitude" else unit}
            for suffix, states in (("", self.predicted), ("_unaware", self.unaware), ("_measured", self.measured)):
                variables[name + suffix] = ((*both, axis), states[..., places], units)
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
