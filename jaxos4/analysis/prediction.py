"""Predictions in open loop: filter states at each sample, simulation from them, and the skill of predicted rates."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import Arrays, Numeric, Parameters, Scalar, as_float
from .._xla import compiled_cheaply
from ..flight import RATES, Flight
from ..models.abstract import AbstractModel
from ..models.state import Forcing, Rates, State
from ..shooting import FASTEST, ShootingProblem
from ..shooting.gains import LogNoise, Transition, first_covariance, is_rate, next_gains, step_of

Motion = TypeVar("Motion")

HORIZONS = (0.1, 0.25, 0.5)
"""How far ahead rates are predicted, if nothing else is wanted [s]."""


class Predictions(Arrays, frozen=True, eq=False):
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

    @property
    def breaks(self) -> Int[np.ndarray, " breaks"]:
        """The places of starts before which a line breaks, because another stretch begins."""
        steps = np.diff(self.start)
        return np.flatnonzero(steps > 1.5 * (np.median(steps) if steps.size else 1.0)) + 1

    def at(self, places: slice) -> "Predictions":
        """The predictions at some of the horizons."""
        rates = (each[:, places] for each in (self.predicted, self.measured))
        return Predictions(self.start, self.horizons[places], self.initial, *rates)

    def thinned(self, most: int) -> "Predictions":
        """At most `most` starts, evenly chosen, with rates to 1e-4 rad/s. What is not finite is NaN."""
        every = max(-(-self.start.size // most), 1)
        rates = self.initial, self.predicted, self.measured
        rates = (np.where(np.isfinite(each), each.round(4), np.nan)[::every] for each in rates)
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
    """Predict the body rates from many `starts`, with the recorded rotor speeds and the velocity at the start.

    `problem` gives model, flight and method; `horizons` [s] are positive. The `disturbance` [rad/s^2] at a start fades
    with the time constants of `noise`; by default there is none.

    **Raises:** `ValueError` if the flight is shorter than the longest horizon, or has no measured rates.
    """
    flight = problem.flight
    ahead, rates = _ahead(flight, horizons), np.asarray(flight.states)[:, RATES]
    start, initial = starts(flight, horizons)
    rate_problem = dataclasses.replace(problem, channels="rates", windows=1, initial_state=None, length=None)
    pushed = np.zeros(rates.shape) if disturbance is None else disturbance
    levels = LogNoise(*np.zeros((3, 3))) if noise is None else jax.tree.map(lambda leaf: np.asarray(leaf)[:3], noise)
    begin = start, initial, pushed[start]
    predicted = np.asarray(_predict(rate_problem, parameters, *begin, levels, int(ahead.max())))
    measured = rates[start[:, None] + ahead]
    return Predictions(start, ahead * float(flight.dt), initial, predicted[:, ahead - 1], measured)


def trajectory_horizons(dt: float) -> tuple[float, ...]:
    """Horizons every 20 ms, in whole samples, which draw a trajectory up to the longest of `HORIZONS`."""
    step = max(round(0.02 / dt), 1)
    return tuple(dt * np.arange(step, max(round(max(HORIZONS) / dt), 1) + 1, step))


def starts(
    flight: Flight, horizons: tuple[float, ...] = HORIZONS
) -> tuple[Int[np.ndarray, " starts"], Float[np.ndarray, "starts 3"]]:
    """The samples at which `predictions` starts, and the rates there [rad/s]. Raises the same errors.

    There is a start every 50 ms. The rates are the mean of those measured up to 10 ms before or after the start: less
    noise than one sample. A start is omitted if one of these rates is missing, or if the longest horizon reaches beyond
    the stretch.
    """
    dt, samples, ahead = float(flight.dt), flight.time.shape[0], _ahead(flight, horizons)
    around = int(0.01 / dt)
    stretch, rates = np.asarray(flight.stretch_numbers), np.asarray(flight.states)[:, RATES]
    start = np.arange(around, samples - ahead.max() - around, max(int(round(0.05 / dt)), 1))
    start = start[stretch[start - around] == stretch[np.minimum(start + ahead.max(), samples - 1)]]
    initial = rates[start[:, None] + np.arange(-around, around + 1)].mean(axis=1)
    known = np.isfinite(initial).all(axis=1)
    if not known.any():
        raise ValueError(f"`flight` has no stretch with measured rates that is longer than {max(horizons)} s.")
    return start[known], initial[known]


def _ahead(flight: Flight, horizons: tuple[float, ...]) -> Int[np.ndarray, " horizons"]:
    return np.maximum(np.rint(np.asarray(horizons) / float(flight.dt)).astype(int), 1)


@compiled_cheaply
def _predict(
    problem: ShootingProblem,
    parameters: Parameters,
    start: Int[Numeric, " starts"],
    initial: Float[Numeric, "starts 3"],
    disturbance: Float[Numeric, "starts 3"],
    noise: LogNoise,
    steps: int,
) -> Float[Array, "starts steps 3"]:
    model, scalars, forcing = problem.model, tuple(parameters), problem.forcing(parameters)
    fading = Transition.of(jax.tree.map(as_float, noise), problem.flight.dt)
    calm = Filtered(jnp.zeros((steps, 3)), jnp.zeros((steps, 3)))

    def fly(first: Int[Array, ""], measured: Array, disturbance: Array) -> Float[Array, "steps 3"]:
        rows = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, steps + 1), forcing)
        begin, later = (jax.tree.map(lambda leaf, part=part: leaf[part], rows) for part in (0, np.s_[1:]))

        def advance(rates: Rates, row: Forcing, added: Array) -> Rates:
            moved = problem.advance(row._replace(velocity=begin.velocity), State(rates), scalars)[0].rates
            return Rates(*(jnp.stack(moved) + added))

        def observed(rates: Rates, row: Forcing) -> Float[Array, "3"]:
            return jnp.stack(model.observe(State(rates), row, scalars)[:3])

        driving = jax.tree.map(lambda leaf: leaf[:-1], rows)
        start = Rates(*(measured - gyro_bias(model, measured, begin, scalars)))
        flown = open_loop(advance, start, Filtered(measured, disturbance), driving, calm, fading)
        return jax.vmap(observed)(flown, later)

    return jax.vmap(fly)(jnp.asarray(start), jnp.asarray(initial), jnp.asarray(disturbance))


def skill(predicted: Predictions, *, parts: int = 10) -> Skill:
    """The skill of predictions, compared with persistence. `parts`: of the flight, for the jackknife."""
    measured = np.isfinite(predicted.measured)
    errors = np.where(measured, predicted.predicted - predicted.measured, 0.0)
    changes = np.where(measured, predicted.initial[:, None] - predicted.measured, 0.0)
    # A diverged prediction counts as an error that no gyro could measure: large, but finite.
    squares = np.square(np.clip(np.nan_to_num(errors, nan=FASTEST), -FASTEST, FASTEST))
    groups = np.array_split(np.arange(errors.shape[0]), min(parts, errors.shape[0]))

    count, sums = np.maximum(measured.sum(axis=0), 1), np.stack([squares, np.square(changes)])
    total = sums.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        without = [np.divide(*np.delete(sums, group, 1).sum(axis=1)) for group in groups]
        spread = (
            np.sqrt((len(groups) - 1) * np.var(without, axis=0)) if len(groups) > 1 else np.full(count.shape, np.nan)
        )
        rmse, persistence = np.sqrt(total / count)
        return Skill(rmse, persistence, 1 - total[0] / total[1], spread, errors.shape[0])


def decisive_horizon(
    horizons: Sequence[float] | Float[np.ndarray, " horizons"],
    known: Bool[ArrayLike, " horizons"],
    *,
    wanted: float = 0.25,
) -> int:
    """The place of the `known` horizon nearest to `wanted` [s]: it shows a wrong model, and gusts do not decide it."""
    return int(np.argmin(np.where(known, np.abs(np.asarray(horizons) - wanted), np.inf)))


class Filtered(NamedTuple):
    """Each channel's rate, or force besides the model's, and its disturbance, as a filter knows them."""

    driven: Float[Numeric, "*samples channels"]
    disturbance: Float[Numeric, "*samples channels"]

    def later(self, over: Transition, driven: Numeric, disturbance: Numeric | float = 0.0) -> "Filtered":
        """One sample later, if nothing is measured. `driven`, `disturbance`: what each gains besides."""
        driven = over.driven_kept * self.driven + over.driven_by * self.disturbance + driven
        return Filtered(driven, over.kept * self.disturbance + disturbance)


@jax.jit
def filtered(
    noise: LogNoise,
    measured: Float[Numeric, "samples channels"],
    modelled: Float[Numeric, "samples channels"],
    stretch: Int[Numeric, " samples"],
    dt: Scalar,
) -> tuple[Filtered, Float[Array, "samples channels"]]:
    """The state of the filters after each sample, and the innovations. Each stretch starts new filters.

    The likelihood's filters (`jaxos4.shooting.filters`), with the model's accelerations as data instead of derivatives.

    - `modelled`: the angular acceleration, and 0 for a specific force, which is measured less its model.

    An innovation is NaN if it was not measured, or if a stretch begins.
    """
    begins, step = jnp.diff(stretch, prepend=-1) != 0, step_of(noise, dt)

    def follow(carry, row):
        (p, known), (y, added, begins) = carry, row
        p, gains = next_gains(p, step, ~jnp.isnan(y), begins)
        known = jax.tree.map(lambda x: jnp.where(begins, 0.0, x), known)
        innovation = y - known.driven
        error = jnp.where(jnp.isnan(y), 0.0, innovation)
        known = Filtered(known.driven + gains.driven * error, known.disturbance + gains.disturbance * error)
        return (p, known.later(step.transition, added * dt)), (known, jnp.where(begins, jnp.nan, innovation))

    zero = jnp.zeros((measured.shape[1], 1), dtype=float)  # one segment
    rows = measured[:, :, None], modelled[:, :, None], begins[:, None]
    found = jax.lax.scan(follow, (first_covariance(step, 1), Filtered(zero, zero)), rows)[1]
    return jax.tree.map(lambda leaf: leaf[:, :, 0], found)


def open_loop(
    advance: Callable[[Motion, Any, Array], Motion],
    begin: Motion,
    known: Filtered,
    rows: Any,
    gusts: Filtered,
    over: Transition,
) -> Motion:
    """Simulate the motion without measurements, step by step, while the disturbance fades.

    - `advance(motion, row, added)`: the motion after one step. `added`: what disturbances add to each rate over the
      step, and the mean of each specific force that they add.
    - `known`: the filters at the start. Their rates are not used, because the motion has rates of its own.
    - `rows`: the forcing of each step. `gusts`: random increments of each channel in each step.
    - `over`: the transition of the disturbance over a step.
    """
    rate = is_rate(over.driven_by)

    def step(carry: tuple[Motion, Filtered], row: tuple[Any, Filtered]) -> tuple[tuple[Motion, Filtered], Motion]:
        (motion, known), (forcing, gust) = carry, row
        known = known._replace(driven=jnp.where(rate, 0.0, known.driven))
        later = known.later(over, *gust)
        motion = advance(motion, forcing, jnp.where(rate, later.driven, (known.driven + later.driven) / 2))
        return (motion, later), motion

    return jax.lax.scan(step, (begin, known), (rows, gusts))[1]


def gyro_bias(model: AbstractModel, rates: Float[Numeric, "3"], row: Forcing, scalars: tuple) -> Float[Array, "3"]:
    """The bias of a gyro at these rates. It is part of the measurement, not of the motion."""
    return jnp.stack(model.observe(State(Rates(*rates)), row, scalars)[:3]) - rates
