"""Simulated flights for training, and the loop that trains a network on them.

No flight is stored. Each step simulates its own batch: parameters, initial state, noise scale and noise are new draws.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Key, Scalar
from ..errors import TrainingError
from .features import AbstractFeatures

if TYPE_CHECKING:
    import optax  # `train` imports it, because it is slow to import

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


def draw(features: AbstractFeatures, scales: Float[Array, "2"], *, key: Key) -> Pair:
    """Simulates one flight: unknowns uniform in the bracket, noise scale log-uniform between `scales`."""
    u_key, scale_key, noise_key = jax.random.split(key, 3)
    u = jax.random.uniform(u_key, features.coordinates.center.shape, minval=-1, maxval=1, dtype=float)
    low, high = jnp.log(scales)
    scale = jnp.exp(jax.random.uniform(scale_key, (), minval=low, maxval=high, dtype=float))
    return Pair(features.simulated(u, scale, key=noise_key), scale, u)


def draw_many(features: AbstractFeatures, scales: Float[Array, "2"], count: int, *, key: Key) -> Pair:
    """Simulates `count` flights; flight i draws from `fold_in(key, i)`."""
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(count))
    return jax.vmap(lambda k: draw(features, scales, key=k))(keys)


@functools.partial(jax.jit, static_argnums=1)
def split_key(key: Key, count: int) -> tuple[Key, ...]:
    """Splits a key into a tuple of keys in one program; unpacking an array of keys would compile more."""
    return tuple(jax.random.split(key, count))


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

    train_key, validation_key = split_key(key, 2)
    held_out = eqx.filter_jit(draw_many)(features, scales, validation, key=validation_key)
    weights, structure = eqx.partition(network, eqx.is_inexact_array)
    _check_trainable(held_out, weights)

    def mean_loss(weights: PyTree, pairs: Pair) -> Scalar:
        flown = jnp.isfinite(pairs.features).all(axis=1)
        # NaN would make the gradient NaN even at a weight of 0.
        finite = jnp.where(flown[:, None], pairs.features, 0.0)
        losses = jax.vmap(lambda pair: loss(eqx.combine(weights, structure), pair))(pairs._replace(features=finite))
        return jnp.where(flown, losses, 0.0).sum() / jnp.maximum(flown.sum(), 1)

    @eqx.filter_jit
    def advance(features, held_out, weights, state, key, indices):
        def step(carry, key):
            weights, state = carry
            value, gradient = jax.value_and_grad(mean_loss)(weights, draw_many(features, scales, batch, key=key))
            updates, state = optimiser.update(gradient, state, weights)
            return (optax.apply_updates(weights, updates), state), value

        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(indices)
        (weights, state), values = jax.lax.scan(step, (weights, state), keys)
        return weights, state, values.mean(), mean_loss(weights, held_out)

    state = jax.jit(optimiser.init)(weights)
    best, lowest, without_improvement, history = weights, np.inf, 0, []
    for first in range(0, steps, CHECK):
        indices = np.arange(first, min(first + CHECK, steps))
        weights, state, *losses = advance(features, held_out, weights, state, train_key, indices)
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
