"""Networks that are trained for one flight."""

import dataclasses
import os
from typing import Any

import jax
import numpy as np

from ..bracket import Bracket
from ..errors import named
from ..models.state import CASCADE_ORDER, CHANNELS
from ..shooting import ShootingProblem
from .estimator import NetworkEstimator, TrainedNetwork

GivenNetwork = TrainedNetwork | str | os.PathLike[str] | None
"""A network, or its file."""


SEED_STEPS = 2000  # of training a network that only gives a search its start
VEHICLE = NetworkEstimator(steps=250, batch=64, noise=(1.0, 1.0), held_out=2000)
MAX_WINDOWS = 24  # that the network of a vehicle sees, however long the flight is
FLYABLE = 0.5  # share of a vehicle's bracket in which nearly all simulated flights can be flown


def network_for(problem: ShootingProblem, bracket: Bracket, name: str, *, shoots: bool, seed: int) -> TrainedNetwork:
    """Train a network for one flight, named `name`: briefly if shooting follows (`shoots`)."""
    steps = SEED_STEPS if shoots else NetworkEstimator.steps
    settings = NetworkEstimator(channels=seen_channels(problem), steps=steps)
    with named(name):
        return settings.fit(problem, bracket, key=jax.random.key(seed))


def liveliest(problem: ShootingProblem) -> ShootingProblem:
    """The part of a vehicle's flight that a network sees: the windows in a row with the largest rates."""
    windows = min(MAX_WINDOWS, problem.windows)
    samples = problem.flight.time.shape[0] // problem.windows
    motion = np.nansum(np.square(problem.recorded()), axis=1).reshape(problem.windows, samples).sum(axis=1)
    first = samples * int(np.convolve(motion, np.ones(windows), "valid").argmax())
    part = slice(first, first + samples * windows)
    flight = jax.tree.map(lambda leaf: leaf[part] if leaf.ndim else leaf, problem.flight)
    return dataclasses.replace(problem, flight=flight, windows=windows)


def vehicle_network_for(problem: ShootingProblem, name: str, *, seed: int) -> TrainedNetwork:
    """Train a network for a part of a vehicle's flight in windows, at the noise levels of the problem."""
    unknowns = problem.unknowns
    bracket = Bracket.around(unknowns.center, FLYABLE * unknowns.half_width)
    with named(name):
        return VEHICLE.fit(problem, bracket, key=jax.random.key(seed))


def network_provenance(given: GivenNetwork, network: TrainedNetwork) -> dict[str, Any]:
    """The origin of a network and its training, for JSON."""
    bracket = network.bracket
    return {
        "file": None if given is None or isinstance(given, TrainedNetwork) else os.fspath(given),
        "settings": {f.name: getattr(network.settings, f.name) for f in dataclasses.fields(network.settings)},
        "bracket": {"lower": bracket.lower.tolist(), "upper": bracket.upper.tolist()},
    }


def seen_channels(problem: ShootingProblem) -> str:
    """The channels of a network by default: the rates, and the attitude if a rate was not measured."""
    rates = np.asarray(problem.flight.states)[:, CASCADE_ORDER[: CHANNELS["rates"]]]
    return "attitude" if problem.size > CHANNELS["rates"] and np.isnan(rates).all(axis=0).any() else "rates"
