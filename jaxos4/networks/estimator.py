"""The settings and the training of a network, the paper's neural network (ANN): from a flight to parameters.

The paper does not describe its network; architecture, features and training are our choice.
"""

import contextlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from .._custom_types import Key, as_float
from ..bracket import Bracket
from ..errors import TrainingError
from ..estimate import check_bracket
from ..models.state import CHANNELS
from ..shooting import ShootingProblem
from .architecture import squared_error
from .calibration import CHUNK, calibrate, uncalibrated
from .features import FEATURES, Coordinates
from .first_weights import first_regressor, scaling_and_linear_map
from .progress_bar import training_bar
from .trained import TrainedNetwork
from .training import Progress, split_key, train

APPROXIMATORS = ("mlp", "cmac")

# The first linear map is a matrix of features times features: more features than this do not fit in memory.
_MOST_FEATURES = 6000
_MOST_STEPS = 1_000_000
_WARM_UP_STEPS = 200
_LAST_RATE = 1e-3  # the learning rate at the end of training, relative to the largest


class NetworkEstimator(eqx.Module):
    """The settings of a network and of its training; `fit` trains it.

    **Arguments:**

    - `features`: `"score"`: one Gauss-Newton step at the bracket's center, a number for each unknown; `"raw"`: the
      normalised trajectory, as in the paper.
    - `approximator`: what corrects the linear map: `"mlp"`, a multilayer perceptron, or `"cmac"`, tile coding.
    - `channels`: the channels that the network looks at. Rates are nearly linear in the parameters over a whole
      bracket; attitude and position hold more information, but are far from linear.
    - `noise`: the lowest and highest noise scale of training, in multiples of the problem's sigma. Scales are drawn
      log-uniformly, and the scale is an input of the network.
    - `width`, `depth`: of the perceptron.
    - `steps`, `batch`, `learning_rate`: of the training, by Muon with a cosine schedule; a step simulates `batch`
      flights.
    - `patience`: training stops early after this many checks, of 250 steps each, without a better validation loss.
    - `held_out`: simulated flights for the calibration of the intervals, at each of nine noise scales.

    **Raises:** `ValueError` for a setting out of range.
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
        smallest = {"width": 1, "depth": 0, "steps": 1, "batch": 1, "patience": 1, "held_out": 1000}
        for name, least in smallest.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        if self.steps > _MOST_STEPS:
            raise ValueError(f"`steps` must be at most {_MOST_STEPS}, got {self.steps}.")
        if not (self.learning_rate > 0 and np.isfinite(self.learning_rate)):
            raise ValueError(f"`learning_rate` must be positive and finite, got {self.learning_rate}.")
        if not (len(self.noise) == 2 and 0 < self.noise[0] <= self.noise[1] < np.inf):
            raise ValueError(f"`noise` must be (lowest, highest), positive and finite, got {self.noise}.")

    def fit(
        self, problem: ShootingProblem, bracket: Bracket, *, key: Key, progress: bool | Progress = False
    ) -> TrainedNetwork:
        """Trains a network for the inputs, sampling, start and missing samples of a problem, and calibrates it.

        **Arguments:**

        - `problem`: its measured values are not used, except the first if the initial state is free.
        - `bracket`: parameters of the simulated flights are uniform in it.
        - `key`: the random key: the same key gives the same network.
        - `progress`: `True` shows a bar in the terminal; a function is called at every check with the steps done, the
          number of steps, and the validation loss.

        **Raises:** `ValueError` for a bracket without width or channels that the problem lacks; `TrainingError` if
        training diverges, or if the flights of the bracket diverge.
        """
        self._check(problem, bracket)
        start_key, train_key, held_out_key = split_key(key, 3)
        blank = self.untrained(problem.restrict(self.channels), bracket, start_key)
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, self.learning_rate, min(_WARM_UP_STEPS, self.steps // 2), self.steps, _LAST_RATE * self.learning_rate
        )
        scaling = blank.scaling
        bar = training_bar(self.steps) if progress is True else contextlib.nullcontext(progress or None)
        with bar as report:
            regressor, history = train(
                blank.regressor,
                lambda regressor, pair: squared_error(regressor, scaling, *pair),
                blank.features,
                as_float(np.asarray(self.noise)),
                optax.contrib.muon(schedule),
                batch=self.batch,
                steps=self.steps,
                validation=2 * CHUNK,
                patience=self.patience,
                key=train_key,
                progress=report,
            )
        errors = calibrate(regressor, scaling, blank.features, blank.errors.scales, self.held_out, held_out_key)
        if not np.isfinite(np.asarray(errors.factors)).all():
            raise TrainingError("too few of the held-out flights can be flown to calibrate: narrow the bracket.")
        return TrainedNetwork(
            self, blank.features, scaling, regressor, errors, as_float(history), jax.random.key_data(key)
        )

    @eqx.filter_jit
    def untrained(self, problem: ShootingProblem, bracket: Bracket, key: Key) -> TrainedNetwork:
        """The network before training, for a problem with its channels: scaled, with its linear map fitted."""
        scales = as_float(np.asarray(self.noise))
        features = FEATURES[self.features].of(problem, Coordinates.of(problem, bracket, scales[1]))
        first_key, sample_key = jax.random.split(key)
        scaling, linear_map = scaling_and_linear_map(features, scales, sample_key)
        regressor = first_regressor(linear_map, self.approximator, width=self.width, depth=self.depth, key=first_key)
        errors = uncalibrated(self.noise, len(problem.model.parameter_names))
        return TrainedNetwork(self, features, scaling, regressor, errors, jnp.zeros((0, 2)), jax.random.key_data(key))

    def _check(self, problem: ShootingProblem, bracket: Bracket) -> None:
        if CHANNELS[self.channels] > problem.size:
            raise ValueError(f"`channels` {self.channels!r} are more than the problem's {problem.channels!r}.")
        check_bracket(problem, bracket)
        names = problem.model.parameter_names
        for name, lower, upper in zip(names, bracket.lower.tolist(), bracket.upper.tolist(), strict=True):
            if not 0 < upper - lower < np.inf:
                raise ValueError(f"`bracket` of {name} must have a positive, finite width, got [{lower}, {upper}].")
        numbers = problem.flight.time.shape[0] * CHANNELS[self.channels]
        if self.features == "raw" and numbers > _MOST_FEATURES:
            what = f"of this flight are {numbers} numbers, more than {_MOST_FEATURES}"
            raise ValueError(f'`features` "raw" {what}: use "score".')
