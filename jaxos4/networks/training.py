"""Simulated flights for training, and the loop that trains a network on them.

Between two checks, training simulates new flights. Each step takes some of them, with new noise.
"""

import enum
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._custom_types import Key, Numeric, Scalar
from ..errors import TrainingError
from .architecture import Regressor, Scaling, loss
from .features import AbstractFeatures

if TYPE_CHECKING:
    import optax  # `_optimiser` imports it, because it is slow to import

CHUNK = 1000
"""Flights that are simulated at once. All chunks share one compiled program."""


class Purpose(enum.IntEnum):
    """What random numbers are for. They are drawn from a key and a place, and each purpose has places of its own."""

    WEIGHTS = 0
    LINEAR_MAP = 1
    VALIDATION = 2
    STEPS = 3
    CALIBRATION = 4
    FLIGHTS = 5

    def place(self, number: Int[np.ndarray, "*numbers"] | int) -> Int[np.ndarray, "*numbers"]:
        """The place of a number, or of each number."""
        return np.asarray(len(Purpose) * np.asarray(number) + int(self))


CHECK = 250
"""Steps between two evaluations of the validation loss."""

Progress = Callable[[int, int, float], None]
"""Called at every check with the steps done, the number of steps, and the validation loss."""

_VALIDATION = 2  # chunks of the validation
_USES = 4  # how often training uses a simulated flight, each time with new noise
_IMPROVEMENT = 1e-4  # a loss is an improvement if it is lower by this share
_DIVERGED = 1e15  # in units of the noise; the worst answer inside a bracket has a far lower loss
_FLYABLE = 0.01  # the smallest share of simulated flights that must not diverge

_WARM_UP = 200  # steps
_LAST_RATE = 1e-3  # the learning rate at the end of training, relative to the largest
_NEWTON_SCHULZ = ((3.4445, -4.7750, 2.0315),) * 5  # Optax's coefficients; as rows they compile to a loop


class Flights(NamedTuple):
    """Simulated flights without noise: features, and the true unknowns in bracket coordinates."""

    features: Float[Array, "*batch features"]
    u: Float[Array, "*batch unknowns"]


class Pair(NamedTuple):
    """A simulated flight with noise: features, noise scale (multiples of sigma), and the true unknowns."""

    features: Float[Array, "*batch features"]
    scale: Float[Array, "*batch"]
    u: Float[Array, "*batch unknowns"]


def draw_chunks(
    features: AbstractFeatures, count: int, *, key: Key, purpose: Purpose, first: int = 0, uniform: bool = False
) -> list[Flights]:
    """Simulates at least `count` flights in chunks of `CHUNK`. Parameters are uniform in the bracket.

    `uniform`: whether free initial states are uniform in the bracket too. Otherwise they are denser near its center.
    Chunk i is drawn from `key` at the place `first` + i of the `purpose`.
    """
    numbers = range(first, first + math.ceil(count / CHUNK))
    return [_chunk(features, key, purpose.place(number), np.asarray(uniform)) for number in numbers]


@eqx.filter_jit
def _chunk(features: AbstractFeatures, key: Key, place: Int[Numeric, ""], uniform: Bool[Numeric, ""]) -> Flights:
    unknowns, parameters = features.coordinates.center.shape[0], len(features.problem.model.parameter_names)
    drawn = jax.random.uniform(jax.random.fold_in(key, place), (CHUNK, unknowns + 1), minval=-1, maxval=1, dtype=float)
    shrunk = jnp.where(uniform, 1.0, jnp.abs(drawn[:, -1:]))
    u = drawn[:, :-1] * jnp.where(np.arange(unknowns) < parameters, 1.0, shrunk)
    return Flights(jax.vmap(features.simulated)(u), u)


