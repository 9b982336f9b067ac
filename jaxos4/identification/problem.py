"""From a recorded flight and a model to the problem that estimators solve, and networks that are trained for it."""

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._custom_types import as_float
from ..bracket import Bracket
from ..errors import InputError, named, shortened
from ..flight import STATE_NAMES
from ..logs import Recording
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks import NetworkEstimator, TrainedNetwork
from ..noise import SENSOR_SIGMA
from ..shooting import ShootingProblem, Unknowns

# A bracket, or `[lower, upper]` by parameter name; the model's default for all others.
Intervals = Bracket | Mapping[str, Any] | None
# The states that each choice of channels adds to the one before, in cascade order.
_ADDED = {"rates": slice(0, 3), "attitude": slice(3, 6), "all": slice(6, 12)}
GivenNetwork = TrainedNetwork | str | os.PathLike[str] | None

# Steps of training for a network that only gives a search its start.
_SEED_STEPS = 2000
# A vehicle's network sees so many windows of the flight, however long it is.
_VEHICLE_WINDOWS, _VEHICLE_TRAINING = 24, NetworkEstimator(steps=250, batch=64, noise=(1.0, 1.0), held_out=2000)
_FLYABLE = 0.5  # the share of a vehicle's bracket in which nearly all simulated flights can be flown


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


def flight_problem(
    recording: Recording,
    model: AbstractModel,
    bracket: Bracket,
    *,
    channels: str | None = None,
    initial_state: str = "free",
    window: float | None = None,
) -> ShootingProblem:
    """The problem of explaining one flight by a model, at the standard sensors' noise. Arguments as of `identify`.

    **Raises:** `InputError`, one line, for arguments out of range and flights that measured too little.
    """
    if initial_state not in ("free", "known"):
        raise InputError(f"`initial_state`: must be free or known, got {initial_state!r}.")
    known = initial_state == "known"
    if window is not None and not (math.isfinite(window) and window > 0):
        raise InputError(f"`window`: must be a positive number of seconds, got {window:g}.")
    if window is not None and known:
        raise InputError("`window`: each window has its own initial state; use `initial_state` free.")
    flight, name = recording.flight, recording.name
    measured = ~np.isnan(np.asarray(flight.states))
    chosen = _chosen_channels(name, measured, channels)
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
    if channels not in CHANNELS:
        raise InputError(f"`channels`: must be one of {', '.join(CHANNELS)}, got {channels!r}.")
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
    """Train a network that identifies any flight with the inputs of this one. Arguments as of `identify`.

    - `settings`: of the training, except the channels.
    - `channels`: what the network looks at; by default the rates, and the attitude if a rate was not measured.
    """
    where = bracket_of(bracket, model)
    problem = flight_problem(recording, model, where, channels=channels, initial_state=initial_state)
    settings = dataclasses.replace(settings, channels=channels or _seen_channels(problem))
    with named(recording.name):
        return settings.fit(problem, where, key=jax.random.key(seed))


def network_for(problem: ShootingProblem, bracket: Bracket, name: str, *, shoots: bool, seed: int) -> TrainedNetwork:
    """Train a network for one flight, named `name`: briefly if shooting follows (`shoots`)."""
    steps = _SEED_STEPS if shoots else NetworkEstimator.steps
    settings = NetworkEstimator(channels=_seen_channels(problem), steps=steps)
    with named(name):
        return settings.fit(problem, bracket, key=jax.random.key(seed))


def liveliest(problem: ShootingProblem) -> ShootingProblem:
    """The part of a vehicle's flight that a network sees: the windows in a row with the largest rates."""
    windows = min(_VEHICLE_WINDOWS, problem.windows)
    samples = problem.flight.time.shape[0] // problem.windows
    motion = np.nansum(np.square(problem.recorded()), axis=1).reshape(problem.windows, samples).sum(axis=1)
    first = samples * int(np.convolve(motion, np.ones(windows), "valid").argmax())
    part = slice(first, first + samples * windows)
    flight = jax.tree.map(lambda leaf: leaf[part] if leaf.ndim else leaf, problem.flight)
    return dataclasses.replace(problem, flight=flight, windows=windows)


def vehicle_network_for(problem: ShootingProblem, name: str, *, seed: int) -> TrainedNetwork:
    """Train a network for a part of a vehicle's flight in windows, at the noise levels of the problem."""
    unknowns = problem.unknowns
    bracket = Bracket.around(unknowns.center, _FLYABLE * unknowns.half_width)
    with named(name):
        return _VEHICLE_TRAINING.fit(problem, bracket, key=jax.random.key(seed))


def network_provenance(given: GivenNetwork, network: TrainedNetwork) -> dict[str, Any]:
    """Where a network is from and how it was trained, for JSON."""
    bracket = network.bracket
    return {
        "file": None if given is None or isinstance(given, TrainedNetwork) else os.fspath(given),
        "settings": {f.name: getattr(network.settings, f.name) for f in dataclasses.fields(network.settings)},
        "bracket": {"lower": bracket.lower.tolist(), "upper": bracket.upper.tolist()},
    }


def _seen_channels(problem: ShootingProblem) -> str:
    rates = np.asarray(problem.flight.states)[:, CASCADE_ORDER[: CHANNELS["rates"]]]
    return "attitude" if problem.size > CHANNELS["rates"] and np.isnan(rates).all(axis=0).any() else "rates"
