"""Predictions of the body rates some tenths of a second ahead, with the disturbance at their start, and their skill."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import Numeric, Parameters, Scalar, as_float
from ..flight import RATES, Flight
from ..models.state import State, unstack
from ..shooting import FASTEST, ShootingProblem
from ..shooting.gains import LogNoise, Observed, gains_of, is_rate, transition
from .frequency_response import modelled_acceleration

HORIZONS = (0.1, 0.25, 0.5)
# The horizon that decides whether a model predicts [s].
_DECISIVE = 0.25
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

    def thinned(self, most: int) -> "Predictions":
        """At most `most` starts, evenly chosen, with rates to 1e-4 rad/s. What is not finite is NaN."""
        every = max(-(-self.start.size // most), 1)
        rates = (np.where(np.isfinite(each), each.round(4), np.nan)[::every] for each in self[2:])
        return Predictions(self.start[::every], self.horizons, *rates)


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
    disturbance: Float[np.ndarray, "samples 3"] | None = None,
    noise: LogNoise | None = None,
) -> Predictions:
    """Predict the body rates from many starts, with the recorded rotor speeds.

    The velocity keeps its value at the start. Starts are 0.05 s apart. The initial rates are the mean of the rates
    measured within 0.01 s of the start. A start is omitted if one of these rates is missing, or if the longest horizon
    reaches beyond the stretch.

    **Arguments:** `problem` gives model, flight and method; its windows and channels have no effect. `horizons` [s] are
    positive. `disturbance` [rad/s^2]: fades from its value at the start, as the past lets expect, by the time constants
    of `noise`; by default there is none.

    **Raises:** `ValueError` if the flight is shorter than the longest horizon, or has no measured rates.
    """
    flight = problem.flight
    ahead, rates = _ahead(flight, horizons), np.asarray(flight.states)[:, RATES]
    start, initial = starts(flight, horizons)
    rate_problem = dataclasses.replace(problem, channels="rates", windows=1, initial_state=None, length=None)
    pushed = np.zeros(rates.shape) if disturbance is None else disturbance
    fading = as_float(np.ones(3) if noise is None else np.exp(np.asarray(noise.time_constant)[:3]))
    begin = start, initial, pushed[start]
    predicted = np.asarray(_predict(rate_problem, parameters, *begin, fading, int(ahead.max())))
    return Predictions(start, ahead * float(flight.dt), initial, predicted[:, ahead], rates[start[:, None] + ahead])


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


@eqx.filter_jit
def _predict(
    problem: ShootingProblem,
    parameters: Parameters,
    start: Int[Numeric, " starts"],
    initial: Float[Numeric, "starts 3"],
    disturbance: Float[Numeric, "starts 3"],
    time_constant: Float[Array, "3"],
    steps: int,
) -> Float[Array, "starts steps_and_one 3"]:
    model, scalars, forcing = problem.model, tuple(parameters), problem.forcing(parameters)
    kept, reach = transition(time_constant, problem.flight.dt)

    def fly(first: Int[Array, ""], measured: Array, pushed: Array) -> Float[Array, "steps_and_one 3"]:
        rows = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, steps + 1), forcing)
        begin = jax.tree.map(lambda leaf: leaf[0], rows)
        # A gyro bias is part of the measurement, not of the state.
        added = jnp.stack(model.observe(unstack(measured), begin, scalars)[:3]) - measured

        def step(carry: tuple[State, Array], row) -> tuple[tuple[State, Array], Float[Array, "3"]]:
            state, pushed = carry
            row = row._replace(velocity=begin.velocity)
            rates = jnp.stack(problem.step(state, row, scalars).rates) + reach * pushed
            return (unstack(rates), kept * pushed), jnp.stack(model.observe(state, row, scalars)[:3])

        return jax.lax.scan(step, (unstack(measured - added), pushed), rows)[1]

    return jax.vmap(fly)(jnp.asarray(start), jnp.asarray(initial), jnp.asarray(disturbance))


def skill(predicted: Predictions) -> Skill:
    """The skill of predictions, compared with persistence."""
    measured = np.isfinite(predicted.measured)
    errors = np.where(measured, predicted.predicted - predicted.measured, 0.0)
    changes = np.where(measured, predicted.initial[:, None] - predicted.measured, 0.0)
    # A diverged prediction counts as an error that no gyro could measure: large, but finite.
    squares = np.square(np.clip(np.nan_to_num(errors, nan=FASTEST), -FASTEST, FASTEST))
    parts = np.array_split(np.arange(errors.shape[0]), min(_PARTS, errors.shape[0]))

    count, sums = np.maximum(measured.sum(axis=0), 1), np.stack([squares, np.square(changes)])
    total = sums.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        without = [np.divide(*np.delete(sums, part, 1).sum(axis=1)) for part in parts]
        spread = np.sqrt((len(parts) - 1) * np.var(without, axis=0)) if len(parts) > 1 else np.full(count.shape, np.nan)
        rmse, persistence = np.sqrt(total / count)
        return Skill(rmse, persistence, 1 - total[0] / total[1], spread, errors.shape[0])


def decisive_horizon(
    horizons: Sequence[float] | Float[np.ndarray, " horizons"], known: Bool[ArrayLike, " horizons"]
) -> int:
    """The place of the horizon nearest to 0.25 s among those that are `known`: something was measured there."""
    return int(np.argmin(np.where(known, np.abs(np.asarray(horizons) - _DECISIVE), np.inf)))


def disturbances(problem: ShootingProblem, parameters: Parameters, noise: LogNoise) -> Float[np.ndarray, "samples 3"]:
    """The disturbance of each body rate [rad/s^2] at each sample, from the measurements until then.

    Kalman filters find it, for the noise that `FilterError` found. The model is evaluated at the measured rates.
    `noise`: its first three channels are p, q and r.
    """
    rates, stretch = np.asarray(problem.flight.states)[:, RATES], problem.flight.stretch
    modelled = np.pad(modelled_acceleration(problem, parameters), ((0, 1), (0, 0)))
    own = LogNoise(*(as_float(np.asarray(leaf)[: len(RATES)]) for leaf in noise))
    number = np.zeros(len(rates), dtype=int) if stretch is None else np.asarray(stretch)
    known = _known_by(own, as_float(rates), as_float(modelled), number, problem.flight.dt)
    return np.asarray(known.disturbance)


class Filtered(NamedTuple):
    """The rate of each channel, and its disturbance, at each sample from all measurements until then."""

    rate: Float[Array, "samples channels"]
    disturbance: Float[Array, "samples channels"]


def filtered(
    noise: LogNoise,
    measured: Float[Array, "samples channels"],
    modelled: Float[Array, "samples channels"],
    stretch: Int[Numeric, " samples"],
    dt: Scalar,
) -> Filtered:
    """The rates and disturbances at each sample. Filters begin anew in each stretch.

    `modelled`: the model's angular acceleration, and 0 for a specific force, which is measured less its model.
    """
    begins = jnp.diff(stretch, prepend=-1) != 0
    is_known, memory = ~jnp.isnan(measured), is_rate(measured.shape[1])
    gains = gains_of(Observed(measured[:, :, None], begins[:, None], begins[:, None]), noise, dt)
    kept, reach = transition(jnp.exp(noise.time_constant), dt)

    def step(known: Filtered, row) -> tuple[Filtered, Filtered]:
        y, is_known, added, begins, by_rate, by_disturbance = row
        rate, disturbance = (jnp.where(begins, 0.0, x) for x in known)
        error = jnp.where(is_known, y - jnp.where(memory, rate, disturbance), 0.0)
        rate, disturbance = rate + by_rate * error, disturbance + by_disturbance * error
        later = Filtered(memory * rate + added * dt + reach * disturbance, kept * disturbance)
        return later, Filtered(rate, disturbance)

    zero = jnp.zeros(measured.shape[1], dtype=float)
    rows = measured, is_known, modelled, begins, gains.rate[:, :, 0], gains.disturbance[:, :, 0]
    return jax.lax.scan(step, Filtered(zero, zero), rows)[1]


_known_by = eqx.filter_jit(filtered)
