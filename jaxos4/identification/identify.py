"""`jaxos4.identify`: from recorded flights to parameters with intervals.

- recordings -> `Data`, with a likelihood: `prepare_os4` in os4.py, or `prepare_vehicle` in vehicle.py. Each makes a
  case, which knows the other steps.
- `Data` -> `Solution`, the data with their `Answer`: `case.solve`, by search.py, uncertainty.py and sample_time.py.
- `Solution` -> `Identification`: `case.check`, by checks.py with quantities.py, doubts.py and verdict.py.
"""

import os
import time
from collections.abc import Callable, Sequence

import msgspec

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..logs import Source, as_recording, as_recordings
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..networks import TrainedNetwork
from .data import silent
from .os4 import prepare_os4
from .problem import Intervals
from .results import Identification
from .settings import FlightSettings, VehicleSettings, own_settings
from .vehicle import prepare_vehicle


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
    found = case.check(case.solve(progress), progress)
    return msgspec.structs.replace(found, seconds=time.perf_counter() - begin)
