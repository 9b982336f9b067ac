"""The paper's neural network (ANN): settings, use, and networks for one flight. The paper does not describe it."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, UInt32

from .._custom_types import Key, Parameters, Scalar, as_float, integer, setting
from ..batching import in_blocks
from ..bracket import UNIFORM_PRIOR, Bracket
from ..errors import check_choice, named
from ..estimate import AbstractEstimator, Calibration, Estimate
from ..flight import STATE_NAMES
from ..linalg import invert
from ..models.state import CASCADE_ORDER, CHANNELS
from ..results import RESULTS
from ..shooting import ShootingProblem, Unknowns
from .architecture import ARCHITECTURES, LEVELS, ErrorTable, Regressor, Scaling
from .features import FEATURES, Coordinates, Features
from .training import calibrate, train, untrained

# What must be equal in training and in use: kinds, with the words that name them, and numbers.
_KINDS: dict[str, Callable[[ShootingProblem], Any]] = {
    "for {}": lambda problem: type(problem.model).__name__,
    "for the parameters {}": lambda problem: ", ".join(problem.model.parameter_names),
    "with the method {}": lambda problem: repr(problem.method),
    "for {} samples": lambda problem: problem.flight.omega.shape[0],
    "for {} windows": lambda problem: problem.windows,
    "for an initial state that is {}": lambda problem: "free" if problem.initial_state is None else "known",
}
_QUANTITIES: dict[str, Callable[[ShootingProblem], Any]] = {
    "airframe": lambda problem: problem.model.airframe,
    "model": lambda problem: eqx.tree_at(lambda m: m.airframe, problem.model, None),
    "sample time": lambda problem: problem.flight.dt,
    "series of rotor speeds": lambda problem: problem.flight.omega,
}


MAX_FEATURES = 6000  # the first linear map is a matrix of features times features, which must fit in memory
MAX_STEPS = 1_000_000  # of training


class NetworkEstimator(eqx.Module):
    """The settings of a network and of its training; `fit` trains it.

    - `features`: `"score"`: one Gauss-Newton step at the bracket's center, a number for each unknown; `"raw"`: the
      normalised trajectory, as in the paper.
    - `channels`: the channels that the network looks at. Rates are nearly linear in the parameters over a whole
      bracket; attitude and position hold more information, but are far from linear.
    - `noise`: the lowest and highest noise scale of training, in multiples of the problem's sigma. Scales are drawn
      log-uniformly, and the scale is an input of the network.
    - `architecture`: the correction of a linear map: `"mlp"`, a multilayer perceptron, or `"cmac"`, a table of weights.
    - `width`, `depth`: of the perceptron.
    - `tilings`, `cells`: of CMAC, for each pair of score features: the number of tilings, and of cells along each side.
      Finer cells represent more, and learn more slowly.
    - `steps`, `batch`, `learning_rate`: of the training, by Muon with a cosine schedule; a step uses `batch` flights,
      and each flight is used about four times, with new noise.
    - `patience`: training stops early after this many checks, of 250 steps each, without a better validation loss.
    - `held_out`: simulated flights for the calibration of the intervals, each with new noise at nine noise scales.

    **Raises:** `ValueError` for a setting out of range.
    """

    features: str = eqx.field(static=True, default="score")
    channels: str = eqx.field(static=True, default="rates")
    noise: tuple[float, float] = eqx.field(static=True, default=(0.1, 10.0))
    width: int = eqx.field(static=True, converter=integer("width", 1, static=True), default=128)
    depth: int = eqx.field(static=True, converter=integer("depth", 1, static=True), default=3)
    steps: int = eqx.field(static=True, converter=integer("steps", 1, static=True), default=4000)
    batch: int = eqx.field(static=True, converter=integer("batch", 1, static=True), default=256)
    learning_rate: float = eqx.field(static=True, default=0.01)
    patience: int = eqx.field(static=True, converter=integer("patience", 1, static=True), default=10)
    held_out: int = eqx.field(static=True, converter=integer("held_out", 1000, static=True), default=20_000)
    architecture: str = eqx.field(static=True, default="mlp")
    tilings: int = eqx.field(static=True, converter=integer("tilings", 1, static=True), default=16)
    cells: int = eqx.field(static=True, converter=integer("cells", 2, static=True), default=12)

    def __check_init__(self):
        for name, choices in (("features", FEATURES), ("channels", CHANNELS), ("architecture", ARCHITECTURES)):
            check_choice(name, getattr(self, name), choices)
        if self.steps > MAX_STEPS:
            raise ValueError(f"`steps` must be at most {MAX_STEPS}, got {self.steps}.")
        setting("learning_rate", positive=True)(self.learning_rate)
        if self.architecture == "cmac" and self.features != "score":
            raise ValueError(f'`architecture` "cmac" needs `features` "score", got {self.features!r}.')
        if not (len(self.noise) == 2 and 0 < self.noise[0] <= self.noise[1] < np.inf):
            raise ValueError(f"`noise` must be (lowest, highest), positive and finite, got {self.noise}.")

    @property
    def shape(self) -> dict[str, Any]:
        """The settings of the architecture."""
        return {name: getattr(self, name) for name in ARCHITECTURES[self.architecture][1]}

    def fit(self, problem: ShootingProblem, bracket: Bracket, *, key: Key) -> "TrainedNetwork":
        """Trains a network for the inputs, sampling, start and missing samples of a problem, and calibrates it.

        - `problem`: its measured values are not used, except the first if the initial state is free.
        - `bracket`: parameters of the simulated flights are uniform in it.
        - `key`: the random key: the same key gives the same network.

        **Raises:** `ValueError` for a bracket without width or channels that the problem lacks; `TrainingError` if
        training diverges, or if the flights of the bracket diverge.
        """
        self._check(problem, bracket)
        features = _prepared(self.features, problem.restrict(self.channels), bracket, as_float(self.noise[1]))
        scaling, regressor = untrained(features, self, key)
        regressor, history = train(regressor, scaling, features, self, key)
        errors = calibrate(regressor, scaling, features, self, key)
        return TrainedNetwork(self, features, scaling, regressor, errors, as_float(history), jax.random.key_data(key))

    def _check(self, problem: ShootingProblem, bracket: Bracket) -> None:
        if CHANNELS[self.channels] > problem.size:
            raise ValueError(f"`channels` {self.channels!r} are more than the problem's {problem.channels!r}.")
        problem.within(bracket)  # raises for another length
        names = problem.model.parameter_names
        for name, lower, upper in zip(names, bracket.lower.tolist(), bracket.upper.tolist(), strict=True):
            if not 0 < upper - lower < np.inf:
                raise ValueError(f"`bracket` of {name} must have a positive, finite width, got [{lower}, {upper}].")
        numbers = problem.flight.time.shape[0] * CHANNELS[self.channels]
        if self.features == "raw" and numbers > MAX_FEATURES:
            what = f"of this flight are {numbers} numbers, more than {MAX_FEATURES}"
            raise ValueError(f'`features` "raw" {what}: use "score".')


@eqx.filter_jit
def _prepared(features: str, problem: ShootingProblem, bracket: Bracket, noise: Scalar) -> Features:
    return Features.of(features, problem, Coordinates.of(problem, bracket, noise))


MAX_INFLATION = 2.0  # if missing samples enlarge a standard deviation by more, the problem is another one
SAME = 1e-6  # relative tolerance of equal numbers, because files round them


class TrainedNetwork(AbstractEstimator):
    """A network that identifies flights of the inputs that it was trained for. Made by `NetworkEstimator.fit`.

    Its intervals are calibrated on simulated flights that training did not use (split-conformal prediction): they hold
    the truth in the share of their level, over flights that do not diverge, uniform in the bracket of training.
    """

    looks_at: ClassVar[str] = "rates"
    largest_std: ClassVar[float] = UNIFORM_PRIOR
    needs_network: ClassVar[bool] = True

    settings: NetworkEstimator
    features: Features
    scaling: Scaling
    regressor: Regressor
    errors: ErrorTable
    history: Float[Array, "checks 2"]
    key: UInt32[Array, "..."]

    @property
    def channels(self) -> str:
        """The channels that the network looks at."""
        return self.settings.channels

    @property
    def problem(self) -> ShootingProblem:
        """The problem of training."""
        return self.features.problem

    @property
    def bracket(self) -> Bracket:
        """The bracket of training."""
        count = len(self.problem.model.parameter_names)
        return Bracket.around(self.features.coordinates.center[:count], self.features.coordinates.width[:count])

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight in the network's own bracket; the problem's bracket only has to be valid.

        Parameters that the problem fixes count as known.

        **Returns:** an estimate, `at_bound` if the answer lies outside of the bracket of training by more than its
        interval, `unidentifiable` if an interval is hardly narrower than the bracket, and `network_mismatch` for more
        noise than in training, or too many missing samples.

        **Raises:** `ValueError` with what differs from the problem of training. Inside `jit` or `vmap`, numbers that
        differ give `network_mismatch` instead.
        """
        answer = self._compare(problem.within(bracket))
        if isinstance(answer, str):
            raise ValueError(f"The network cannot be used on this problem: {answer}; train a network for it.")
        return answer

    def mismatch(self, problem: ShootingProblem) -> str | None:
        """The difference from the problem of training, in words, or `None`. Traced numbers are not compared."""
        answer = self._compare(problem)
        return answer if isinstance(answer, str) else None

    def _compare(self, problem: ShootingProblem) -> Estimate | str:
        """The estimate, or how the problem differs from that of training. One program computes both."""
        own = self.problem
        if CHANNELS[self.channels] > problem.size:
            return f"it looks at {self.channels!r} channels, and the problem has {problem.channels!r}"
        for words, kind in _KINDS.items():
            if kind(problem) != kind(own):
                return f"it was trained {words.format(kind(own))}, not {kind(problem)}"
        if not isinstance(problem.flight.states, Tracer):
            absent, not_needed = (np.isnan(np.asarray(p.flight.states)) for p in (problem, own))
            looked_at = [i for i in CASCADE_ORDER[: own.size] if not not_needed[:, i].all()]
            if missing := [STATE_NAMES[i] for i in looked_at if absent[:, i].all()]:
                return f"it looks at {', '.join(missing)}, which this flight did not measure"
        estimate, differences = self._identify(problem.restrict(self.channels))
        for what, differs in differences.items():
            if not isinstance(differs, Tracer) and differs:
                return f"it was trained for another {what}"
        return estimate

    def _differences(self, problem: ShootingProblem) -> dict[str, Bool[Array, ""]]:
        """For each quantity, whether its numbers differ from those of training."""
        own, coordinates, size = self.problem, self.features.coordinates, CHANNELS[self.channels]

        def differ(quantity: Callable[[ShootingProblem], Any]) -> Bool[Array, ""]:
            pairs = zip(*(map(as_float, jax.tree.leaves(quantity(p))) for p in (problem, own)), strict=True)
            same = [((a == b) | (jnp.abs(a - b) <= SAME * jnp.abs(b).max())).all() for a, b in pairs]
            return ~jnp.asarray(same, bool).all()

        width = coordinates.width[len(own.model.parameter_names) :]
        first_state, off = (problem.split(x)[:, :size].ravel() for x in problem.first_state())
        allowed = 1.5 * width + off if width.size else SAME * (1 + jnp.abs(coordinates.first_state))
        start = ~(jnp.abs(first_state - coordinates.first_state) <= allowed).all()
        return {what: differ(quantity) for what, quantity in _QUANTITIES.items()} | {"start": start}

    @eqx.filter_jit
    def _identify(self, problem: ShootingProblem) -> tuple[Estimate, dict[str, Bool[Array, ""]]]:
        return in_blocks(self._answer, problem)

    def _answer(self, problem: ShootingProblem) -> tuple[Estimate, dict[str, Bool[Array, ""]]]:
        """The estimate of one flight, or of a block of flights, and `_differences`."""
        count, coordinates = len(problem.model.parameter_names), self.features.coordinates
        order = CASCADE_ORDER[: CHANNELS[self.channels]]
        scale = (problem.sigma[order] / self.problem.sigma[order]).max()  # of the noise, in multiples of the training's
        within = jnp.clip(scale, *self.settings.noise)
        values, inflation = self.features(problem)
        finite = jnp.isfinite(values).all()
        u, log_spread = self.regressor(jnp.where(finite, values, 0.0), within, self.scaling)
        parameters, initial_state = coordinates.split(u, count)

        rms, correlation, factors, simultaneous = self.errors.at(within)
        std = jnp.exp(log_spread[:count]) * self.scaling.bound(within)[:count] * rms * inflation
        deviations = std * coordinates.width[:count]
        parameters, correlation = _given_fixed(problem.unknowns, parameters, deviations, correlation)
        cost, flies = problem.shots(parameters, initial_state)
        free = problem.unknowns.free
        outside = (jnp.abs(u[:count]) > 1 + factors[-1] * std) & free
        unidentifiable = (std > self.largest_std) & free

        differences = self._differences(problem)
        other = jnp.stack(list(differences.values())).any()
        other |= (inflation > MAX_INFLATION).any() | (scale > self.settings.noise[1] * (1 + SAME))
        result = RESULTS.where(outside.any(), RESULTS.at_bound, RESULTS.successful)
        result = RESULTS.where(unidentifiable.any(), RESULTS.unidentifiable, result)
        feasible = finite & flies & jnp.isfinite(parameters).all()
        result = RESULTS.where(feasible, result, RESULTS.nonfinite_trajectory)
        result = RESULTS.where(other, RESULTS.network_mismatch, result)
        result = RESULTS.where(problem.unknowns.valid, result, RESULTS.bracket_invalid)
        usable = feasible & ~other & problem.unknowns.valid
        estimate = Estimate(
            parameters=jnp.where(usable, parameters, self.bracket.center),
            covariance=jnp.where(usable, correlation * deviations[:, None] * deviations[None, :], jnp.inf),
            initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
            cost=jnp.where(usable, cost, jnp.inf),
            rollouts=jnp.ones((), dtype=int),
            sweeps=jnp.zeros((), dtype=int),
            result=result,
            calibration=Calibration(as_float(LEVELS), factors, simultaneous),
        )
        return estimate, differences


