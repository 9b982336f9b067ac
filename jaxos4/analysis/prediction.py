"""Predictions of the body rates some tenths of a second ahead, and their skill."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Parameters, as_float
from .._xla import quick_jit
from ..flight import Flight
from ..models.state import CASCADE_ORDER, State, unstack
from ..shooting import FASTEST, ShootingProblem
from ..shooting.filters import transition
from .disturbance import Disturbances

HORIZONS = (0.1, 0.25, 0.5)
RATES = CASCADE_ORDER[:3]
# Time between starts, and time around a start over which the measured rates are averaged [s].
_EVERY, _AROUND = 0.05, 0.02
# Number of parts of the flight for the jackknife, which omits one part at a time.
_PARTS = 10


class Predictions(NamedTuple):
    """Predictions of the body rates p, q, r [rad/s] from many starts.

    - `start`: the sample at which each prediction starts. `initial`: the measured rates there.
    - `horizons`: time from the start to the prediction [s].
    - `predicted`, `measured`: the rates at each horizon. NaN: not measured.
    """

    start: Int[np.ndarray, " starts"]
    horizons: Float[np.ndarray, " horizons"]
    initial: Float[np.ndarray, "starts 3"]
    predicted: Float[np.ndarray, "starts horizons 3"]
    measured: Float[np.ndarray, "starts horizons 3"]


class Skill(NamedTuple):
    """The skill of predictions, compared with persistence: "the rates stay constant".

    - `rmse`, `persistence`: root mean square errors of the predictions and of persistence [rad/s].
    - `skill`: 1 - (rmse / persistence)^2. 1 is perfect, 0 is as good as persistence, negative is worse. NaN: nothing
      was measured, or both errors are 0.
    - `std`: standard error of the skill, from a jackknife over ten parts of the flight.
    - `starts`: number of starts.
    """

    rmse: Float[np.ndarray, "horizons 3"]
    persistence: Float[np.ndarray, "horizons 3"]
    skill: Float[np.ndarray, "horizons 3"]
    std: Float[np.ndarray, "horizons 3"]
    starts: int


def predictions(
    problem: ShootingProblem,
    parameters: Parameters,
    *,
    horizons: tuple[float, ...] = HORIZONS,
    disturbance: Disturbances | None = None,
) -> Predictions:
    """Predict the body rates from many starts, with the recorded rotor speeds.

    Starts are 0.05 s apart. The initial rates are the mean of the rates measured within 0.01 s of the start. A start is
    omitted if one of these rates is missing, or if the longest horizon reaches beyond the stretch.

    **Arguments:** `problem` gives model, flight and method; its windows and channels have no effect. `horizons` [s] are
    positive. `disturbance`: fades from its value at the start, as the past lets expect; by default there is none.

    **Raises:** `ValueError` if the flight is shorter than the longest horizon, or has no measured rates.
    """
    flight = problem.flight
    dt, ahead = float(flight.dt), _ahead(flight, horizons)
    start, initial = starts(flight, horizons)
    rates = np.asarray(flight.states)[:, RATES]
    rate_problem = dataclasses.replace(problem, channels="rates", windows=1, initial_state=None, length=None)
    if disturbance is None:
        disturbance = Disturbances(np.zeros(rates.shape), np.ones(3))
    first, fading = as_float(disturbance.value[start]), as_float(disturbance.time_constant)
    begin = jnp.asarray(start), jnp.asarray(initial), first
    predicted = _predict(rate_problem, parameters, *begin, fading, int(ahead.max()))
    at = start[:, None] + ahead
    return Predictions(start, ahead * dt, initial, np.asarray(predicted)[:, ahead], rates[at])


def starts(
    flight: Flight, horizons: tuple[float, ...] = HORIZONS
) -> tuple[Int[np.ndarray, " starts"], Float[np.ndarray, "starts 3"]]:
    """The samples at which `predictions` starts, and the measured rates there [rad/s]. Raises the same errors."""
    dt, samples, ahead = float(flight.dt), flight.time.shape[0], _ahead(flight, horizons)
    around = int(_AROUND / 2 / dt)
    stretch = np.zeros(samples, dtype=int) if flight.stretch is None else np.asarray(flight.stretch)
    rates = np.asarray(flight.states)[:, RATES]
    start = np.arange(around, samples - ahead.max() - around, max(int(round(_EVERY / dt)), 1))
    start = start[stretch[start - around] == stretch[np.minimum(start + ahead.max(), samples - 1)]]
    near = start[:, None] + np.arange(-around, around + 1)
    initial = rates[near].mean(axis=1)
    known = np.isfinite(initial).all(axis=1)
    if not known.any():
        raise ValueError(f"`flight` has no stretch with measured rates that is longer than {max(horizons)} s.")
    return start[known], initial[known]


def _ahead(flight: Flight, horizons: tuple[float, ...]) -> Int[np.ndarray, " horizons"]:
    return np.maximum(np.rint(np.asarray(horizons) / float(flight.dt)).astype(int), 1)


@quick_jit
def _predict(
    problem: ShootingProblem,
    parameters: Parameters,
    start: Int[Array, " starts"],
    initial: Float[Array, "starts 3"],
    disturbance: Float[Array, "starts 3"],
    time_constant: Float[Array, "3"],
    steps: int,
) -> Float[Array, "starts steps_and_one 3"]:
    model, scalars, forcing = problem.model, tuple(parameters), problem.forcing(parameters)
    kept, reach = transition(time_constant, problem.flight.dt)

    def fly(
        first: Int[Array, ""], measured: Float[Array, "3"], pushed: Float[Array, "3"]
    ) -> Float[Array, "steps_and_one 3"]:
        rows = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, steps + 1), forcing)
        row = jax.tree.map(lambda leaf: leaf[0], rows)
        # A gyro bias is part of the measurement, not of the state.
        added = jnp.stack(model.observe(unstack(measured), row, scalars)[:3]) - measured

        def step(carry: tuple[State, Array], row) -> tuple[tuple[State, Array], Float[Array, "3"]]:
            state, pushed = carry
            rates = jnp.stack(problem.step(state, row, scalars).rates) + reach * pushed
            return (unstack(rates), kept * pushed), jnp.stack(model.observe(state, row, scalars)[:3])

        return jax.lax.scan(step, (unstack(measured - added), pushed), rows)[1]

    return jax.vmap(fly)(start, initial, disturbance)


def skill(predicted: Predictions) -> Skill:
    """The skill of predictions, compared with persistence."""
    measured = np.isfinite(predicted.measured)
    errors = np.where(measured, predicted.predicted - predicted.measured, 0.0)
    changes = np.where(measured, predicted.initial[:, None] - predicted.measured, 0.0)
    # A diverged prediction counts as an error that no gyro could measure: large, but finite.
    squares = np.square(np.clip(np.nan_to_num(errors, nan=FASTEST), -FASTEST, FASTEST))
    parts = np.array_split(np.arange(errors.shape[0]), min(_PARTS, errors.shape[0]))

    def skill_of(kept: np.ndarray) -> np.ndarray:
        reference = np.square(changes[kept]).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return 1 - squares[kept].sum(axis=0) / reference

    everything = np.arange(errors.shape[0])
    without = np.stack([skill_of(np.setdiff1d(everything, part)) for part in parts])
    count = np.maximum(measured.sum(axis=0), 1)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt((len(parts) - 1) * np.square(without - without.mean(axis=0)).mean(axis=0))
    if len(parts) == 1:
        spread = np.full_like(spread, np.nan)
    return Skill(
        rmse=np.sqrt(squares.sum(axis=0) / count),
        persistence=np.sqrt(np.square(changes).sum(axis=0) / count),
        skill=skill_of(everything),
        std=spread,
        starts=errors.shape[0],
    )
