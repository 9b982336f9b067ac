"""From features to unknowns: a linear map, a learnt correction, and the learnt size of the error that remains."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Scalar

# Features grow linearly up to this size and logarithmically beyond: flights that nearly diverge have huge features.
_LINEAR = 4.0
# The perceptron that predicts the size of the error: its width and depth, and the limit of its logarithm.
_SPREAD_WIDTH, _SPREAD_DEPTH, _LARGEST_LOGARITHM = 32, 2, 7.0


class Scaling(eqx.Module):
    """Units of the inputs and outputs, measured once before training and then frozen.

    - `width`: the typical size of each feature.
    - `unit`: the Cramer-Rao bound of each unknown at the bracket's center, in bracket coordinates.
    - `gain`: the correction of each unknown when the approximator returns 1, in bracket coordinates.
    - `span`: the largest logarithm of a noise scale.
    """

    width: Float[Array, " features"]
    unit: Float[Array, " unknowns"]
    gain: Float[Array, " unknowns"]
    span: Scalar

    def bound(self, scale: Scalar) -> Float[Array, " unknowns"]:
        """The smallest possible standard deviation of each unknown at a noise scale.

        The bracket counts as data: a uniform distribution over it has the variance 1/3.
        """
        return jax.lax.rsqrt(1 / jnp.square(self.unit * scale) + 3)


class NetworkOutput(NamedTuple):
    """Unknowns in bracket coordinates, and the logarithm of their standard deviations in units of `Scaling.bound`."""

    u: Float[Array, " unknowns"]
    log_spread: Float[Array, " unknowns"]


class CMAC(eqx.Module):
    """Tile coding (cerebellar model articulation controller): shifted grids of cells cover every pair of inputs.

    The output is a sum over the pairs. Each pair contributes the mean, over its grids, of the entry of the cell that
    holds the two inputs.
    """

    tables: Float[Array, "pairs tilings cells cells out"]

    def __init__(self, in_size: int, out_size: int, *, tilings: int = 8, cells: int = 20):
        pairs = in_size * (in_size - 1) // 2
        self.tables = jnp.zeros((pairs, tilings, cells, cells, out_size))

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        """The output for inputs `x`. The cells cover -3 to 3; the outermost cells also cover everything beyond."""
        pairs, tilings, cells = self.tables.shape[:3]
        shift = jnp.arange(tilings) / tilings
        place = jnp.clip(x / 6 + 0.5, 0, 1) * (cells - 1)
        cell = jnp.floor(place[:, None] + shift).astype(int)
        first, second = np.array(list(itertools.combinations(range(x.shape[0]), 2))).T
        entries = self.tables[jnp.arange(pairs)[:, None], jnp.arange(tilings), cell[first], cell[second]]
        return entries.mean(axis=1).sum(axis=0)


class Regressor(eqx.Module):
    """The trained part of a network: a linear map `skip`, an approximator that corrects it, and the error's spread."""

    skip: Float[Array, "unknowns features"]
    approximator: eqx.nn.MLP | CMAC
    spread: eqx.nn.MLP

    def __init__(self, skip: Float[Array, "unknowns features"], approximator: str, *, width: int, depth: int, key: Key):
        unknowns, inputs = skip.shape[0], skip.shape[1] + 1
        approximator_key, spread_key = jax.random.split(key)

        def perceptron(width: int, depth: int, key: Key) -> eqx.nn.MLP:
            return eqx.nn.MLP(inputs, unknowns, width, depth, activation=jax.nn.silu, dtype=float, key=key)

        tiles = approximator == "cmac"
        self.skip = skip
        self.approximator = CMAC(inputs, unknowns) if tiles else perceptron(width, depth, approximator_key)
        self.spread = perceptron(_SPREAD_WIDTH, _SPREAD_DEPTH, spread_key)

    def __call__(self, features: Float[Array, " features"], scale: Scalar, scaling: Scaling) -> NetworkOutput:
        """Unknowns of one flight, from its features and its noise scale."""
        compressed = compress(features / scaling.width)
        inputs = jnp.concatenate([compressed, (jnp.log(scale) / scaling.span)[None]])
        u = self.skip @ compressed + scaling.gain * self.approximator(inputs)
        return NetworkOutput(u, jnp.clip(self.spread(inputs), -_LARGEST_LOGARITHM, _LARGEST_LOGARITHM))


def compress(x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Features as the network takes them: linear up to a size, logarithmic beyond."""
    size = jnp.abs(x)
    return jnp.where(size < _LINEAR, x, jnp.sign(x) * (_LINEAR + jnp.log1p(jnp.maximum(size - _LINEAR, 0))))


def squared_error(
    regressor: Regressor,
    scaling: Scaling,
    features: Float[Array, " features"],
    scale: Scalar,
    u: Float[Array, " unknowns"],
) -> Scalar:
    """The loss of one flight: mean square error in units of `Scaling.bound`, plus the likelihood of the spread.

    The likelihood trains the spread alone; otherwise training could settle at a bad answer with a large spread.
    """
    output = regressor(features, scale, scaling)
    error = (output.u - u) / scaling.bound(scale)
    fixed_error = jax.lax.stop_gradient(error)
    likelihood = jnp.square(fixed_error * jnp.exp(-output.log_spread)) / 2 + output.log_spread
    return jnp.square(error).mean() + likelihood.mean()