def _given_fixed(
    unknowns: Unknowns, parameters: Parameters, deviations: Parameters, correlation: Float[Array, "count count"]
) -> tuple[Parameters, Float[Array, "count count"]]:
    """The mean and the correlations of a Gaussian answer if the fixed parameters are known."""
    free, fixed = unknowns.free, ~unknowns.free
    among_fixed = jnp.where(fixed[:, None] & fixed, correlation, jnp.eye(free.size))
    across = jnp.where(free[:, None] & fixed, correlation, 0.0)
    gain = across @ invert(among_fixed)
    off = jnp.where(fixed, (unknowns.center - parameters) / deviations, 0.0)
    shifted = parameters + jnp.where(fixed.any(), deviations * (gain @ off), 0.0)
    known = jnp.where(free[:, None] & free, correlation - gain @ across.T, 0.0)
    return jnp.where(fixed, unknowns.center, shifted), known


GivenNetwork = TrainedNetwork | str | os.PathLike[str] | None
"""A network, or its file."""
SEED_STEPS = 2000  # of training a network that only gives a search its start
VEHICLE_SETTINGS = {"steps": 250, "batch": 64, "noise": (1.0, 1.0), "held_out": 2000}
MAX_WINDOWS = 24  # that the network of a vehicle sees, however long the flight is
FLYABLE = 0.5  # share of a vehicle's bracket in which nearly all simulated flights can be flown


def network_for(problem: ShootingProblem, bracket: Bracket, name: str, *, shoots: bool, seed: int) -> TrainedNetwork:
    """Train a network for one flight, named `name`: briefly if shooting follows (`shoots`)."""
    steps = SEED_STEPS if shoots else NetworkEstimator.steps
    settings = NetworkEstimator(channels=seen_channels(problem), steps=steps)
    with named(name):
        return settings.fit(problem, bracket, key=jax.random.key(seed))


def most_agile_windows(problem: ShootingProblem) -> ShootingProblem:
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
        return NetworkEstimator(**VEHICLE_SETTINGS).fit(problem, bracket, key=jax.random.key(seed))


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
