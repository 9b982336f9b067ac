"""The neural network (ANN): a map from a flight to parameters, trained on simulated flights of the same inputs.

The paper does not state its network; what follows is our choice.
"""

import math
import statistics
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, UInt32

from .._custom_types import Key, Scalar, as_float
from ..bracket import UNIFORM_PRIOR, Bracket
from ..errors import TrainingError
from ..estimate import AbstractEstimator, Calibration, Estimate
from ..flight import STATE_NAMES
from ..linalg import covariances
from ..models.state import CASCADE_ORDER, CHANNELS
from ..results import RESULTS
from ..shooting import ShootingProblem
from .architecture import Regressor, Scaling, compress, squared_error
from .features import FEATURES, AbstractFeatures, Coordinates
from .training import Pair, draw_many, split_key, train

APPROXIMATORS = ("mlp", "cmac")

# Levels of the intervals that are calibrated: evenly spaced in Gaussian standard deviations, from 50 to 99.9 %.
_NORMAL = statistics.NormalDist()
_LEVELS = np.array([2 * _NORMAL.cdf(z) - 1 for z in np.linspace(_NORMAL.inv_cdf(0.75), _NORMAL.inv_cdf(0.9995), 28)])
# Noise scales at which intervals are calibrated, evenly spaced in the logarithm.
_SCALES = 9
# Flights simulated at a time.
_CHUNK = 1000
# Random numbers drawn at a time for a network's first weights.
_DRAWN = 1024
# Flights, for each feature, and how much of a ridge to measure the features and the best linear answer with.
_PER_FEATURE = 4
_RIDGE = 1e-6
# Flights whose missing samples cost more than this factor in any parameter's precision are another problem.
_INFLATION = 2.0
# The largest number of features from which a network starts at the best linear answer, and what training may take.
_MOST_FEATURES = 6000
_MOST_STEPS = 1_000_000
# Numbers that are equal up to what a file's decimals lose.
_SAME = 1e-6


class _Errors(NamedTuple):
    """Of a network, by noise scale: standardised errors' root mean square, correlation, and quantiles over that."""

    scales: Float[Array, " scales"]
    rms: Float[Array, "scales parameters"]
    correlation: Float[Array, "scales parameters parameters"]
    factors: Float[Array, "scales levels parameters"]
    simultaneous: Float[Array, "scales levels"]


