"""Padding: flights of different lengths share one compiled program."""

import dataclasses

import jax
import numpy as np

from ..flight import Flight
from .problem import ShootingProblem

# A flight is padded to the first of these numbers of samples that is enough. A longer flight is not padded: to compile
# its program takes less time than to simulate it.
_CAPACITIES = (4096, 16384, 65536)


def padded(problem: ShootingProblem) -> ShootingProblem:
    """The problem with a padded flight, unless it is cut into windows. Derivatives are then forward-mode only.

    Padding is not simulated: it costs memory and no time. Results change by rounding errors only.
    """
    samples = problem.flight.time.shape[0]
    capacity = capacity_of(samples)
    if capacity == samples or problem.windows > 1 or problem.length is not None:
        return problem
    return with_room(problem, capacity)


def with_room(problem: ShootingProblem, capacity: int) -> ShootingProblem:
    """The problem in one window, with a flight that is padded to `capacity` samples."""
    length = jax.device_put(np.asarray(problem.flight.time.shape[0]))
    return dataclasses.replace(problem, flight=pad_flight(problem.flight, capacity), windows=1, length=length)


def capacity_of(samples: int) -> int:
    """The number of rows of a padded flight; `samples` if it is not padded."""
    return next((capacity for capacity in _CAPACITIES if capacity >= samples), samples)


def pad_flight(flight: Flight, capacity: int) -> Flight:
    """The flight with more rows, up to `capacity`, in which nothing was measured and the inputs stay as they were."""
    samples = flight.time.shape[0]

    def pad(values: jax.Array | None, fill: float | None = None) -> jax.Array | None:
        if values is None:
            return None
        rows = np.asarray(values)
        more = np.repeat(rows[-1:] if fill is None else np.full_like(rows[-1:], fill), capacity - samples, axis=0)
        return jax.device_put(np.concatenate([rows, more]))

    return dataclasses.replace(
        flight,
        time=np.asarray(flight.time)[0] + float(flight.dt) * np.arange(capacity),
        omega=pad(flight.omega),
        states=pad(flight.states, np.nan),
        specific_force=pad(flight.specific_force, np.nan),
        body_velocity=pad(flight.body_velocity),
        stretch=pad(flight.stretch),
        voltage=pad(flight.voltage),
        within=pad(flight.within),
    )
