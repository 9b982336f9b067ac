"""Filter error: maximum likelihood with disturbances that the model does not contain.

A real vehicle flies under a controller, which answers gusts and everything else that a model lacks. So the input and
the disturbance correlate. Methods that treat the disturbance as noise of the sensors are then biased, however long the
flight. Filter error makes the disturbance a part of the model. A Kalman filter estimates it from the past, and only the
innovations are compared: what the past cannot predict.

References: Jategaonkar, Flight Vehicle System Identification, ch. 5; Ljung, System Identification, ch. 7 and 13.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Parameters, Scalar, as_float, as_int
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import (
    REACH,
    AbstractEstimator,
    Estimate,
    check_bracket,
    check_count,
    check_dynamic_count,
    check_positive,
    conclude,
    fit_start,
)
from ..linalg import invert
from ..models.state import CASCADE_ORDER, Forcing
from ..shooting import Rows, ShootingProblem
from ..shooting.filtering import (
    Innovations,
    Noise,
    Observed,
    innovate,
)
from ..shooting.rows import windowed

# The number of samples in a lane. Specific force is compared as means over this time [s]: accelerometers feel
# vibrations, and their low-pass filters differ.
_LANE, BLOCK = 384, 0.25
# After so many samples a filter has settled.
_SETTLING = 128
# The least share of a block that must be measured.
_MEASURED = 0.125
# A gap of this length ends what a filter knows [s].
_GAP = 0.1
# Time constants of the disturbance at which searches for the noise start [s]: the likelihood has several maxima.
_STARTS = np.array([0.2, 0.03])
_SHORTEST, _LONGEST = 0.25, 3.0  # time constants: in samples, in seconds
_NOISE_REACH = 1e8  # factor to either side: simulated flights have no disturbance
NOISE_PRECISION = 1e-2  # of a weak prior on each logarithm
_LONGEST_STEP = 1.0  # of a logarithm
_NOISE_TOLERANCE = 0.1  # of the log-likelihood
_STALLED, _FLAT = 1e4, 0.1  # a damping, and the log-likelihood that is then left to gain
_DAMPING, _FACTOR, _LEAST, _MOST = 1e-2, 10.0, 1e-9, 1e8
# Added to the information about each logarithm of the noise: without it, steps along a flat likelihood are too long.
_NOISE_DAMPING = 1.0
Unknowns = Float[Array, " unknowns"]


class FilterFit(NamedTuple):
    """What filter error finds.

    - `parameters`, `covariance`: the estimate, and its covariance, which allows for the unknown noise and the prior.
    - `noise`: disturbances and sensors. `innovations`: at the estimate, for each lane.
    - `steps`: evaluations. `done`: whether the search ended by itself.
    """

    parameters: Parameters
    covariance: Float[Array, "parameters parameters"]
    noise: Noise
    innovations: Innovations
    steps: Int[Array, ""]
    done: Bool[Array, ""]


class _Search(NamedTuple):
    """The best unknowns so far with their innovations, the next trial, and its damping.

    Unknowns are the parameters, and then strength, time constant and sensor of each channel.
    """

    best: Unknowns
    innovations: Innovations
    trial: Unknowns
    cost: Scalar
    damping: Scalar
    steps: Int[Array, ""]
    done: Bool[Array, ""]


class _Region(NamedTuple):
    """Where a search may go, which unknowns it changes, and the prior: its center and its precision."""

    lower: Unknowns
    upper: Unknowns
    free: Bool[Array, " unknowns"]
    center: Unknowns
    precision: Unknowns


class FilterError(AbstractEstimator):
    """Maximum likelihood of the innovations of Kalman filters, by Gauss-Newton steps from the bracket's center.

    It compares the body rates, and specific force if the model predicts it. Each channel has a disturbance with its own
    strength and time constant, and its own sensor noise; all are estimated. The bracket is a Gaussian prior, whose
    standard deviation is the bracket's half-width.

    **Arguments:**

    - `tolerance`: the search ends once a step is shorter, in standard deviations of the estimate.
    - `max_steps`: of the search from one time constant of the disturbance.
    - `lane`: about how many samples are filtered in a row; lanes are filtered in parallel. A short lane loses
      information if the disturbance is weak, because its filter begins without memory.
    - `settling`: after so many samples a filter has settled.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = GAUSSIAN_PRIOR
    needs_network: ClassVar[bool] = False

    tolerance: Scalar = eqx.field(converter=as_float, default=0.1)
    max_steps: Count = eqx.field(converter=as_int, default=100)
    lane: int = eqx.field(static=True, default=_LANE)
    settling: int = eqx.field(static=True, default=_SETTLING)

    def __check_init__(self):
        check_positive("tolerance", self.tolerance)
        check_dynamic_count("max_steps", self.max_steps, 1)
        check_count("lane", self.lane, 1)
        check_count("settling", self.settling, 1)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. The estimate's `cost` is that of a simulation, as for all estimators.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        found = self.fit(problem, bracket)
        start, cost, sound, rollouts = fit_start(problem, found.parameters)
        return conclude(
            bracket,
            parameters=found.parameters,
            covariance=found.covariance,
            initial_state=start,
            cost=cost,
            rollouts=rollouts + found.steps * (1 + found.parameters.shape[0]),
            sweeps=found.steps,
            sound=sound & found.innovations.sound.all(),
            done=found.done,
            prior=GAUSSIAN_PRIOR,
        )

    def fit(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        *,
        held: Bool[Array | np.ndarray, " parameters"] | None = None,
        start: FilterFit | None = None,
    ) -> FilterFit:
        """The estimate with the noise, and without a simulation. The problem's windows do not matter.

        - `held`: which parameters stay at the bracket's center.
        - `start`: where the search starts. By default there are two searches, from the bracket's center.
        """
        check_bracket(problem, bracket)
        count, channels = bracket.lower.shape[0], problem.restrict("rates").columns.size
        given, first = np.asarray(start is not None), jnp.zeros(count + 3 * channels, dtype=float)
        if start is not None:
            first = jnp.concatenate([start.parameters, jnp.stack(start.noise, axis=1).ravel()])
        held = np.zeros(count, dtype=bool) if held is None else held
        return self._fit(problem, bracket, jnp.asarray(held), jnp.asarray(given), first)

    @eqx.filter_jit
    def _fit(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        held: Bool[Array, " parameters"],
        given: Bool[Array, ""],
        start: Unknowns,
    ) -> FilterFit:
        """`fit` with a `start` that counts only if it is `given`: one program for both."""
        problem, bracket = problem.restrict("rates"), bracket.usable
        index = lanes_of(problem.flight.time.shape[0], self.lane, self.settling)
        observed, dt, count = observed_of(problem, index, self.settling), problem.flight.dt, bracket.center.shape[0]
        innovations = innovations_of(problem, observed, index)

        def evaluate(unknowns: Unknowns) -> Innovations:
            return innovations(unknowns[:count], Noise(*unknowns[count:].reshape(-1, 3).T))

        noise = jnp.stack(_first_noise(observed, dt), axis=1)
        region = _region(bracket, held, noise, dt)

        def search(i: Int[Array, ""], found: _Search) -> _Search:
            """The better of the search so far and one from another time constant."""
            time_constant = jnp.log(jnp.asarray(_STARTS))[i]
            first = jnp.concatenate([found.best[:count], noise.at[:, 1].set(time_constant).ravel()])
            first = jnp.where(given, start, first)
            first = jnp.where(region.free, first, region.center)
            other = self._search(evaluate, first, region, count)
            better = ~(other.cost >= found.cost)
            other = other._replace(steps=found.steps + other.steps)
            return jax.tree.map(lambda a, b: jnp.where(better, a, b), other, found._replace(steps=other.steps))

        nothing = self._nothing(evaluate, jnp.concatenate([bracket.center, noise.ravel()]))
        found = jax.lax.fori_loop(0, jnp.where(given, 1, _STARTS.size), search, nothing)
        _, curvature = _posterior(found, region, count)
        free = region.free[:count]
        covariance = jnp.where(free[:, None] & free, invert(curvature)[:count, :count], 0.0)
        fitted = Noise(*found.best[count:].reshape(-1, 3).T)
        return FilterFit(found.best[:count], covariance, fitted, found.innovations, found.steps, found.done)

    def _nothing(self, evaluate: Callable[[Unknowns], Innovations], first: Unknowns) -> _Search:
        """A search before its first step, of infinite cost."""
        shapes = jax.eval_shape(evaluate, first)
        innovations = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        infinite, damping = jnp.full((), jnp.inf, dtype=float), jnp.full((), _DAMPING, dtype=float)
        steps, done = jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        return _Search(first, innovations, first, infinite, damping, steps, done)

    def _search(
        self, evaluate: Callable[[Unknowns], Innovations], first: Unknowns, region: _Region, count: int
    ) -> _Search:
        def move(search: _Search) -> _Search:
            now = evaluate(search.trial)
            cost, is_first = _cost(now, search.trial, region), search.steps == 0
            better = is_first | (cost < search.cost)
            best, innovations, cost = jax.tree.map(
                lambda new, old: jnp.where(better, new, old),
                (search.trial, now, cost),
                (search.best, search.innovations, search.cost),
            )
            factor = jnp.where(is_first, 1.0, jnp.where(better, 1 / _FACTOR, _FACTOR))
            damping = jnp.maximum(search.damping * factor, _LEAST)
            search = _Search(best, innovations, best, cost, damping, search.steps + 1, search.done)
            gradient, curvature = _posterior(search, region, count)
            # An unknown at its limit, which the gradient pushes beyond it, stays there.
            stuck = ((best <= region.lower) & (gradient > 0)) | ((best >= region.upper) & (gradient < 0))
            gradient, moves = jnp.where(stuck, 0.0, gradient), ~stuck[:, None] & ~stuck
            diagonal = jnp.diagonal(curvature)
            least = jnp.where(np.arange(diagonal.size) < count, 0.0, _NOISE_DAMPING)
            damped = jnp.where(moves, curvature, jnp.diag(diagonal)) + jnp.diag(diagonal * damping + least)
            step = -(invert(damped) * gradient).sum(axis=-1)
            longest = jnp.where(np.arange(step.size) < count, jnp.inf, _LONGEST_STEP)
            trial = jnp.clip(best + jnp.clip(step, -longest, longest), region.lower, region.upper)
            # What the step promises to gain: of the parameters, and of the noise, which matters less.
            promised, of_noise = -(gradient * step)[:count].sum(), -(gradient * step)[count:].sum()
            done = (promised < self.tolerance**2) & (of_noise < _NOISE_TOLERANCE) & (damping <= 1)
            # No step helps any more. The gradient, which leaves out how channels share noise, is as small as its error.
            stalled = (damping > _STALLED) & (damping * promised < _FLAT) & (damping * of_noise < 10 * _FLAT)
            return search._replace(trial=trial, done=done | stalled)

        return jax.lax.while_loop(
            lambda s: ~s.done & (s.steps < self.max_steps) & (s.damping < _MOST), move, self._nothing(evaluate, first)
        )