def with_noise(
    features: AbstractFeatures, flights: Flights, scales: Float[Numeric, "2"], uniform: Float[Array, "flights random"]
) -> Pair:
    """Adds noise to flights, with scales that are log-uniform between `scales`.

    `uniform`: random numbers between -1 and 1, one for the scale and one for each feature.
    """
    low, high = jnp.log(jnp.asarray(scales, uniform.dtype))
    scale = jnp.exp((low + high + (high - low) * uniform[:, 0]) / 2)
    most = 1 - jnp.finfo(uniform.dtype).eps  # a finite number of standard deviations
    normal = jnp.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(uniform[:, 1:], -most, most))
    return Pair(flights.features + jax.vmap(features.noise)(scale[:, None] * normal), scale, flights.u)


@eqx.filter_jit
def noisy_chunk(
    features: AbstractFeatures, chunk: Flights, scales: Float[Numeric, "2"], key: Key, place: Int[Numeric, ""]
) -> Pair:
    """Adds noise to a chunk of flights, drawn from `key` at a place, by one compiled program for all chunks."""
    shape = CHUNK, 1 + features.size
    drawn = jax.random.uniform(jax.random.fold_in(key, place), shape, minval=-1, maxval=1, dtype=float)
    return with_noise(features, chunk, scales, drawn)


def train(
    regressor: Regressor,
    scaling: Scaling,
    features: AbstractFeatures,
    scales: Float[np.ndarray, "2"],
    *,
    batch: int,
    steps: int,
    learning_rate: float,
    patience: int,
    key: Key,
    progress: Progress | None = None,
) -> tuple[Regressor, Float[np.ndarray, "checks 2"]]:
    """Trains a regressor by Muon with a cosine schedule; flights that diverge do not count.

    **Returns:** the regressor as it was at the check with the best validation loss, and the losses of training and
    validation at every check.

    **Raises:** `TrainingError` if the loss diverges, or if nearly all flights of the bracket diverge.
    """
    held_out = [
        noisy_chunk(features, chunk, scales, key, Purpose.VALIDATION.place(_VALIDATION + number))
        for number, chunk in enumerate(draw_chunks(features, _VALIDATION * CHUNK, key=key, purpose=Purpose.VALIDATION))
    ]
    _check_trainable(held_out, regressor)
    # Single precision: rounding is far below the noise of a step's flights.
    given, held_out, data = regressor, _single(held_out), _single((scaling, features, scales))
    regressor = _single(regressor)
    state, rates = _first_state(regressor), _learning_rates(learning_rate, steps)
    flown = batch * CHECK // _USES
    best, lowest, without_improvement, history = regressor, np.inf, 0, []
    for number, first in enumerate(range(0, steps, CHECK)):
        flights = draw_chunks(
            features, flown, key=key, purpose=Purpose.FLIGHTS, first=number * math.ceil(flown / CHUNK)
        )
        count = min(CHECK, steps - first)
        places = Purpose.STEPS.place(first + np.arange(CHECK))
        rate = np.resize(rates[first : first + count], CHECK)  # of one shape: the last steps need no other program
        regressor, state, *losses = _advance(
            regressor, state, data, flights, held_out, key, places, rate, np.asarray(count), batch
        )
        history.append([float(value) for value in losses])
        value, current = history[-1]
        if not np.less(history[-1], _DIVERGED).all():
            raise TrainingError(f"training diverged after {first} steps (loss {value:g}): lower `learning_rate`.")
        if progress is not None:
            progress(first + count, steps, current)
        without_improvement += 1
        if current < lowest - _IMPROVEMENT * abs(current):
            best, lowest, without_improvement = regressor, current, 0
        if without_improvement >= patience:
            break
    best = jax.tree.map(
        lambda leaf, like: jnp.asarray(np.asarray(leaf, like.dtype)) if eqx.is_inexact_array(like) else like,
        best,
        given,
    )
    return best, np.asarray(history)


