"""Simulated flights for training, and the loop that trains a network on them.

No flight is stored. Each step simulates its own batch: parameters, initial state, noise scale and noise are new draws.
"""

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import Key, Numeric, Scalar
from ..errors import TrainingError
from .features import AbstractFeatures

if TYPE_CHECKING:
    import optax  # `train` imports it, because it is slow to import

CHUNK = 1000
"""Flights that are simulated at once, apart from the steps of training."""


class Purpose(enum.IntEnum):
    """What random numbers are for. They are drawn from a key and a place, and each purpose has places of its own."""

    WEIGHTS = 0
    LINEAR_MAP = 1
    VALIDATION = 2
    STEPS = 3
    CALIBRATION = 4

    def place(self, number: Int[np.ndarray, "*numbers"] | int) -> Int[np.ndarray, "*numbers"]:
        """The place of a number, or of each number."""
        return np.asarray(len(Purpose) * np.asarray(number) + int(self))


CHECK = 250
"""Steps between two evaluations of the validation loss."""

Progress = Callable[[int, int, float], None]
"""Called at every check with the steps done, the number of steps, and the validation loss."""

_IMPROVEMENT = 1e-4  # a loss is an improvement if it is lower by this share
_DIVERGED = 1e15  # in units of the noise; the worst answer inside a bracket has a far lower loss
_FLYABLE = 0.01  # the smallest share of simulated flights that must not diverge

Network = TypeVar("Network", bound=eqx.Module)


class Pair(NamedTuple):
    """A simulated flight: features, noise scale (multiples of sigma), and the true unknowns in bracket coordinates."""

    features: Float[Array, "*batch features"]
    scale: Float[Array, "*batch"]
    u: Float[Array, "*batch unknowns"]


def draw_many(features: AbstractFeatures, scales: Float[Array, "2"], count: int, *, key: Key) -> Pair:
    """Simulates `count` flights: unknowns uniform in the bracket, noise scale log-uniform between `scales`."""
    unknowns, (low, high) = features.coordinates.center.shape[0], jnp.log(scales)
    # All random numbers in one draw, which compiles faster than one for each flight and quantity.
    drawn = jax.random.uniform(key, (count, unknowns + 1 + features.size), minval=-1, maxval=1, dtype=float)
    u, scale = drawn[:, :unknowns], jnp.exp((low + high + (high - low) * drawn[:, unknowns]) / 2)
    most = 1 - jnp.finfo(drawn.dtype).eps  # a finite number of standard deviations
    normal = jnp.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(drawn[:, unknowns + 1 :], -most, most))
    noise = scale[:, None] * normal
    return Pair(jax.vmap(features.simulated)(u, noise), scale, u)


def draw_chunks(
    features: AbstractFeatures, scales: Float[Numeric, "2"], count: int, *, key: Key, purpose: Purpose, first: int = 0
) -> Pair:
    """Simulates at least `count` flights in chunks of `CHUNK`, all by one compiled program.

    Chunk i is drawn from `key` at the place `first` + i of the `purpose`.
    """
    numbers = range(first, first - (-count // CHUNK))
    drawn = [_chunk(features, scales, key, purpose.place(number)) for number in numbers]
    # By NumPy: JAX would compile a program.
    return Pair(*(jax.device_put(np.concatenate(parts)) for parts in zip(*drawn, strict=True)))


@eqx.filter_jit
def _chunk(features: AbstractFeatures, scales: Float[Numeric, "2"], key: Key, place: Int[Numeric, ""]) -> Pair:
    return draw_many(features, jnp.asarray(scales), CHUNK, key=jax.random.fold_in(key, place))


def train(
    network: Network,
    loss: Callable[[Network, Pair], Scalar],
    features: AbstractFeatures,
    scales: Float[Array, "2"],
    optimiser: "optax.GradientTransformation",
    *,
    batch: int,
    steps: int,
    validation: int,
    patience: int,
    key: Key,
    progress: Progress | None = None,
) -> tuple[Network, Float[np.ndarray, "checks 2"]]:
    """Trains a network on the `loss` of one flight; flights that diverge do not count.

    **Returns:** the network as it was at the check with the best validation loss, and the losses of training and
    validation at every check.

    **Raises:** `TrainingError` if the loss diverges, or if nearly all flights of the bracket diverge.
    """
    import optax

    held_out = draw_chunks(features, scales, validation, key=key, purpose=Purpose.VALIDATION)
    given, structure = eqx.partition(network, eqx.is_inexact_array)
    _check_trainable(held_out, given)
    # Single precision: rounding is far below the noise of a step's flights.
    weights, held_out = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), (given, held_out))

    def mean_loss(weights: PyTree, pairs: Pair) -> Scalar:
        flown = jnp.isfinite(pairs.features).all(axis=1)
        # NaN would make the gradient NaN even at a weight of 0.
        finite = jnp.where(flown[:, None], pairs.features, 0.0)
        losses = jax.vmap(lambda pair: loss(eqx.combine(weights, structure), pair))(pairs._replace(features=finite))
        return jnp.where(flown, losses, 0.0).sum() / jnp.maximum(flown.sum(), 1)

    @eqx.filter_jit
    def advance(features, held_out, weights, state, key, places):
        def step(carry, place):
            weights, state = carry
            drawn = draw_many(features, scales, batch, key=jax.random.fold_in(key, place))
            pairs = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), drawn)
            value, gradient = jax.value_and_grad(mean_loss)(weights, pairs)
            updates, state = optimiser.update(gradient, state, weights)
            return (optax.apply_updates(weights, updates), state), value

        (weights, state), values = jax.lax.scan(step, (weights, state), places)
        return weights, state, values.mean(), mean_loss(weights, held_out)

    state = jax.jit(optimiser.init)(weights)
    best, lowest, without_improvement, history = weights, np.inf, 0, []
    for first in range(0, steps, CHECK):
        indices = np.arange(first, min(first + CHECK, steps))
        places = Purpose.STEPS.place(indices)
        weights, state, *losses = advance(features, held_out, weights, state, key, places)
        history.append([float(value) for value in losses])
        value, current = history[-1]
        if not np.less(history[-1], _DIVERGED).all():
            raise TrainingError(f"training diverged after {first} steps (loss {value:g}): lower `learning_rate`.")
        if progress is not None:
            progress(int(indices[-1]) + 1, steps, current)
        without_improvement += 1
        if current < lowest - _IMPROVEMENT * abs(current):
            best, lowest, without_improvement = weights, current, 0
        if without_improvement >= patience:
            break
    best = jax.tree.map(lambda leaf, like: jnp.asarray(np.asarray(leaf), like.dtype), best, given)
    return eqx.combine(best, structure), np.asarray(history)


def _check_trainable(held_out: Pair, weights: PyTree) -> None:
    flyable = np.isfinite(np.asarray(held_out.features)).all(axis=1).mean()
    if not flyable > _FLYABLE:
        what = f"only {100 * flyable:.2g} % of the flights simulated in the bracket can be flown to their end"
        raise TrainingError(f"{what}: narrow the bracket, or shorten the flight.")
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(weights)):
        raise TrainingError(
            "the network's first weights are not finite, because the flight at the bracket's center diverges or too "
            "few samples were measured: move the bracket, or use a longer flight."
        )
