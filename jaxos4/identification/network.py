"""Networks that are trained for one flight's inputs."""

import dataclasses
import os
from typing import Any

import jax
import numpy as np

from ..bracket import Bracket
from ..errors import named
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks import NetworkEstimator, TrainedNetwork
from ..networks.file import load_network
from ..recording.reading import Recording
from ..shooting import ShootingProblem
from .problem import Intervals, bracket_of, flight_problem

GivenNetwork = TrainedNetwork | str | os.PathLike[str] | None

# Steps of training for a network that only gives a search its start.
_SEED_STEPS = 2000
# A vehicle's network sees so many windows of the flight, however long it is.
_VEHICLE_WINDOWS, _VEHICLE_TRAINING = 24, NetworkEstimator(steps=250, batch=64, noise=(1.0, 1.0), held_out=2000)
_FLYABLE = 0.5  # the share of a vehicle's bracket in which nearly all simulated flights can be flown


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
    return _train(settings, problem, where, recording.name, seed)


def network_for(problem: ShootingProblem, bracket: Bracket, name: str, *, shoots: bool, seed: int) -> TrainedNetwork:
    """Train a network for one flight, named `name`: briefly if shooting follows (`shoots`)."""
    steps = _SEED_STEPS if shoots else NetworkEstimator.steps
    return _train(NetworkEstimator(channels=_seen_channels(problem), steps=steps), problem, bracket, name, seed)


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
    return _train(_VEHICLE_TRAINING, problem, bracket, name, seed)


def loaded(network: GivenNetwork) -> TrainedNetwork | None:
    """A network, or the one in a file. Raises as `jaxos4.load_network`."""
    return network if network is None or isinstance(network, TrainedNetwork) else load_network(network)


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


def _train(
    settings: NetworkEstimator, problem: ShootingProblem, bracket: Bracket, name: str, seed: int
) -> TrainedNetwork:
    with named(name):
        return settings.fit(problem, bracket, key=jax.random.key(seed))