class NetworkEstimator(eqx.Module):
    """How a network is made and trained; `fit` trains it.

    **Arguments:**

    - `features`: `"score"`: one Gauss-Newton step at the bracket's center, a number for each unknown; `"raw"`: the
      normalised trajectory, in the manner of the paper.
    - `approximator`: `"mlp"`: a multilayer perceptron beside a linear skip; `"cmac"`: tile coding beside the same.
    - `channels`: what it looks at. The rates are nearly linear in the parameters over a whole bracket; attitude and
      position know more and are far from it.
    - `noise`: the lowest and highest noise that it is trained for, in multiples of the problem's sigma; drawn
      log-uniformly, and an input of the network.
    - `width`, `depth`: of the perceptron.
    - `steps`, `batch`, `learning_rate`: of the training, by Muon with a cosine schedule; a step simulates `batch`
      flights.
    - `patience`: training stops early after this many checks, of 250 steps each, without a better validation loss.
    - `held_out`: flights that calibrate the intervals, at each of nine noise scales.
    """

    features: str = eqx.field(static=True, default="score")
    approximator: str = eqx.field(static=True, default="mlp")
    channels: str = eqx.field(static=True, default="rates")
    noise: tuple[float, float] = eqx.field(static=True, default=(0.1, 10.0))
    width: int = eqx.field(static=True, default=128)
    depth: int = eqx.field(static=True, default=3)
    steps: int = eqx.field(static=True, default=10_000)
    batch: int = eqx.field(static=True, default=256)
    learning_rate: float = eqx.field(static=True, default=0.02)
    patience: int = eqx.field(static=True, default=10)
    held_out: int = eqx.field(static=True, default=20_000)

    def __check_init__(self):
        for name, choices in (("features", FEATURES), ("approximator", APPROXIMATORS), ("channels", CHANNELS)):
            if getattr(self, name) not in choices:
                raise ValueError(f"`{name}` must be one of {', '.join(choices)}, got {getattr(self, name)!r}.")
        if self.features == "raw" and self.approximator == "cmac":
            raise ValueError('`approximator` "cmac" tiles every pair of features: it needs `features` "score".')
        for name, least in (
            ("width", 1),
            ("depth", 0),
            ("steps", 1),
            ("batch", 1),
            ("patience", 1),
            ("held_out", 1000),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        if self.steps > _MOST_STEPS:
            raise ValueError(f"`steps` must be at most {_MOST_STEPS}, got {self.steps}.")
        if not (self.learning_rate > 0 and np.isfinite(self.learning_rate)):
            raise ValueError(f"`learning_rate` must be positive and finite, got {self.learning_rate}.")
        if not (len(self.noise) == 2 and 0 < self.noise[0] <= self.noise[1] < np.inf):
            raise ValueError(f"`noise` must be (lowest, highest), positive and finite, got {self.noise}.")

    def fit(self, problem: ShootingProblem, bracket: Bracket, *, key: Key, progress: bool = False) -> "TrainedNetwork":
        """Trains a network for the inputs, sampling, start and missing samples of a problem, and calibrates it.

        **Arguments:**

        - `problem`: its measured values are not used, but for the first where the initial state is free.
        - `bracket`: where the simulated flights' parameters lie.
        - `key`: of everything random: the same key gives the same network.
        - `progress`: whether to show a bar with the loss and the time left.

        **Raises:** `ValueError` for a bracket without width or channels that the problem lacks; `TrainingError` where
        training diverges, or the bracket's flights cannot be flown.
        """
        if CHANNELS[self.channels] > problem.size:
            raise ValueError(f"`channels` {self.channels!r} are more than the problem's {problem.channels!r}.")
        names = problem.model.parameter_names
        if bracket.lower.shape != (len(names),):
            raise ValueError(f"`bracket` must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")
        for name, lower, upper in zip(names, bracket.lower.tolist(), bracket.upper.tolist(), strict=True):
            if not 0 < upper - lower < np.inf:
                raise ValueError(f"`bracket` of {name} must have a positive, finite width, got [{lower}, {upper}].")
        numbers = problem.flight.time.shape[0] * CHANNELS[self.channels]
        if self.features == "raw" and numbers > _MOST_FEATURES:
            raise ValueError(
                f'`features` "raw" of this flight are {numbers} numbers, more than {_MOST_FEATURES}: use "score".'
            )
        start_key, train_key, held_out_key = split_key(key, 3)
        blank = untrained(self, problem.restrict(self.channels), bracket, start_key)
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, self.learning_rate, min(200, self.steps // 2), self.steps, 1e-3 * self.learning_rate
        )
        scaling = blank.scaling
        regressor, history = train(
            blank.regressor,
            lambda regressor, pair: squared_error(regressor, scaling, *pair),
            blank.features,
            as_float(np.asarray(self.noise)),
            optax.contrib.muon(schedule),
            batch=self.batch,
            steps=self.steps,
            validation=2 * _CHUNK,
            patience=self.patience,
            key=train_key,
            progress=progress,
        )
        errors = _calibrate(regressor, scaling, blank.features, blank.errors.scales, self.held_out, held_out_key)
        if not np.isfinite(np.asarray(errors.factors)).all():
            raise TrainingError("too few of the held-out flights can be flown to calibrate: narrow the bracket.")
        return TrainedNetwork(
            settings=self,
            features=blank.features,
            scaling=scaling,
            regressor=regressor,
            errors=errors,
            history=as_float(history),
            key=jax.random.key_data(key),
        )


class TrainedNetwork(AbstractEstimator):
    """A network that identifies flights of the inputs that it was trained for. Made by `NetworkEstimator.fit`.

    Its intervals hold the truth as often as they say over the bracket that it was trained in, whatever the network's
    quality: split-conformal prediction, on simulated flights that training did not see. That is an average over flights
    of parameters (and initial states) uniform in the bracket that can be flown, exact at nine noise scales and
    interpolated between them.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = UNIFORM_PRIOR
    needs_network: ClassVar[bool] = True

    settings: NetworkEstimator
    features: AbstractFeatures
    scaling: Scaling
    regressor: Regressor
    errors: _Errors
    history: Float[Array, "checks 2"]
    key: UInt32[Array, "..."]

    @property
    def channels(self) -> str:
        """What it looks at."""
        return self.settings.channels

    @property
    def problem(self) -> ShootingProblem:
        """What it was trained for: model, inputs, sampling, sigma, which samples were measured."""
        return self.features.problem

    @property
    def bracket(self) -> Bracket:
        """Where it was trained."""
        count = len(self.problem.model.parameter_names)
        return Bracket.around(self.features.coordinates.center[:count], self.features.coordinates.width[:count])

    def mismatch(self, problem: ShootingProblem) -> str | None:
        """What a problem differs in from the one that the network was trained for, in words; `None`: in nothing.

        What can only be known while tracing, inside `jit` or `vmap`, is left to the estimate's `result`.
        """
        own = self.problem
        if CHANNELS[self.channels] > problem.size:
            return f"it looks at {self.channels!r} channels, and the problem has {problem.channels!r}"
        if type(problem.model) is not type(own.model):
            return f"it was trained for {type(own.model).__name__}, not {type(problem.model).__name__}"
        if problem.method != own.method:
            return f"it was trained with the method {own.method!r}, not {problem.method!r}"
        if problem.flight.omega.shape != own.flight.omega.shape:
            return f"it was trained for {own.flight.omega.shape[0]} samples, not {problem.flight.omega.shape[0]}"
        if problem.windows != own.windows:
            return f"it was trained for {own.windows} windows, not {problem.windows}"
        if (problem.initial_state is None) != (own.initial_state is None):
            return "it was trained for an initial state that is " + ("free" if own.initial_state is None else "known")
        looked_at = CASCADE_ORDER[: own.size]
        if not isinstance(problem.flight.states, Tracer):
            absent, unneeded = (np.isnan(np.asarray(p.flight.states)) for p in (problem, own))
            missing = [STATE_NAMES[i] for i in looked_at if absent[:, i].all() and not unneeded[:, i].all()]
            if missing:
                return f"it looks at {', '.join(missing)}, which this flight did not measure"
        for what, other in self._differences(problem).items():
            if not isinstance(other, Tracer) and bool(other):
                return f"it was trained for another {what}"
        return None

    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        Of `bracket` only the validity counts: the network looks where it was trained to look. An answer that lies
        outside that, by more than its interval, has the result `at_bound`; one whose interval is hardly narrower than
        the bracket in some parameter, `unidentifiable`. A flight with more noise than the network
        was trained for, or with too many samples missing, has the result `network_mismatch`.

        **Raises:** `ValueError` that says so where the network was trained for something else. What differs from lane
        to lane inside `jit` or `vmap` gets the result `network_mismatch` instead.
        """
        different = self.mismatch(problem)
        if different is not None:
            raise ValueError(f"The network cannot be used on this problem: {different}.")
        return self._identify(problem.restrict(self.channels), bracket)

    @eqx.filter_jit
    def _identify(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        count, coordinates = len(problem.model.parameter_names), self.features.coordinates
        scale = self._scale(problem)
        within = jnp.clip(scale, *self.settings.noise)
        seen = self.features(problem)
        finite = jnp.isfinite(seen.values).all()
        answer = self.regressor(jnp.where(finite, seen.values, 0.0), within, self.scaling)
        parameters, initial_state = coordinates.split(answer.u, count)

        rms, correlation, factors, simultaneous = _at_scale(self.errors, within)
        std = jnp.exp(answer.log_spread[:count]) * self.scaling.bound(within)[:count] * rms * seen.inflation
        deviations = std * coordinates.width[:count]
        shot = problem.shots(parameters, initial_state)
        outside = jnp.abs(answer.u[:count]) > 1 + factors[-1] * std
        vague = std > self.prior

        other = jnp.stack(list(self._differences(problem).values())).any()
        other |= (seen.inflation > _INFLATION).any() | (scale > self.settings.noise[1] * (1 + _SAME))
        result = RESULTS.where(outside.any(), RESULTS.at_bound, RESULTS.successful)
        result = RESULTS.where(vague.any(), RESULTS.unidentifiable, result)
        sound = finite & shot.sound & jnp.isfinite(parameters).all()
        result = RESULTS.where(sound, result, RESULTS.nonfinite_trajectory)
        result = RESULTS.where(other, RESULTS.network_mismatch, result)
        result = RESULTS.where(bracket.valid, result, RESULTS.bracket_invalid)
        told = sound & ~other & bracket.valid
        return Estimate(
            parameters=jnp.where(told, parameters, self.bracket.center),
            covariance=jnp.where(told, correlation * deviations[:, None] * deviations[None, :], jnp.inf),
            initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
            cost=jnp.where(told, shot.cost, jnp.inf),
            rollouts=jnp.ones((), dtype=int),
            sweeps=jnp.zeros((), dtype=int),
            result=result,
            calibration=Calibration(as_float(_LEVELS), factors, simultaneous),
        )

    def _scale(self, problem: ShootingProblem) -> Scalar:
        """The noise in multiples of that of training: the largest of the channels'."""
        order = CASCADE_ORDER[: CHANNELS[self.channels]]
        return (problem.sigma[order] / self.problem.sigma[order]).max()

    @eqx.filter_jit
    def _differences(self, problem: ShootingProblem) -> dict[str, Bool[Array, ""]]:
        """Whether numbers differ from those of training, by what they are."""
        own, size = self.problem, CHANNELS[self.channels]

        def differ(a, b, tolerance) -> Bool[Array, ""]:
            a, b = as_float(a), as_float(b)
            return ~((a == b) | (jnp.abs(a - b) <= tolerance)).all()

        fastest = jnp.abs(own.flight.omega).max()
        theirs, ours = (jax.tree.leaves(p.model.airframe) for p in (problem, own))
        airframe = [differ(a, b, _SAME * jnp.abs(b).max()) for a, b in zip(theirs, ours, strict=True)]
        width = self.features.coordinates.width[len(own.model.parameter_names) :]
        first_state, theirs_off = (problem.split(x)[:, :size].ravel() for x in problem.first_state())
        start = first_state - self.features.coordinates.first_state
        off = 1.5 * width + theirs_off if width.size else _SAME * (1 + jnp.abs(self.features.coordinates.first_state))
        return {
            "airframe": jnp.stack(airframe).any(),
            "sample time": differ(problem.flight.dt, own.flight.dt, _SAME * own.flight.dt),
            "series of rotor speeds": differ(problem.flight.omega, own.flight.omega, _SAME * fastest),
            "start": ~(jnp.abs(start) <= off).all(),
        }


@eqx.filter_jit
def untrained(settings: NetworkEstimator, problem: ShootingProblem, bracket: Bracket, key: Key) -> TrainedNetwork:
    """The network before training: its inputs and outputs scaled, its skip the best linear answer."""
    scales = as_float(np.asarray(settings.noise))
    coordinates = Coordinates.of(problem, bracket, scales[1])
    features = FEATURES[settings.features].of(problem, coordinates)
    count = len(problem.model.parameter_names)
    first_key, sample_key = jax.random.split(key)

    start = coordinates.split(jnp.zeros_like(coordinates.center), count)
    # Of each window, the parameters' first: as the unknowns are ordered, every window after the other.
    std = jnp.sqrt(jax.vmap(jnp.diagonal)(covariances(problem.curvatures(*start).information, count)))
    unit = jnp.concatenate([std[0, :count], std[:, count:].ravel()]) / coordinates.width

    samples = draw_many(features, scales, max(_CHUNK, _PER_FEATURE * features.size), key=sample_key)
    flown = jnp.isfinite(samples.features).all(axis=1)
    width = 1.5 * jnp.nanmedian(jnp.where(flown[:, None], jnp.abs(samples.features), jnp.nan), axis=0)
    # All inputs together are as large as if there were one for each unknown, so that one learning rate fits both kinds.
    width = jnp.where(width > 0, width, 1.0) * jnp.sqrt(features.size / unit.shape[0])
    # The best linear answer is where training starts.
    seen = jnp.where(flown[:, None], compress(samples.features / width), 0.0)
    wanted = jnp.where(flown[:, None], samples.u, 0.0)
    ridge = _RIDGE * jnp.trace(seen.T @ seen) / features.size
    skip = jnp.linalg.solve(seen.T @ seen + ridge * jnp.eye(features.size), seen.T @ wanted).T
    gain = jnp.minimum(10 * unit, 1.0)
    span = jnp.maximum(jnp.abs(jnp.log(scales)).max(), 1.0)
    regressor = _regressor(settings, skip, first_key)
    levels = 1 if settings.noise[0] == settings.noise[1] else _SCALES
    return TrainedNetwork(
        settings=settings,
        features=features,
        scaling=Scaling(width, unit, gain, span),
        regressor=regressor,
        errors=_Errors(
            jnp.geomspace(scales[0], scales[1], levels),
            jnp.ones((levels, count)),
            jnp.tile(jnp.eye(count), (levels, 1, 1)),
            jnp.ones((levels, len(_LEVELS), count)),
            jnp.ones((levels, len(_LEVELS))),
        ),
        history=jnp.zeros((0, 2)),
        key=jax.random.key_data(key),
    )


def _regressor(settings: NetworkEstimator, skip: Float[Array, "unknowns features"], key: Key) -> Regressor:
    """A `Regressor` whose layers begin as Equinox's do, uniform within 1 / sqrt(inputs), but from one draw of numbers.

    A draw for each array would take XLA five seconds to compile.
    """

    def layers(regressor: Regressor) -> list[eqx.nn.Linear]:
        found = jax.tree.leaves(regressor, is_leaf=lambda x: isinstance(x, eqx.nn.Linear))
        return [layer for layer in found if isinstance(layer, eqx.nn.Linear)]

    def arrays(regressor: Regressor) -> list:
        return [array for layer in layers(regressor) for array in (layer.weight, layer.bias)]

    def make(key: Key) -> Regressor:
        return Regressor(skip, settings.approximator, width=settings.width, depth=settings.depth, key=key)

    # All that is no layer begins at 0, but for the skip.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf,
        eqx.filter_eval_shape(make, key),
    )
    limits = [1 / math.sqrt(layer.weight.shape[1]) for layer in layers(blank) for _ in ("weight", "bias")]
    shapes = [array.shape for array in arrays(blank)]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    keys = jax.random.split(key, -(-int(ends[-1]) // _DRAWN))
    drawn = jax.lax.map(lambda k: jax.random.uniform(k, (_DRAWN,), minval=-1, maxval=1, dtype=float), keys).ravel()
    values = [
        limit * part.reshape(shape)
        for limit, part, shape in zip(limits, jnp.split(drawn[: ends[-1]], ends[:-1]), shapes, strict=True)
    ]
    return eqx.tree_at(lambda r: [r.skip, *arrays(r)], blank, [skip, *values])


@eqx.filter_jit
def _calibrate(
    regressor: Regressor,
    scaling: Scaling,
    features: AbstractFeatures,
    scales: Float[Array, " scales"],
    count: int,
    key: Key,
) -> _Errors:
    """The errors on flights that training did not see; a quantile is the least that keeps its level for one more."""
    parameters = len(features.problem.model.parameter_names)

    def standardised(pair: Pair) -> Float[Array, " parameters"]:
        answer = regressor(pair.features, pair.scale, scaling)
        return ((answer.u - pair.u) / (scaling.bound(pair.scale) * jnp.exp(answer.log_spread)))[:parameters]

    def at(number_and_scale):
        number, scale = number_and_scale
        scale_key = jax.random.fold_in(key, number)

        def some(chunk):
            pairs = draw_many(features, jnp.stack([scale, scale]), _CHUNK, key=jax.random.fold_in(scale_key, chunk))
            return jax.vmap(standardised)(pairs)

        error = jax.lax.map(some, jnp.arange(-(-count // _CHUNK))).reshape(-1, parameters)
        flown = jnp.isfinite(error).all(axis=1)
        error = jnp.where(flown[:, None], error, 0.0)
        moments = error.T @ error / flown.sum()
        rms = jnp.sqrt(jnp.diagonal(moments))
        relative = jnp.where(flown[:, None], jnp.abs(error) / rms, jnp.inf)
        ordered = jnp.sort(jnp.column_stack([relative, relative.max(axis=1)]), axis=0)
        rank = jnp.ceil((flown.sum() + 1) * as_float(_LEVELS)).astype(int) - 1
        quantiles = jnp.where((rank < flown.sum())[:, None], ordered[jnp.minimum(rank, flown.size - 1)], jnp.inf)
        return rms, moments / (rms[:, None] * rms[None, :]), quantiles[:, :-1], quantiles[:, -1]

    numbers = jnp.arange(scales.shape[0])
    return _Errors(scales, *jax.lax.map(at, (numbers, scales)))


def _at_scale(
    errors: _Errors, scale: Scalar
) -> tuple[
    Float[Array, " parameters"],
    Float[Array, "parameters parameters"],
    Float[Array, "levels parameters"],
    Float[Array, " levels"],
]:
    """Interpolated between the noise scales."""
    knots = jnp.log(errors.scales)

    def at(table):
        flat = table.reshape(table.shape[0], -1)
        return jax.vmap(lambda column: jnp.interp(jnp.log(scale), knots, column), in_axes=1)(flat).reshape(
            table.shape[1:]
        )

    return at(errors.rms), at(errors.correlation), at(errors.factors), at(errors.simultaneous)