def _region(bracket: Bracket, held: Bool[Array, " parameters"], noise: Float[Array, "channels 3"], dt) -> _Region:
    center, half_width = bracket.center, jnp.where(held, 0.0, bracket.half_width)
    times = jnp.log(_SHORTEST * dt), np.log(_LONGEST)
    lower, upper = (noise + sign * np.log(_NOISE_REACH) for sign in (-1, 1))
    lower, upper = lower.at[:, 1].set(times[0]), upper.at[:, 1].set(times[1])
    precision = jnp.concatenate([1 / jnp.square(bracket.half_width), jnp.full(noise.size, NOISE_PRECISION)])
    return _Region(
        jnp.concatenate([center - REACH * half_width, lower.ravel()]),
        jnp.concatenate([center + REACH * half_width, upper.ravel()]),
        jnp.concatenate([~held, jnp.ones(noise.size, dtype=bool)]),
        jnp.concatenate([center, noise.ravel()]),
        precision,
    )


def _cost(innovations: Innovations, unknowns: Unknowns, region: _Region) -> Scalar:
    """The negative log-likelihood with the prior; infinite for a trajectory that fails."""
    cost = innovations.cost.sum() + (region.precision * jnp.square(unknowns - region.center)).sum() / 2
    return jnp.where(innovations.sound.all() & jnp.isfinite(cost), cost, jnp.inf)


