"""The vehicle of a result: its model, its parameters with their covariance, and the noise that the fit found."""

import os
import re
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._custom_types import Parameters
from ..errors import InputError, named, printable, shortened
from ..flight import FORCE_NAMES
from ..identification.results import Identification
from ..linalg import covariance_root
from ..models.flight_model import FlightModel
from ..models.terms import TERMS
from ..result_file import vehicle_result
from ..shooting.gains import LogNoise


class Vehicle(NamedTuple):
    """The vehicle that predicts.

    - `name`: of the result's file. Without a file: the estimator and the model.
    - `model`: of one recording.
    - `parameters`, `covariance`: of the model. The mean of the recordings, if each had its own value.
    - `offset`: how far an offset of p', q', r' may be from the parameter in another recording, as a standard deviation
      [rad/s^2]; 0 if the model has none.
    - `noise`: of the body rates, then of the specific forces along `model.force_axes`.
    - `sample_time`: of the fit [s].
    - `result`: the name of the result code.
    - `notes`: why the estimate cannot be trusted, and which parameters were not identified; one line each.
    """

    name: str
    model: FlightModel
    parameters: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    offset: Float[np.ndarray, "3"]
    noise: LogNoise
    sample_time: float
    result: str
    notes: tuple[str, ...]

    def draw(self, count: int, generator: np.random.Generator) -> Float[np.ndarray, "count parameters"]:
        """Parameters drawn from the estimate's uncertainty."""
        root = covariance_root(self.covariance)
        return self.parameters + generator.standard_normal((count, len(root))) @ root.T


def vehicle_of(found: Identification | str | os.PathLike[str]) -> Vehicle:
    """The vehicle of an identification or a file of `jaxos4 estimate --out`. Raises `InputError` or `OSError`."""
    file = vehicle_result(found)
    given = isinstance(found, Identification)
    name = f"{file.estimator}, {file.model} model" if given else printable(Path(found).name)
    with named("" if given else found):
        used = file.provenance
        if strangers := [term for term in used.terms or () if term not in TERMS]:
            raise InputError(
                f"the term {shortened(strangers[0], 40)} is not of this version; run `jaxos4 estimate` again."
            )
        model = FlightModel(file.airframe, terms=tuple(used.terms or ()), battery_voltage=used.battery_voltage or None)
        known = {row: each.estimate for row, each in file.parameters.items() if each.estimate is not None}
        known |= {row: each.value for row, each in file.held.items()}
        alpha, half_width = (np.asarray(each).tolist() for each in _bracket(model))
        center, width = (dict(zip(model.parameter_names, each, strict=True)) for each in (alpha, half_width))
        listed, rows, covariance = [*file.parameters, *file.held], list(file.parameters), np.array(file.covariance)
        # Each parameter is the mean of its rows: one, or one for each recording.
        shares, values, missing, guessed = np.zeros((len(center), len(rows))), [], [], []
        for place, each in enumerate(center):
            own = [row for row in listed if re.fullmatch(rf"{each}(_\d+)?", row)]
            estimated = [row for row in own if row in known]
            if not own:
                missing.append(each)
            elif not estimated:
                guessed.append(each)
            values.append(np.mean([known[row] for row in estimated]) if estimated else center[each])
            shares[place, [rows.index(row) for row in estimated if row in file.parameters]] = 1 / max(len(estimated), 1)
        if missing:
            raise InputError(f"has no {', '.join(missing)}; run `jaxos4 estimate` again.")
        notes = [f"not identified, and predicted with the centre of the bracket: {', '.join(guessed)}"] * bool(guessed)
        channels = (*"pqr", *(FORCE_NAMES[axis] for axis in model.force_axes))
        if lacking := [each for each in channels if each not in file.disturbances]:
            raise InputError(f"does not say the disturbance of {lacking[0]}; run `jaxos4 estimate` again.")
        levels = [file.disturbances[each] for each in channels]
        table = np.array([(each.strength, each.time_constant, each.sensor) for each in levels])
        return Vehicle(
            name,
            model,
            np.array(values),
            shares @ covariance @ shares.T,
            np.array([width.get(f"{axis}_offset", 0.0) for axis in ("roll", "pitch", "yaw")]),
            LogNoise(*np.log(np.maximum(table, 1e-9)).T),  # finite
            used.sample_time,
            file.result,
            (*file.reasons, *notes),
        )


@eqx.filter_jit
def _bracket(model: FlightModel) -> tuple[Parameters, Parameters]:
    """The centre and the half-width of the default bracket."""
    return model.alpha, model.half_width