@eqx.filter_jit
def _advance(
    regressor: Regressor,
    state: PyTree,
    data: tuple[Scaling, AbstractFeatures, Float[Array, "2"]],
    chunks: list[Flights],
    held_out: list[Pair],
    key: Key,
    places: Int[Numeric, " steps"],
    rates: Float[Numeric, " steps"],
    count: Int[Numeric, ""],
    batch: int,
) -> tuple[Regressor, PyTree, Scalar, Scalar]:
    """The first `count` steps of training, their mean loss, and the loss on `held_out` flights."""
    scaling, features, scales = data
    flights = Flights(*(jnp.concatenate(parts).astype(jnp.float32) for parts in zip(*chunks, strict=True)))
    validation = Pair(*map(jnp.concatenate, zip(*held_out, strict=True)))

    def mean_loss(regressor: Regressor, pairs: Pair) -> Scalar:
        flown = jnp.isfinite(pairs.features).all(axis=1)
        # NaN would make the gradient NaN even at a weight of 0.
        finite = pairs._replace(features=jnp.where(flown[:, None], pairs.features, 0.0))
        losses = jax.vmap(lambda pair: loss(regressor, scaling, *pair))(finite)
        return jnp.where(flown, losses, 0.0).sum() / jnp.maximum(flown.sum(), 1)

    def step(i: Int[Array, ""], carry: tuple[PyTree, PyTree, Scalar]) -> tuple[PyTree, PyTree, Scalar]:
        weights, state, total = carry
        # All random numbers in one draw, which compiles faster than one for each quantity.
        drawn = jax.random.uniform(
            jax.random.fold_in(key, places[i]), (batch, 2 + features.size), jnp.float32, minval=-1, maxval=1
        )
        picked = ((drawn[:, 0] + 1) / 2 * flights.u.shape[0]).astype(int)
        pairs = with_noise(features, jax.tree.map(lambda leaf: leaf[picked], flights), scales, drawn[:, 1:])
        value, gradient = jax.value_and_grad(lambda weights: mean_loss(eqx.combine(weights, rest), pairs))(weights)
        updates, state = _optimiser(rates[i]).update(gradient, state, weights)
        return eqx.apply_updates(weights, updates), state, total + value

    weights, rest = eqx.partition(regressor, eqx.is_inexact_array)
    weights, state, total = jax.lax.fori_loop(0, count, step, (weights, state, jnp.zeros((), jnp.float32)))
    regressor = eqx.combine(weights, rest)
    return regressor, state, total / count, mean_loss(regressor, validation)


@eqx.filter_jit
def _first_state(regressor: Regressor) -> PyTree:
    return _optimiser(0.0).init(eqx.filter(regressor, eqx.is_inexact_array))


def _optimiser(rate: Scalar | float) -> "optax.GradientTransformation":
    import optax

    return optax.contrib.muon(rate, ns_coeffs=_NEWTON_SCHULZ)


def _learning_rates(largest: float, steps: int) -> Float[np.ndarray, " steps"]:
    """The learning rate of each step: a linear rise, then half a cosine."""
    step, warm_up = np.arange(steps), min(_WARM_UP, steps // 2)
    wave = (1 + np.cos(np.pi * (step - warm_up) / (steps - warm_up))) / 2
    share = np.where(step < warm_up, step / max(warm_up, 1), _LAST_RATE + (1 - _LAST_RATE) * wave)
    return (largest * share).astype(np.float32)


def _single(tree: PyTree) -> PyTree:
    """All floating-point numbers in single precision, by NumPy: JAX would compile programs."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32) if eqx.is_inexact_array_like(leaf) else leaf, tree)


def _check_trainable(held_out: list[Pair], regressor: Regressor) -> None:
    flyable = np.mean([np.isfinite(np.asarray(chunk.features)).all(axis=1) for chunk in held_out])
    if not flyable > _FLYABLE:
        what = f"only {100 * flyable:.2g} % of the flights simulated in the bracket can be flown to their end"
        raise TrainingError(f"{what}: narrow the bracket, or shorten the flight.")
    weights = jax.tree.leaves(eqx.filter(regressor, eqx.is_inexact_array))
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in weights):
        raise TrainingError(
            "the network's first weights are not finite, because the flight at the bracket's center diverges or too "
            "few samples were measured: move the bracket, or use a longer flight."
        )
