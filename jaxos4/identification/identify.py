"""`jaxos4.identify`: from recorded flights to parameters with intervals."""

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..flight import CHANNEL_NAMES
from ..logs import Source, as_recording, as_recordings
from ..models.abstract import AbstractModel
from ..networks import TrainedNetwork
from .answers import channel_fits
from .fit import Fit, fit_case
from .judge import judge
from .prepare import Case, FlightSettings, VehicleSettings, own_settings, prepare_flight
from .problem import Intervals
from .profile import with_profile
from .results import Identification, SampleTime, finite_or_none
from .sample_time import answer_of, fit_at_sample_times
from .vehicle import DEFAULT, prepare_vehicle, with_estimator


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
    progress: Callable[[str], None] = lambda stage: None,
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
    own = subject if isinstance(subject, Airframe) else getattr(subject, "airframe", None)
    recordings = as_recordings(flights, airframe=own)
    if not recordings:
        raise InputError("`flights`: holds no flight; give one.")
    other = None if validate is None else as_recording(validate, "validation flight", own)
    begin = time.perf_counter()
    common = {"estimator": estimator, "bracket": bracket, "network": network, "validate": other}
    sample_times: tuple[SampleTime, ...] = ()
    if isinstance(subject, Airframe):
        wanted = own_settings(VehicleSettings, settings)
        cases = prepare_vehicle(recordings, subject, wanted, **common)
        choose, method = wanted.sample_time is None, estimator or DEFAULT
        case, fit, sample_times = _fit_vehicle(cases, method, choose=choose, seed=seed, progress=progress)
    else:
        asked = own_settings(FlightSettings, settings)
        case = prepare_flight(recordings, subject, asked, seed=seed, progress=progress, **common)
        fit = fit_case(case, progress=progress)
    judged = judge(case, fit, sample_times, progress=progress)
    return describe(case, fit, judged, sample_times, time.perf_counter() - begin)


def _fit_vehicle(
    cases: Sequence[Case],
    estimator: str | AbstractEstimator,
    *,
    choose: bool,
    seed: int,
    progress: Callable[[str], None],
) -> tuple[Case, Fit, tuple[SampleTime, ...]]:
    """The case at the chosen sample time and its fit. `FilterError` is fitted with several sample times."""
    place, case, fit, sample_times = 0, cases[0], None, ()
    is_default = isinstance(estimator, str) and estimator == DEFAULT
    if is_default or len(cases) > 1:
        place, case, fit, sample_times = fit_at_sample_times(cases, choose=choose, progress=progress)
    if fit is None or not is_default:
        case = with_estimator(case, estimator, seed=seed, progress=progress)
        fit = fit_case(case, progress=progress)
    before, fit = fit, with_profile(fit, case, progress=progress)
    # The row of the chosen sample time shows the final answer.
    answer = answer_of(case, fit)
    if fit.searched is not before.searched:  # the other rows have the minimum that was left
        return case, fit, (answer,)
    return case, fit, (*sample_times[:place], answer, *sample_times[place + 1 :])


def describe(
    case: Case, fit: Fit, judged: dict[str, Any], sample_times: tuple[SampleTime, ...], seconds: float
) -> Identification:
    """Everything about an answer, in the fields that pages and files show. `judged`: see `judge`."""
    free = fit.free
    covariance, sigma = np.asarray(fit.estimate.covariance)[np.ix_(free, free)], np.asarray(fit.problem.sigma)
    notes = [*case.provenance.notes, *judged.pop("notes", ())]
    return Identification(
        estimator=case.name,
        model=case.model,
        rollouts=fit.rollouts,
        cost=finite_or_none(fit.estimate.cost),
        seconds=seconds,
        provenance=msgspec.structs.replace(case.provenance, notes=notes),
        covariance=covariance.tolist() if np.isfinite(covariance).all() else None,
        airframe=fit.problem.model.airframe,
        estimate=fit.estimate,
        problem=fit.problem,
        is_vehicle=case.is_vehicle,
        fit={} if fit.diagnostics is None else channel_fits(fit.problem, fit.diagnostics),
        held=fit.held,
        noise={CHANNEL_NAMES[i]: float(sigma[i]) for i in fit.problem.columns},
        disturbances=fit.disturbances,
        widened=fit.widened,
        sample_times=sample_times if len(sample_times) > 1 else (),
        **judged,
    )
