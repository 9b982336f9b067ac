"""Simulated pairs of features and parameters, and the loop that trains any network on them.

Nothing is stored: every batch is simulated inside the jitted step from fresh draws of parameters, initial state, noise
level and noise.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .._custom_types import Key, Scalar
from ..errors import TrainingError
from .features import AbstractFeatures

# Steps between two looks at the validation flights.
CHECK = 250
# A better loss is one that is lower by this share.
_GAIN = 1e-4
# The loss is in units of the noise: the worst answer in a bracket is far below this.
_DIVERGED = 1e15
# The share of simulated flights that must be flyable.
_FLYABLE = 0.01

Network = TypeVar("Network", bound=eqx.Module)


class Pair(NamedTuple):
    """A simulated flight: what the network sees, with the noise level in multiples of sigma, and what it should say."""

    features: Float[Array, "*batch features"]
    scale: Float[Array, "*batch"]
    u: Float[Array, "*batch unknowns"]


def draw(features: AbstractFeatures, scales: Float[Array, "2"], *, key: Key) -> Pair:
    """One flight: unknowns uniform in the bracket, noise level log-uniform between `scales`."""
    u_key, scale_key, noise_key = jax.random.split(key, 3)
    u = jax.random.uniform(u_key, features.coordinates.center.shape, minval=-1, maxval=1, dtype=float)
    low, high = jnp.log(scales)
    scale = jnp.exp(jax.random.uniform(scale_key, (), minval=low, maxval=high, dtype=float))
    return Pair(features.simulated(u, scale, key=noise_key), scale, u)


def draw_many(features: AbstractFeatures, scales: Float[Array, "2"], count: int, *, key: Key) -> Pair:
    """`count` flights; flight i draws from `fold_in(key, i)`."""
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(count))
    return jax.vmap(lambda k: draw(features, scales, key=k))(keys)


@functools.partial(jax.jit, static_argnums=1)
def split_key(key: Key, count: int) -> tuple[Key, ...]:
    """As many keys, by one program: taking an array of keys apart would need some more."""
    return tuple(jax.random.split(key, count))


def train(
    network: Network,
    loss: Callable[[Network, Pair], Scalar],
    features: AbstractFeatures,
    scales: Float[Array, "2"],
    optimiser: optax.GradientTransformation,
    *,
    batch: int,
    steps: int,
    validation: int,
    patience: int,
    key: Key,
    progress: bool,
) -> tuple[Network, Float[np.ndarray, "checks 2"]]:
    """The network that did best on the validation flights, and the losses of training and validation at every check.

    **Arguments:**

    - `loss`: of one flight. Flights that cannot be flown count nothing.
    - `validation`: how many flights to hold out.
    - `patience`: stop after so many checks without a better loss.

    **Raises:** `TrainingError` where the loss diverges, or hardly any flight of the bracket can be flown.
    """
    train_key, validation_key = split_key(key, 2)
    held_out = eqx.filter_jit(draw_many)(features, scales, validation, key=validation_key)
    flyable = np.isfinite(np.asarray(held_out.features)).all(axis=1).mean()
    if not flyable > _FLYABLE:
        raise TrainingError(
            f"only {100 * flyable:.2g} % of the flights simulated in the bracket can be flown to their end: narrow the "
            "bracket, or shorten the flight."
        )

    weights, structure = eqx.partition(network, eqx.is_inexact_array)
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(weights)):
        raise TrainingError(
            "the network has no finite start: the flight at the bracket's center diverges, or measures too little."
        )

    def mean_loss(weights: PyTree, pairs: Pair) -> Scalar:
        flown = jnp.isfinite(pairs.features).all(axis=1)
        # What NaN touches has a NaN gradient, whatever its weight.
        seen = jnp.where(flown[:, None], pairs.features, 0.0)
        losses = jax.vmap(lambda pair: loss(eqx.combine(weights, structure), pair))(pairs._replace(features=seen))
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
    best, least, since, history = weights, np.inf, 0, []
    columns = (
        TextColumn("training the network"),
        BarColumn(),
        TextColumn("loss {task.fields[loss]}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not (progress and console.is_terminal)) as bar:
        task = bar.add_task("", total=steps, loss="-")
        for first in range(0, steps, CHECK):
            indices = np.arange(first, min(first + CHECK, steps))
            weights, state, *losses = advance(features, held_out, weights, state, train_key, indices)
            history.append([float(value) for value in losses])
            if not np.less(history[-1], _DIVERGED).all():
                raise TrainingError(
                    f"training diverged after {first} steps (loss {history[-1][0]:g}): lower `learning_rate`."
                )
            bar.update(task, completed=int(indices[-1]) + 1, loss=f"{history[-1][1]:.4g}")
            since += 1
            if history[-1][1] < least - _GAIN * abs(history[-1][1]):
                best, least, since = weights, history[-1][1], 0
            if since >= patience:
                break
    return eqx.combine(best, structure), np.asarray(history)
