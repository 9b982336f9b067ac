"""`jaxos4.identify`: from recorded flights to parameters with intervals, in one call."""

import os
from collections.abc import Callable, Sequence
from typing import Any

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..flight import Flight
from ..models import MODELS
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..networks import TrainedNetwork
from ..recording.reading import Recording, as_recordings
from .flight import identify_flight
from .problem import Intervals
from .provenance import class_name
from .results import FlightIdentification, VehicleIdentification

Flights = Flight | Recording | Sequence[Flight | Recording]


def identify(
    flights: Flights,
    subject: AbstractModel | Airframe,
    *,
    estimator: str | AbstractEstimator | None = None,
    bracket: Intervals = None,
    channels: str | None = None,
    initial_state: str = "free",
    window: float | None = None,
    network: TrainedNetwork | str | os.PathLike[str] | None = None,
    terms: Sequence[str] | None = None,
    begin: float | None = None,
    end: float | None = None,
    sample_time: float | None = None,
    holdout: float | None = None,
    loss: str | None = None,
    validate: Flight | Recording | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda stage: None,
) -> FlightIdentification | VehicleIdentification:
    """Identify an OS4 model from one flight, or a real vehicle from one or several recordings.

        found = jaxos4.identify(flight, jaxos4.PublishedOS4())
        found.parameters["alpha3"].ci95

    The noise levels of the sensors are estimated too. `jaxos4 estimate` calls this function.

    **Arguments:**

    - `flights`: a `Flight`, a `Recording` (a flight with a name), or several for a vehicle.
    - `subject`: a model in alpha_1..8, such as `PublishedOS4()`, or the `Airframe` of a real vehicle.
    - `estimator`: a name in `jaxos4.estimators.ESTIMATORS`, or an estimator. By default `"ibss"` for a model, and
      `"filter-error"` for a vehicle, which flies in closed loop. The others for a vehicle are those that shoot.
    - `bracket`: a `Bracket`, or `[lower, upper]` by parameter name; the model's default for all others.
    - `window`: length of the windows for multiple shooting [s]; by default none for a model, 0.25 s for a vehicle.
    - `validate`: another flight, which is not fitted but predicted.
    - `seed`: for training a network.
    - `progress`: called with the name of each stage.

    For a model:

    - `channels`: `"rates"`, `"attitude"` or `"all"`: what is compared; by default everything that was measured.
    - `initial_state`: `"free"`: estimated too; `"known"`: the first sample is exact.
    - `network`: a trained network or its file; without it, an estimator that needs a network trains one.

    For an airframe:

    - `terms`: of `jaxos4.TERMS`; by default those that the recordings allow.
    - `begin`, `end`: use this part of each recording [s]; by default its usable stretches.
    - `sample_time`: average to samples of this length [s]; by default 0.004 s if the recordings have shorter ones.
    - `holdout`: share of the flight that is held out and predicted, 0 to 0.5; by default 0.25, or 0 with `validate`.
    - `loss`: of an estimator that shoots: `"huber"` cuts outliers, `"squares"` does not; by default `"huber"`.

    **Returns:** a `FlightIdentification` for a model, a `VehicleIdentification` for an airframe. Check `result`.

    **Raises:** `InputError` for unusable arguments or flights; `TrainingError` if a network cannot be trained.
    """
    recordings = as_recordings(flights)
    if not recordings:
        raise InputError("`flights`: holds no flight; give one.")
    other = None if validate is None else as_recordings(validate, "validation flight")[0]
    common = {"estimator": estimator, "bracket": bracket, "window": window, "seed": seed, "progress": progress}
    of_model = {"channels": channels, "network": network}
    of_vehicle = {"terms": terms, "begin": begin, "end": end, "sample_time": sample_time}
    of_vehicle |= {"holdout": holdout, "loss": loss}
    if isinstance(subject, Airframe):
        _refuse(of_model, "a vehicle is identified from its rates and specific force, and trains its own network")
        if initial_state != "free":
            raise InputError(f"`initial_state` {initial_state}: each window has its own initial state; leave it out.")
        from .recordings import identify_vehicle  # slow to import

        return identify_vehicle(recordings, subject, validate=other, **of_vehicle, **common)
    _check_model(subject, recordings, of_vehicle)
    common["estimator"] = "ibss" if estimator is None else estimator
    return identify_flight(recordings[0], subject, initial_state=initial_state, validate=other, **of_model, **common)


def _check_model(subject: AbstractModel, recordings: Sequence[Recording], of_vehicle: dict[str, Any]) -> None:
    if getattr(subject, "parameter_names", None) != PARAMETER_NAMES:
        raise InputError(f"`subject`: must be a model in alpha_1..8 or an airframe, got {type(subject).__name__}.")
    name = class_name(subject, MODELS)
    _refuse(of_vehicle, f"is for an `Airframe` as `subject`, not for the {name} model")
    if len(recordings) > 1:
        raise InputError(
            f"{recordings[1].name}: `subject` {name} explains one flight; use an `Airframe` as `subject` for several."
        )


def _refuse(options: dict[str, Any], why: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"`{name}`: {why}; leave it out.")
