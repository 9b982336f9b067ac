"""Predictions of the body rates some tenths of a second ahead, with the disturbance at their start, and their skill."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Parameters, Scalar, as_float
from .._xla import quick_jit
from ..flight import STATE_NAMES, Flight
from ..models.state import CASCADE_ORDER, State, unstack
from ..shooting import FASTEST, ShootingProblem
from ..shooting.gains import LogNoise, Observed, gains_of, is_rate, transition
from .frequency_response import modelled_acceleration

HORIZONS = (0.1, 0.25, 0.5)
RATES = CASCADE_ORDER[:3]
# Time between starts, and time around a start over which the measured rates are averaged [s].
_EVERY, _AROUND = 0.05, 0.02
# Number of parts of the flight for the jackknife, which omits one part at a time.
_PARTS = 10


class Disturbances(NamedTuple):
    """What acts on each channel besides the model. The channels are the body rates, then specific forces.

    - `value`: at each sample, from the measurements until then [rad/s^2; m/s^2].
    - `time_constant`: with which they fade [s].
    - `rates`: the body rates that the measurements until then imply [rad/s]. `None`: not computed.
    """

    value: Float[np.ndarray, "samples channels"]
    time_constant: Float[np.ndarray, " channels"]
    rates: Float[np.ndarray, "samples 3"] | None = None


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
    """Predict the body rates from many starts, with the recorded rotor speeds. The velocity stays that of the start.

    Starts are 0.05 s apart. The initial rates are the mean of the rates measured within 0.01 s of the start. A start is
    omitted if one of these rates is missing, or if the longest horizon reaches beyond the stretch.

    **Arguments:** `problem` gives model, flight and method; its windows and channels have no effect. `horizons` [s] are
    positive. `disturbance`: fades from its value at the start, as the past lets expect; by default there is none.

    **Raises:** `ValueError` if the flight is shorter than the longest horizon, or has no measured rates.
    """
    flight = problem.flight
    ahead, rates = _ahead(flight, horizons), np.asarray(flight.states)[:, RATES]
    start, initial = starts(flight, horizons)
    rate_problem = dataclasses.replace(problem, channels="rates", windows=1, initial_state=None, length=None)
    if disturbance is None:
        disturbance = Disturbances(np.zeros(rates.shape), np.ones(3))
    pushed, fading = as_float(disturbance.value[start]), as_float(disturbance.time_constant)
    begin = jnp.asarray(start), jnp.asarray(initial), pushed
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

    return jax.vmap(fly)(start, initial, disturbance)


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


def disturbances(
    problem: ShootingProblem,
    parameters: Parameters,
    noise: LogNoise,
    *,
    offset: Float[np.ndarray, "samples 3"] | None = None,
    memory: float = np.inf,
) -> Disturbances:
    """The disturbance of each channel by Kalman filters, for the noise that `FilterError` found.

    The model is evaluated at the measured rates. `noise`: its first three channels are p, q and r. `offset`: what to
    add to the model [rad/s^2]; with it, the specific forces along `model.force_axes` are channels too, each without its
    mean over the last `memory` [s], which an accelerometer's bias may be.
    """
    flight, channels = problem.flight, len(RATES) if offset is None else len(noise.strength)
    rates, stretch = np.asarray(flight.states)[:, RATES], flight.stretch
    measured, modelled = rates, np.pad(modelled_acceleration(problem, parameters), ((0, 1), (0, 0)))
    if offset is not None:
        modelled = modelled + offset
        known = np.where(np.isnan(rates).any(axis=1, keepdims=True), 0.0, rates)
        expected = np.stack(_observed(problem, parameters, as_float(known))[len(RATES) :], axis=1)
        axes = np.asarray(problem.model.force_axes, dtype=int)
        force = flight.recorded[:, len(STATE_NAMES) + axes] - expected
        force -= past_means(force, float(np.exp(-float(flight.dt) / memory)))[0]
        measured = np.concatenate([rates, force], axis=1)
        modelled = np.pad(modelled, ((0, 0), (0, force.shape[1])))
    own = LogNoise(*(as_float(np.asarray(leaf)[:channels]) for leaf in noise))
    begins = np.diff(np.zeros(len(rates), dtype=int) if stretch is None else np.asarray(stretch), prepend=-1) != 0
    rate, value = _filtered(own, as_float(measured), as_float(modelled), jnp.asarray(begins), flight.dt)
    time_constant = np.exp(np.asarray(own.time_constant))
    return Disturbances(np.asarray(value), time_constant, np.asarray(rate)[:, : len(RATES)])


def past_means(
    values: Float[np.ndarray, "samples columns"], kept: float
) -> tuple[Float[np.ndarray, "samples columns"], ...]:
    """The mean of what was measured before each sample; 0 if nothing was. NaN: not measured.

    **Arguments:** `kept`: the share of a value's weight that remains one sample later.

    **Returns:** the means, the sums of the weights, and those of the squared weights.
    """
    known, sums = np.isfinite(values), []
    total = weight = square = np.zeros(values.shape[1])
    for value, is_known in zip(np.where(known, values, 0.0), known, strict=True):
        sums.append((total, weight, square))
        total, weight, square = kept * total + value, kept * weight + is_known, kept**2 * square + is_known
    total, weight, square = np.moveaxis(np.array(sums), 1, 0)
    return total / np.maximum(weight, 1.0), weight, square


@quick_jit
def _observed(
    problem: ShootingProblem, parameters: Parameters, rates: Float[Array, "samples 3"]
) -> tuple[Float[Array, " samples"], ...]:
    """The outputs of the model's sensors at these body rates: rates, then specific forces."""
    scalars = tuple(parameters)
    observe = jax.vmap(lambda rates, row: problem.model.observe(unstack(rates), row, scalars))
    return observe(rates, problem.forcing(parameters))


@quick_jit
def _filtered(
    noise: LogNoise,
    measured: Float[Array, "samples channels"],
    modelled: Float[Array, "samples channels"],
    begins: Bool[Array, " samples"],
    dt: Scalar,
) -> tuple[Float[Array, "samples channels"], Float[Array, "samples channels"]]:
    """Rates and disturbances. A specific force is measured less its model; its rate is the disturbance's mean."""
    is_known, memory = ~jnp.isnan(measured), is_rate(measured.shape[1])
    observed = Observed(measured[:, :, None], begins[:, None], begins[:, None])
    gains = gains_of(observed, noise, dt)
    kept, reach = transition(jnp.exp(noise.time_constant), dt)

    def step(known: tuple[Array, Array], row) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (rate, disturbance), (y, is_known, added, begins, by_rate, by_disturbance) = known, row
        rate, disturbance = (jnp.where(begins, 0.0, x) for x in (rate, disturbance))
        error = jnp.where(is_known, y - rate, 0.0)
        rate, disturbance = rate + by_rate * error, disturbance + by_disturbance * error
        return (memory * rate + added * dt + reach * disturbance, kept * disturbance), (rate, disturbance)

    zero = jnp.zeros(measured.shape[1], dtype=float)
    rows = measured, is_known, modelled, begins, gains.rate[:, :, 0], gains.disturbance[:, :, 0]
    return jax.lax.scan(step, (zero, zero), rows)[1]