def _posterior(search: _Search, region: _Region, count: int) -> tuple[Unknowns, Float[Array, "unknowns unknowns"]]:
    """Gradient and information about all unknowns, with the prior; a held parameter has only the prior's."""
    gradient, information = joint(
        search.innovations.gradient.sum(axis=-1), search.innovations.information.sum(axis=-1), count
    )
    gradient = gradient + region.precision * (search.best - region.center)
    information = jnp.where(region.free[:, None] & region.free, information, 0.0) + jnp.diag(region.precision)
    return jnp.where(region.free, gradient, 0.0), information


def joint(
    gradient: Float[Array, "channels some"], information: Float[Array, "channels some some"], count: int
) -> tuple[Unknowns, Float[Array, "unknowns unknowns"]]:
    """Gradient and information about all unknowns, from those of each channel about parameters and own noise."""
    channels = gradient.shape[0]
    size = count + 3 * channels
    total = jnp.concatenate([gradient[:, :count].sum(axis=0), gradient[:, count:].ravel()])
    whole = jnp.zeros((size, size), dtype=float).at[:count, :count].set(information[:, :count, :count].sum(axis=0))
    for i in range(channels):
        own = slice(count + 3 * i, count + 3 * (i + 1))
        whole = whole.at[:count, own].set(information[i, :count, count:])
        whole = whole.at[own, :count].set(information[i, count:, :count])
        whole = whole.at[own, own].set(information[i, count:, count:])
    return total, whole


