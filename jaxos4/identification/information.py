"""Which parameters a flight can identify, and why not the others."""

from collections.abc import Callable

import numpy as np

from ..analysis.evaluation import evaluate
from ..analysis.identifiability import identifiability_of
from ..estimators import IBSS
from ..flight import STATE_NAMES, Flight
from ..models.abstract import AbstractModel
from ..recording.reading import Recording, as_recordings
from .fit import fit_flight
from .problem import Intervals, bracket_of, flight_problem
from .results import FlightInformation, ParameterInformation, finite_or_none, has_answer


def assess(
    flight: Flight | Recording,
    model: AbstractModel,
    *,
    bracket: Intervals = None,
    channels: str | None = None,
    initial_state: str = "free",
    window: float | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> FlightInformation:
    """Find the noise levels of a flight, and which parameters it can identify at these. Arguments as of `identify`.

    **Raises:** `InputError`, one line, for arguments and flights that cannot be used.
    """
    (recording,) = as_recordings(flight)
    where = bracket_of(bracket, model)
    settings = {"channels": channels, "initial_state": initial_state, "window": window}
    problem = flight_problem(recording, model, where, **settings)
    fit = fit_flight(IBSS(), problem, progress=progress)
    known = identifiability_of(fit.evaluation or evaluate(fit.problem, fit.estimate.parameters), where)
    names, notes = model.parameter_names, known.notes(model.parameter_names)
    std, alone, half_width, limit = map(np.asarray, (known.std, known.std_alone, known.half_width, known.noise_limit))
    finite = bool(np.isfinite(std).all())
    return FlightInformation(
        flight=recording.name,
        fitted=has_answer(fit.estimate),
        sigma=dict(zip(STATE_NAMES, fit.problem.sigma.tolist(), strict=True)),
        parameters={
            name: ParameterInformation(
                bound=finite_or_none(std[i]),
                others_known=finite_or_none(alone[i]),
                half_width=float(half_width[i]),
                noise_limit=finite_or_none(limit[i]) if np.isfinite(std[i]) else None,
                unit=model.parameter_units[i],
                note=notes.get(name, ""),
            )
            for i, name in enumerate(names)
        },
        eigenvalues=known.eigenvalues.tolist() if finite else None,
        directions=known.directions.T.tolist() if finite else None,
        identifiability=known,
    )
