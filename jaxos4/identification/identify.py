"""`jaxos4.identify`: from recorded flights to parameters with intervals.

- recordings -> `Data`, with a likelihood: `prepare_os4` in os4.py, or `prepare_vehicle` in vehicle.py. Each makes a
  case, which knows the other steps.
- `Data` -> `Solution`, the data with their `Answer`: `case.solve`, by search.py, uncertainty.py and sample_time.py.
- `Solution` -> `Checked`: `case.check`, by checks.py with quantities.py, doubts.py and verdict.py.
- `Checked` -> `Identification`: `describe`.
"""

import os
import time
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..flight import CHANNEL_NAMES
from ..logs import Source, as_recording, as_recordings
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..networks import TrainedNetwork
from .answers import Solution
from .checks import Checked
from .data import silent
from .os4 import OS4Case, prepare_os4
from .problem import Intervals
from .results import Identification, finite_or_none
from .settings import FlightSettings, VehicleSettings, own_settings
from .vehicle import VehicleCase, prepare_vehicle


def identify(
    flights: Source | Sequence[Source],
    subject: AbstractModel | Airframe,
    *,
    settings: FlightSettings | VehicleSettings | None = None,
    estimator: str | AbstractEstimator | None = None,
    bracket: Intervals = None,
    network: TrainedNetwork | str | os.PathLike[str] | None = None,
    validate: Source | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = silent,
) -> Identification:
    """Identify an OS4 model from one flight, or a real vehicle from one or several recordings.

        found = jaxos4.identify("flight.csv", jaxos4.load_airframe("mine.toml"))
        print(found.summary())

    The noise levels of the sensors are estimated too. `jaxos4 estimate` calls this function.

    **Arguments:**

    - `flights`: the path of a log, a `Flight`, a `Recording` (a flight with a name), or several for a vehicle.
    - `subject`: a model in alpha_1..8, such as `PublishedOS4()`, or the `Airframe` of a real vehicle.
    - `settings`: how to look at the flights: `FlightSettings` for a model, `VehicleSettings` for an airframe.
    - `estimator`: a name in `jaxos4.estimators.ESTIMATORS`, or an estimator. By default `"ibss"` for a model, and
      `"filter-error"` for a vehicle, which flies in closed loop. Others for a vehicle search the same likelihood,
      for example `"ibss"`.
    - `bracket`: a `Bracket`, or `[lower, upper]` by parameter name; the model's default for all others.
    - `network`: for a model, a trained network or its file; without it, an estimator that needs a network trains one.
    - `validate`: another flight or path, which is not fitted but predicted.
    - `seed`: for training a network.
    - `progress`: called with the name of each stage.

    **Returns:** an `Identification`. Check its `result`.

    **Raises:** `InputError` for unusable arguments or flights; `TrainingError` if a network cannot be trained.
    """
    if not isinstance(subject, Airframe) and getattr(subject, "parameter_names", None) != PARAMETER_NAMES:
        kinds = "a model in alpha_1..8 or an airframe, which `jaxos4.load_airframe` reads"
        raise InputError(f"`subject`: must be {kinds}, got {type(subject).__name__}.")
    given = subject if isinstance(subject, Airframe) else subject.airframe
    recordings = as_recordings(flights, airframe=given)
    if not recordings:
        raise InputError("`flights`: holds no flight; give one.")
    other = None if validate is None else as_recording(validate, "validation flight", given)
    begin = time.perf_counter()
    options = {"estimator": estimator, "bracket": bracket, "network": network, "validate": other, "seed": seed}
    progress("checking and averaging")
    if isinstance(subject, Airframe):
        case = prepare_vehicle(recordings, subject, own_settings(VehicleSettings, settings), **options)
    else:
        os4_settings = own_settings(FlightSettings, settings)
        case = prepare_os4(recordings, subject, os4_settings, progress=progress, **options)
    solution = case.solve(progress)
    checked = case.check(solution, progress)
    return describe(case, solution, checked, time.perf_counter() - begin)


def describe(case: OS4Case | VehicleCase, solution: Solution, checked: Checked, seconds: float = 0.0) -> Identification:
    """Everything about an answer, in the fields that pages and files show. `seconds`: the time that it took [s]."""
    (data, answer, sample_times), free = solution, solution.answer.free
    covariance = np.asarray(answer.estimate.covariance)[np.ix_(free, free)]
    sigma, fields = np.asarray(answer.problem.sigma), checked._asdict()
    notes = fields.pop("notes")
    return Identification(
        estimator=case.name,
        model=case.model,
        rollouts=answer.rollouts,
        cost=finite_or_none(answer.estimate.cost),
        seconds=seconds,
        provenance=msgspec.structs.replace(data.provenance, notes=[*data.provenance.notes, *notes]),
        covariance=covariance.tolist() if np.isfinite(covariance).all() else None,
        airframe=answer.problem.model.airframe,
        estimate=answer.estimate,
        problem=answer.problem,
        is_vehicle=case.is_vehicle,
        held=answer.fixed,
        noise={CHANNEL_NAMES[i]: float(sigma[i]) for i in answer.problem.columns},
        disturbances=answer.disturbances,
        widened=answer.widened,
        sample_times=sample_times if len(sample_times) > 1 else (),
        **fields,
    )