def lanes_of(samples: int, wanted: int, settling: int = _SETTLING) -> Int[np.ndarray, "lanes time"]:
    """The samples of each lane, of which there are about `wanted` after those that settle its filter.

    A lane begins with the end of the lane before it, which its filter needs to settle. The first lane begins with the
    flight. Samples beyond the last do not exist.
    """
    lanes = max(round((samples - settling) / wanted), 1)
    settling = settling if lanes > 1 else 0
    length = -(-(samples - settling) // lanes)
    return length * np.arange(lanes)[:, None] + np.arange(settling + length)


def innovations_of(
    problem: ShootingProblem, observed: Observed, index: Int[np.ndarray, "lanes time"]
) -> Callable[[Parameters, Noise], Innovations]:
    """The innovations of a flight in the lanes of `lanes_of`, as a function of the parameters and the noise."""
    model, inputs, dt = problem.model, problem.flight.inputs, problem.flight.dt
    samples = np.minimum(index, problem.flight.time.shape[0] - 1)
    rows = Rows(windowed(problem.forcing(model.alpha), samples), ())

    def evaluate(parameters: Parameters, noise: Noise) -> Innovations:
        forced = problem.with_forcing(rows, parameters, inputs=inputs, index=samples)
        tangents = forced.forcing_tangents
        return innovate(
            problem.step,
            model.observe,
            observed,
            _lanes_last(forced.forcing),
            parameters,
            noise,
            dt,
            forcing_tangents=None if tangents is None else _lanes_last(tangents),
            forcing_parameters=model.forcing_parameters,
        )

    return evaluate


def _lanes_last(forcing: Forcing) -> Forcing:
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), forcing)


