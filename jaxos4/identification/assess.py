"""`jaxos4.assess`: which parameters a flight of an OS4 can identify."""

from typing import Any

import msgspec
import numpy as np

from .._custom_types import finite_or_none
from ..analysis.evaluation import Identifiability, evaluate, identifiability
from ..estimators import IBSS
from ..flight import STATE_NAMES
from ..logs import Source, as_recording
from ..models.abstract import AbstractModel
from .data import Progress, silent
from .fit import fit_os4
from .prepare_os4 import Intervals, OS4Settings, bracket_of, os4_problem


class ParameterInformation(msgspec.Struct, frozen=True):
    """The information of a flight about one parameter.

    - `bound`: the Cramer-Rao bound at the estimated noise levels, as a standard deviation; `None`: infinite.
    - `others_known`: the same bound if all other parameters were known.
    - `half_width`: half-width of the bracket.
    - `noise_limit`: the airframe's value could be distinguished from 0 up to this multiple of the noise.
    - `unit`: the unit of the first three fields.
    - `note`: why the parameter is not identifiable, or an empty string.
    """

    bound: float | None
    others_known: float | None
    half_width: float
    noise_limit: float | None
    unit: str
    note: str


class FlightInformation(msgspec.Struct, frozen=True, eq=False):
    """The parameters that one flight can identify. Made by `jaxos4.assess`.

    - `flight`: its name.
    - `fitted`: whether the model could be fitted; otherwise all numbers hold at the bracket's centre.
    - `sigma`: the estimated noise levels, by channel.
    - `parameters`: by name.
    - `identifiability`: the same as arrays.
    """

    flight: str
    fitted: bool
    sigma: dict[str, float]
    parameters: dict[str, ParameterInformation]
    identifiability: Identifiability

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, which `jaxos4 identifiability` writes as JSON.

        `eigenvalues`, `directions`: see `jaxos4.Identifiability`; a direction is a row. `None` without a trajectory.
        """
        fields = msgspec.structs.asdict(self)
        known = fields.pop("identifiability")
        axes = {"eigenvalues": known.eigenvalues.tolist(), "directions": known.directions.T.tolist()}
        axes = axes if np.isfinite(known.std).all() else dict.fromkeys(axes)
        return msgspec.to_builtins(fields | axes)


def assess(
    flight: Source,
    model: AbstractModel,
    *,
    bracket: Intervals = None,
    channels: str | None = None,
    initial_state: str = "free",
    window: float | None = None,
    progress: Progress = silent,
) -> FlightInformation:
    """Estimate a flight's noise levels, and find the parameters that it can identify. Arguments as in `identify`.

    **Raises:** `InputError`, one line, for arguments and flights that cannot be used.
    """
    recording = as_recording(flight, airframe=model.airframe)
    where = bracket_of(bracket, model)
    settings = OS4Settings(channels=channels, initial_state=initial_state, window=window)
    problem = os4_problem(recording, model, where, settings)
    answer = fit_os4(IBSS(), problem, progress=progress)
    known = identifiability(answer.evaluation or evaluate(answer.problem, answer.estimate.parameters), where)
    notes = known.notes(model.parameter_names)
    return FlightInformation(
        flight=recording.name,
        fitted=answer.answered,
        sigma=dict(zip(STATE_NAMES, answer.problem.sigma.tolist(), strict=True)),
        parameters={
            name: ParameterInformation(
                bound=finite_or_none(known.std[i]),
                others_known=finite_or_none(known.std_alone[i]),
                half_width=float(known.half_width[i]),
                noise_limit=finite_or_none(known.noise_limit[i]) if np.isfinite(known.std[i]) else None,
                unit=model.parameter_units[i],
                note=notes.get(name, ""),
            )
            for i, name in enumerate(model.parameter_names)
        },
        identifiability=known,
    )
