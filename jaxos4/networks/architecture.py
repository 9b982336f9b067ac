"""From features to unknowns: a linear skip, what an approximator adds to it, and how far off both are."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Scalar

# Inputs are taken as they are up to here, and logarithmically beyond: flights that nearly diverge have huge features.
_LINEAR = 4.0
# The network that says how far off the answer is: as large as that needs.
_SPREAD_WIDTH, _SPREAD_DEPTH = 32, 2
# Its logarithm stays within this.
_LOGARITHM = 7.0


class Scaling(eqx.Module):
    """Units of the inputs and outputs, measured once and frozen.

    - `width`: how large each feature is.
    - `unit`: the Cramer-Rao bound of each unknown at the bracket's center, in bracket coordinates.
    - `gain`: how large a correction the approximator makes where it says 1, in bracket coordinates.
    - `span`: the largest logarithm of a noise scale.
    """

    width: Float[Array, " features"]
    unit: Float[Array, " unknowns"]
    gain: Float[Array, " unknowns"]
    span: Scalar

    def bound(self, scale: Scalar) -> Float[Array, " unknowns"]:
        """What can be known of each unknown at a noise scale, the bracket counted as data (variance 1/3)."""
        return jax.lax.rsqrt(1 / jnp.square(self.unit * scale) + 3)


class Answer(NamedTuple):
    """Unknowns in bracket coordinates, and their standard deviations in units of `Scaling.bound`, as a logarithm."""

    u: Float[Array, " unknowns"]
    log_spread: Float[Array, " unknowns"]


class CMAC(eqx.Module):
    """Tile coding (cerebellar model articulation controller): shifted grids of cells cover every pair of inputs.

    The answer is the mean over the grids of the entries of the cells that the inputs fall into. All inputs at once
    would need a number of cells that grows exponentially with them; pairs catch what two inputs do together.
    """

    tables: Float[Array, "pairs tilings cells cells out"]

    def __init__(self, in_size: int, out_size: int, *, tilings: int = 8, cells: int = 20):
        pairs = in_size * (in_size - 1) // 2
        self.tables = jnp.zeros((pairs, tilings, cells, cells, out_size))

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        """The approximation at `x`; cells cover -3 to 3, and the outermost ones all beyond."""
        pairs, tilings, cells = self.tables.shape[:3]
        shift = jnp.arange(tilings) / tilings
        place = jnp.clip(x / 6 + 0.5, 0, 1) * (cells - 1)
        cell = jnp.floor(place[:, None] + shift).astype(int)
        first, second = np.array(list(itertools.combinations(range(x.shape[0]), 2))).T
        entries = self.tables[jnp.arange(pairs)[:, None], jnp.arange(tilings), cell[first], cell[second]]
        return entries.mean(axis=1).sum(axis=0)


class Regressor(eqx.Module):
    """What is trained."""

    skip: Float[Array, "unknowns features"]
    approximator: eqx.nn.MLP | CMAC
    spread: eqx.nn.MLP

    def __init__(self, skip: Float[Array, "unknowns features"], approximator: str, *, width: int, depth: int, key: Key):
        unknowns, inputs = skip.shape[0], skip.shape[1] + 1
        approximator_key, spread_key = jax.random.split(key)

        def perceptron(width: int, depth: int, key: Key) -> eqx.nn.MLP:
            return eqx.nn.MLP(inputs, unknowns, width, depth, activation=jax.nn.silu, dtype=float, key=key)

        self.skip = skip
        self.approximator = (
            CMAC(inputs, unknowns) if approximator == "cmac" else perceptron(width, depth, approximator_key)
        )
        self.spread = perceptron(_SPREAD_WIDTH, _SPREAD_DEPTH, spread_key)

    def __call__(self, features: Float[Array, " features"], scale: Scalar, scaling: Scaling) -> Answer:
        """The answer for one flight."""
        seen = compress(features / scaling.width)
        inputs = jnp.concatenate([seen, (jnp.log(scale) / scaling.span)[None]])
        u = self.skip @ seen + scaling.gain * self.approximator(inputs)
        return Answer(u, jnp.clip(self.spread(inputs), -_LOGARITHM, _LOGARITHM))


def compress(x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Features as the network takes them: as they are up to a size, logarithmically beyond."""
    size = jnp.abs(x)
    return jnp.where(size < _LINEAR, x, jnp.sign(x) * (_LINEAR + jnp.log1p(jnp.maximum(size - _LINEAR, 0))))


def squared_error(
    regressor: Regressor,
    scaling: Scaling,
    features: Float[Array, " features"],
    scale: Scalar,
    u: Float[Array, " unknowns"],
) -> Scalar:
    """Mean square error in units of what can be known, plus the likelihood of that error under the spread.

    The spread follows the error and does not lead it: weighting by a spread that is learnt with it lets the answer
    settle where it is bad.
    """
    answer = regressor(features, scale, scaling)
    error = (answer.u - u) / scaling.bound(scale)
    settled = jax.lax.stop_gradient(error)
    likelihood = jnp.square(settled * jnp.exp(-answer.log_spread)) / 2 + answer.log_spread
    return jnp.square(error).mean() + likelihood.mean()
