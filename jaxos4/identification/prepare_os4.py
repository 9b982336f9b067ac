"""From one recorded flight and a model of the OS4 to its data, with the shooting problem that estimators solve."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from .._custom_types import as_float
from ..bracket import Bracket
from ..errors import InputError, check_choice, named, shortened
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS, Hybrid, make_estimator
from ..flight import STATE_NAMES
from ..logs import Recording
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks import NetworkEstimator, TrainedNetwork
from ..networks.estimator import GivenNetwork, network_provenance, seen_channels
from ..networks.file import load_network
from ..noise import SENSOR_SIGMA
from ..recording.checks import KINEMATIC, self_checks
from ..shooting import ShootingProblem, Unknowns
from .data import Data, HeldOut, Provenance, class_name, name_and_class

Intervals = Bracket | Mapping[str, Any] | None
"""A bracket, or `[lower, upper]` by parameter name; the model's default for all others."""

# The states that each choice of channels adds to the one before, in cascade order.
_ADDED = {"rates": slice(0, 3), "attitude": slice(3, 6), "all": slice(6, 12)}


@dataclasses.dataclass(frozen=True)
class OS4Settings:
    """Settings of the identification of an OS4.

    - `channels`: `"rates"`, `"attitude"` or `"all"`: the compared channels; by default everything that was measured.
    - `initial_state`: `"free"`: estimated too; `"known"`: the first sample is exact.
    - `window`: length of the windows for multiple shooting [s]; by default the flight is one window.
    """

    channels: str | None = None
    initial_state: str = "free"
    window: float | None = None


def prepare_os4(
    recordings: Sequence[Recording],
    model: AbstractModel,
    settings: OS4Settings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
) -> tuple[Data[ShootingProblem], str, str | AbstractEstimator]:
    """The data of one flight, and the name and object of its estimator. Arguments as in `identify`.

    The estimator is still a name if its network must be trained first; see `os4_estimator`.
    """
    recording, *others = recordings
    if others:
        raise InputError(
            f"{others[0].name}: the {class_name(model, MODELS)} model explains one flight; several need an airframe "
            "and the model flight."
        )
    estimator = "ibss" if estimator is None else estimator
    name, kind = name_and_class(estimator)
    trained = _given_network(estimator, settings, network)
    if trained is not None and not kind.shoots and bracket is not None:
        raise InputError("`bracket`: a network searches the bracket that it was trained in; leave one of them out.")
    where = bracket_of(bracket, model)
    problem = os4_problem(recording, model, where, settings)
    other = None
    if validate is not None:
        other = os4_problem(validate, model, where, dataclasses.replace(settings, channels=None))
    if _has_own_channels(kind):
        problem = problem.restrict(kind.looks_at)
        if np.isnan(np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]).all(axis=0).any():
            raise InputError(f"{recording.name}: {name} needs p, q and r; use `estimator` output-error.")
    untrained = kind.needs_network and trained is None
    if untrained and not kind.shoots:
        problem = problem.restrict(seen_channels(problem))
    if trained is not None:
        if mismatch := trained.mismatch(problem):
            raise InputError(
                f"`network`: cannot be used on {recording.name}: {mismatch}; train one with `jaxos4 train`."
            )
        if not kind.shoots:
            problem = problem.restrict(trained.channels).within(trained.bracket)
    findings, notes, held_out = [], recording.notes, None
    for found in self_checks(recording, model.airframe, checks=KINEMATIC):
        if found.of_attitude_alone and problem.channels == "rates":
            notes = (*notes, f"{found.cause} ({found.size}); it is not fitted")
        else:
            findings.append(found)
    if validate is not None and other is not None:
        other = other.restrict(problem.channels) if other.size > problem.size else other
        if np.isnan(other.recorded()).all():
            raise InputError(
                f"{validate.name}: nothing was measured among the {problem.channels} channels; give another flight."
            )
        held_out, notes = HeldOut(other, validate.name), notes + validate.named_notes
    provenance = Provenance.of(
        problem,
        notes,
        flight=recording.name,
        channels=problem.channels,
        initial_state=settings.initial_state,
        windows=problem.windows,
        samples=int(problem.flight.time.shape[0]),
        network=msgspec.UNSET if trained is None else network_provenance(network, trained),
    )
    data = Data(problem, problem, provenance, held_out=held_out, findings=tuple(findings))
    if isinstance(estimator, str) and not untrained:
        estimator = make_estimator(name, trained)
    return data, name, estimator


def _given_network(
    estimator: str | AbstractEstimator, settings: OS4Settings, network: GivenNetwork
) -> TrainedNetwork | None:
    """The network that an estimator has or was given. Raises `InputError` for options that do not fit the estimator."""
    name, kind = name_and_class(estimator)
    if network is not None and not kind.needs_network:
        raise InputError(f"`network`: {name} uses none; use `estimator` network or hybrid, or leave it out.")
    if settings.window is not None and not (kind.shoots or kind.needs_network):
        shooting = ", ".join(each for each, other in ESTIMATORS.items() if other.shoots)
        raise InputError(f"`window`: {name} does not shoot; use one of the estimators {shooting}.")
    if settings.window is not None and network is not None:
        raise InputError("`window`: a network of windows serves one flight alone; leave `network` out.")
    if _has_own_channels(kind) and settings.channels not in (None, kind.looks_at):
        raise InputError(
            f"`channels` {settings.channels}: {name} looks at the {kind.looks_at}; use `estimator` output-error."
        )
    if network is not None and not isinstance(estimator, str):
        raise InputError(f"`network`: this {name} estimator has one already; leave it out.")
    trained = estimator.network if isinstance(estimator, Hybrid) else estimator
    if isinstance(trained, TrainedNetwork):
        return trained
    return network if network is None or isinstance(network, TrainedNetwork) else load_network(network)