def observed_of(problem: ShootingProblem, index: Int[np.ndarray, "lanes time"], settling: int = _SETTLING) -> Observed:
    """The measurements in lanes, where filters restart, and which innovations count.

    A filter restarts in a gap, and where another stretch begins. Until it has settled its innovations do not count: the
    controller knew the disturbance then, and the filter does not. At the beginning of a flight in one piece they count:
    a simulation begins at rest.
    """
    flight, samples, lanes = problem.flight, problem.flight.time.shape[0], index.shape[0]
    row = np.arange(index.shape[1])
    exists, place = (index < samples).T, np.minimum(index, samples - 1)
    # Each sample counts in one lane.
    own = ((row >= settling) | (index[:, :1] == 0)).T
    measured = problem.measured()
    missing = jnp.isnan(measured[:, :3]).all(axis=1)
    stretch = jnp.zeros(samples, dtype=int) if flight.stretch is None else flight.stretch

    def follow(carry, row):
        gap, since = carry
        is_missing, another = row
        # In a long gap each sample restarts, so that no trajectory runs away there.
        restart = another | (gap * flight.dt >= _GAP)
        since = jnp.where(restart, 0, since + 1)
        return (jnp.where(is_missing, gap + 1, 0), since), (restart, since >= settling)

    another = jnp.concatenate([jnp.zeros(1, dtype=bool), jnp.diff(stretch) != 0])
    first = jnp.zeros((), dtype=int), jnp.full((), settling if flight.stretch is None else -1, dtype=int)
    _, (restart, settled) = jax.lax.scan(follow, first, (missing, another))

    def in_lanes(series: Array) -> Array:
        return jnp.moveaxis(series[place], 0, -1)  # lanes last

    known = None
    begins = np.broadcast_to(row[:, None] == 0, exists.shape)
    if problem.initial_state is not None:
        is_first = np.arange(lanes) == 0
        begins = begins & ~is_first
        known = jnp.where(is_first, problem.initial_state[CASCADE_ORDER[:3]][:, None], 0.0)
    restarts = in_lanes(restart) | begins | ~exists
    measured = jnp.where(exists[:, None], in_lanes(measured), jnp.nan)
    means, count, closes = _block_means(measured[:, 3:], restarts, flight.dt)
    counts = in_lanes(settled) & exists & own
    return Observed(jnp.concatenate([measured[:, :3], means], axis=1), restarts, counts, count, closes, known)


def _block_means(
    forces: Float[Array, "time forces lanes"], restart: Bool[Array, "time lanes"], dt: Scalar
) -> tuple[Array, Array, Array]:
    """Means over blocks at the last sample of each block and NaN elsewhere; the samples so far; where blocks end."""
    block = jnp.floor(np.arange(restart.shape[0] + 1) * dt / BLOCK + 1e-6)
    closes = jnp.broadcast_to((jnp.diff(block) != 0)[:, None], restart.shape)

    def add(carry, row):
        force, restart, closes = row
        total, measured, count = (jnp.where(restart, 0, leaf) for leaf in carry)
        known = ~jnp.isnan(force)
        total, measured, count = total + jnp.where(known, force, 0.0), measured + known, count + 1
        usable = closes & (measured >= _MEASURED * count) & (count * dt > BLOCK / 2)
        mean = jnp.where(usable, total / jnp.maximum(measured, 1), jnp.nan)
        return tuple(jnp.where(closes, 0, leaf) for leaf in (total, measured, count)), (mean, count)

    shape = forces.shape[1:]
    first = jnp.zeros(shape, dtype=float), jnp.zeros(shape, dtype=int), jnp.zeros(shape[1:], dtype=int)
    _, (means, count) = jax.lax.scan(add, first, (forces, restart, closes))
    return means, count, closes


def _first_noise(observed: Observed, dt: Scalar) -> Noise:
    """Where searches for the noise start, from differences of the measurements."""
    measured = observed.measured
    is_rate = np.arange(measured.shape[1]) < 3

    def power(values: Array) -> Array:
        known = ~jnp.isnan(values)
        return jnp.where(known, jnp.square(values), 0.0).sum(axis=(0, 2)) / jnp.maximum(known.sum(axis=(0, 2)), 1)

    # White noise has second differences of 6 times its variance.
    sensor = jnp.sqrt(power(jnp.diff(measured, n=2, axis=0)) / 6)
    change = jnp.sqrt(power(jnp.diff(measured, axis=0))) / dt / 2
    mean = jnp.nansum(measured, axis=(0, 2)) / jnp.maximum((~jnp.isnan(measured)).sum(axis=(0, 2)), 1)
    spread = jnp.sqrt(power(measured - mean[:, None])) / 2
    strength, sensor = jnp.where(is_rate, change, spread), jnp.where(is_rate, sensor, spread)
    usable = lambda values: jnp.log(jnp.where(values > 0, values, 1.0))  # noqa: E731
    return Noise(usable(strength), jnp.full(strength.shape, np.log(_STARTS[0])), usable(sensor))