def _has_own_channels(kind: type[AbstractEstimator]) -> bool:
    return kind.looks_at != "all" and not kind.needs_network


def bracket_of(bracket: Intervals, model: AbstractModel) -> Bracket:
    """The bracket of a model's parameters. Raises `InputError` for unknown parameters and impossible intervals."""
    names = model.parameter_names
    if isinstance(bracket, Bracket):
        if bracket.lower.shape != (len(names),):
            raise InputError(f"`bracket`: must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")
        return bracket
    default = Bracket.default(model)
    if bracket is None:
        return default
    ends = np.stack([default.lower, default.upper], axis=1)
    for name, value in bracket.items():
        if name not in names:
            raise InputError(f"`bracket`: knows no parameter `{name}`; the parameters are {', '.join(names)}.")
        ends[names.index(name)] = _interval(name, value)
    return Bracket(as_float(ends[:, 0]), as_float(ends[:, 1]))


def _interval(name: str, value: Any) -> list[float]:
    pair = value if isinstance(value, list | tuple) else []
    numbers = [float(x) for x in pair if isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e12]
    if len(pair) != 2 or len(numbers) != 2 or not numbers[0] < numbers[1]:
        raise InputError(
            f"`bracket`: `{name}` must be [lower, upper] with lower below upper, got {shortened(repr(value), 80)}."
        )
    return numbers


def os4_problem(recording: Recording, model: AbstractModel, bracket: Bracket, settings: OS4Settings) -> ShootingProblem:
    """The shooting problem of one flight and a model, with the noise of standard sensors.

    **Raises:** `InputError`, one line, for arguments out of range and flights that measured too little.
    """
    if np.any(model.airframe.sensor_rotation):
        raise InputError(
            "`sensor_rotation`: the rates of an OS4 flight are along the body's axes; leave it out of the airframe."
        )
    if settings.initial_state not in ("free", "known"):
        raise InputError(f"`initial_state`: must be free or known, got {settings.initial_state!r}.")
    known, window = settings.initial_state == "known", settings.window
    if window is not None and not (math.isfinite(window) and window > 0):
        raise InputError(f"`window`: must be a positive number of seconds, got {window:g}.")
    if window is not None and known:
        raise InputError("`window`: each window has its own initial state; use `initial_state` free.")
    flight, name = recording.flight, recording.name
    measured = ~np.isnan(np.asarray(flight.states))
    chosen = _chosen_channels(name, measured, settings.channels)
    columns = CASCADE_ORDER[: CHANNELS[chosen]]
    start = jnp.nan_to_num(flight.states[0]) if known else None
    unknown = [STATE_NAMES[i] for i in columns if not measured[0, i]]
    if known and unknown:
        raise InputError(
            f"{name}: first sample: `initial_state` known needs {', '.join(unknown)} there; use `initial_state` free."
        )
    windows, (samples, dt) = 1, (flight.states.shape[0], float(flight.dt))
    if window is not None:
        if window < 2 * dt:
            raise InputError(f"`window` {window:g}: less than two samples of {name}; give at least {2 * dt:g}.")
        windows = min(max(round(samples * dt / window), 1), samples // 2)
    missing = [STATE_NAMES[i] for i in columns if not measured[:, i].any()]
    if windows > 1 and missing and chosen != "rates":
        raise InputError(
            f"{name}: `window`: {', '.join(missing)} were not measured, so that the initial state of a window is not "
            "identifiable; use `channels` rates."
        )
    unknowns = len(model.parameter_names) + (0 if known else windows * len(columns))
    if measured[:, columns].sum() <= unknowns:
        remedy = "give a longer flight" if window is None else "give a longer flight, or fewer windows"
        raise InputError(f"{name}: {measured[:, columns].sum()} measurements for {unknowns} unknowns; {remedy}.")
    return ShootingProblem(
        model,
        flight,
        sigma=SENSOR_SIGMA,
        initial_state=start,
        channels=chosen,
        windows=windows,
        unknowns=Unknowns.of(model, bracket),
    )


def _chosen_channels(name: str, measured: np.ndarray, channels: str | None) -> str:
    present = {choice: measured[:, CASCADE_ORDER[part]].any() for choice, part in _ADDED.items()}
    if not (present["rates"] or present["attitude"]):
        raise InputError(f"{name}: neither rates nor attitude were measured; log p, q, r or phi, theta, psi.")
    if channels is None:
        return [choice for choice, measured_any in present.items() if measured_any][-1]
    check_choice("channels", channels, CHANNELS)
    if not present[channels]:
        missing = ", ".join(STATE_NAMES[i] for i in CASCADE_ORDER[_ADDED[channels]])
        raise InputError(f"{name}: `channels` {channels}: none of {missing} was measured; leave it out.")
    return channels


def train_network(
    recording: Recording,
    model: AbstractModel,
    settings: NetworkEstimator,
    *,
    bracket: Intervals = None,
    channels: str | None = None,
    initial_state: str = "free",
    seed: int = 0,
) -> TrainedNetwork:
    """Train a network that identifies any flight with the inputs of this one. Arguments as in `identify`.

    - `settings`: of the training, except the channels.
    - `channels`: the network's inputs; by default the rates, and the attitude if a rate was not measured.
    """
    where, own = bracket_of(bracket, model), OS4Settings(channels=channels, initial_state=initial_state)
    problem = os4_problem(recording, model, where, own)
    settings = dataclasses.replace(settings, channels=channels or seen_channels(problem))
    with named(recording.name):
        return settings.fit(problem, where, key=jax.random.key(seed))
