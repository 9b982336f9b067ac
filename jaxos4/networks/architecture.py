"""From features to unknowns: a linear map, a learnt correction, the learnt size of the error, calibrated intervals."""

import functools
import itertools
import math
import statistics
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, Scalar, as_float

_SILU = jax.nn.silu
# Levels of the calibrated intervals: evenly spaced in Gaussian standard deviations, from 50 to 99.9 %.
_NORMAL = statistics.NormalDist()
LEVELS = np.array([2 * _NORMAL.cdf(z) - 1 for z in np.linspace(_NORMAL.inv_cdf(0.75), _NORMAL.inv_cdf(0.9995), 28)])


class Scaling(eqx.Module):
    """Units of the inputs and outputs, measured once before training and then frozen.

    - `width`: the typical size of each feature.
    - `unit`: the Cramer-Rao bound of each unknown at the bracket's center, in bracket coordinates.
    - `gain`: the correction of each unknown when the architecture returns 1, in bracket coordinates.
    - `span`: the largest logarithm of a noise scale.
    """

    width: Float[Array, " features"]
    unit: Float[Array, " unknowns"]
    gain: Float[Array, " unknowns"]
    span: Scalar

    def bound(self, scale: Scalar) -> Float[Array, " unknowns"]:
        """The smallest possible standard deviation of each unknown at a noise scale."""
        # The bracket counts as data: a uniform distribution over it has the variance 1/3.
        return jax.lax.rsqrt(1 / jnp.square(self.unit * scale) + 3)


class GatedPerceptron(eqx.Module):
    """A multilayer perceptron whose last hidden layer multiplies a linear map of the inputs (GLU; Dauphin et al. 2017).

    Parameters act on a flight in products, so that such a map needs fewer neurons than a perceptron.
    """

    hidden: eqx.nn.MLP
    gate: eqx.nn.Linear
    last: eqx.nn.Linear

    def __init__(self, in_size: int, out_size: int, width: int, depth: int, *, key: Key):
        first, second, third = jax.random.split(key, 3)
        self.hidden = eqx.nn.MLP(in_size, width, width, depth - 1, _SILU, _SILU, dtype=float, key=first)
        self.gate = eqx.nn.Linear(in_size, width, dtype=float, key=second)
        self.last = eqx.nn.Linear(width, out_size, dtype=float, key=third)

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        """The output for inputs `x`."""
        return self.last(self.hidden(x) * self.gate(x))


_EXTENT = 3.0  # cells cover inputs of this size, to either side: twice what a flight without noise has


class CMAC(eqx.Module):
    """The cerebellar model articulation controller: a table of weights, of which an input selects a few.

    A tiling divides the plane of two inputs into square cells, each with a weight. The output is a sum over all pairs
    of inputs; a pair adds the mean of one weight from each of its tilings, which are shifted, so that inputs that are
    close share most weights. It is piecewise constant. The outermost cells also hold everything beyond them.

    Albus tiles all inputs together and hashes the cells. In nine dimensions two flights rarely share a cell; pairs can
    represent the products in which parameters act on a flight.

    Reference: Albus (1975), A new approach to manipulator control, J. Dyn. Sys., Meas., Control 97(3), 220-227.
    """

    table: Float[Array, "pairs tilings cells cells out"]

    def __init__(self, in_size: int, out_size: int, tilings: int, cells: int, *, key: Key):
        del key  # weights begin at 0
        self.table = jnp.zeros((in_size * (in_size - 1) // 2, tilings, cells, cells, out_size))

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        """The output for inputs `x`."""
        pairs, tilings, cells = self.table.shape[:3]
        first, second = np.array(list(itertools.combinations(range(x.size), 2))).T
        place, number = (x / _EXTENT + 1) / 2 * (cells - 1), np.arange(tilings)

        def cell(inputs: Int[np.ndarray, " pairs"], shift: Int[np.ndarray, " tilings"]) -> Int[Array, "pairs tilings"]:
            shifted = place[inputs, None] + (shift % tilings / tilings).astype(x.dtype)
            return jnp.clip(jnp.floor(shifted), 0, cells - 1).astype(int)

        # The second input moves by another multiple, so that the shifts do not lie on the diagonal.
        own = np.arange(pairs)[:, None], number, cell(first, number), cell(second, 3 * number)
        return self.table[own].mean(axis=1).sum(axis=0)


ARCHITECTURES = {
    "mlp": (GatedPerceptron, ("width", "depth")),
    "cmac": (CMAC, ("tilings", "cells")),
}
"""The corrections of the linear map by name: the class, and the settings that are its arguments."""


_SPREAD_WIDTH, _SPREAD_DEPTH = 32, 2  # of the perceptron that predicts the spread of the error
_MAX_LOG_SPREAD = 7.0  # to either side


class Regressor(eqx.Module):
    """The trained part of a network: a linear map `skip`, its `correction`, and the logarithm of the error's spread."""

    skip: Float[Array, "unknowns features"]
    correction: GatedPerceptron | CMAC
    spread: eqx.nn.MLP

    def __init__(self, skip: Float[Array, "unknowns features"], architecture: str, shape: dict[str, Any], *, key: Key):
        self.skip, sizes = skip, (skip.shape[1] + 1, skip.shape[0])
        first, second = jax.random.split(key)
        self.correction = ARCHITECTURES[architecture][0](*sizes, **shape, key=first)
        self.spread = eqx.nn.MLP(*sizes, _SPREAD_WIDTH, _SPREAD_DEPTH, _SILU, dtype=float, key=second)

    def __call__(self, features: Float[Array, " features"], scale: Scalar, scaling: Scaling) -> tuple[Array, Array]:
        """Unknowns of one flight in bracket coordinates, from its features and its noise scale.

        **Returns:** them, and the logarithm of their standard deviations in units of `Scaling.bound`.
        """
        compressed = compress(features / scaling.width)
        inputs = jnp.concatenate([compressed, (jnp.log(scale) / scaling.span)[None]])
        u = self.skip @ compressed + scaling.gain * self.correction(inputs)
        return u, jnp.clip(self.spread(inputs), -_MAX_LOG_SPREAD, _MAX_LOG_SPREAD)


def first_regressor(
    linear_map: Float[Array, "unknowns features"], key: Key, architecture: str, shape: dict[str, Any]
) -> Regressor:
    """A `Regressor` with the distribution of Equinox's first weights: uniform within 1 / sqrt(inputs).

    All random numbers come from one draw: a draw for each array would take XLA five seconds to compile. All arrays
    outside the layers begin at 0, except the linear map.
    """

    def arrays(regressor: Regressor) -> list:
        nodes = jax.tree.leaves(regressor, is_leaf=lambda x: isinstance(x, eqx.nn.Linear))
        return [x for node in nodes if isinstance(node, eqx.nn.Linear) for x in (node.weight, node.bias)]

    abstract = eqx.filter_eval_shape(functools.partial(Regressor, linear_map, architecture, shape), key=key)
    blank = jax.tree.map(lambda x: jnp.zeros_like(x) if isinstance(x, jax.ShapeDtypeStruct) else x, abstract)
    shapes = [array.shape for array in arrays(blank)]
    limits = np.repeat([1 / math.sqrt(weight[1]) for weight in shapes[::2]], 2).tolist()
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    at_once = 1024
    keys = jax.random.split(key, -(-int(ends[-1]) // at_once))
    drawn = jax.lax.map(lambda k: jax.random.uniform(k, (at_once,), minval=-1, maxval=1, dtype=float), keys).ravel()
    parts = zip(limits, jnp.split(drawn[: ends[-1]], ends[:-1]), shapes, strict=True)
    values = [limit * part.reshape(shape) for limit, part, shape in parts]
    return eqx.tree_at(lambda r: [r.skip, *arrays(r)], blank, [linear_map, *values])


def compress(x: Float[Array, "*batch features"], linear: float = 4.0) -> Float[Array, "*batch features"]:
    """Features as the network takes them: linear up to the size `linear`, logarithmic beyond, as some are huge."""
    size = jnp.abs(x)
    return jnp.where(size < linear, x, jnp.sign(x) * (linear + jnp.log1p(jnp.maximum(size - linear, 0))))


def loss(
    regressor: Regressor, scaling: Scaling, features: Float[Array, " features"], scale: Scalar, u: Float[Array, " u"]
) -> Scalar:
    """The loss of one flight: weighted square error in units of `Scaling.bound`, plus the likelihood of the spread.

    The weight 1 / spread keeps flights that cannot be identified from hiding the others (beta-NLL; Seitzer et al.
    2022). The likelihood trains the spread alone.
    """
    found, log_spread = regressor(features, scale, scaling)
    error = (found - u) / scaling.bound(scale)
    fixed_error, weight = jax.lax.stop_gradient((error, jnp.exp(-log_spread)))
    likelihood = jnp.square(fixed_error * jnp.exp(-log_spread)) / 2 + log_spread
    return (weight * jnp.square(error)).mean() + likelihood.mean()


class ErrorTable(NamedTuple):
    """A network's errors on simulated flights, in units of the standard deviation that the network gives.

    - `scales`: noise scales; all other fields have one row for each.
    - `rms`, `correlation`: root mean square, and correlation between the parameters.
    - `factors`: quantiles of each parameter's error, divided by `rms`.
    - `simultaneous`: quantiles of the largest of these over all parameters.
    """

    scales: Float[Array, " scales"]
    rms: Float[Array, "scales parameters"]
    correlation: Float[Array, "scales parameters parameters"]
    factors: Float[Array, "scales levels parameters"]
    simultaneous: Float[Array, "scales levels"]

    def at(self, scale: Scalar) -> tuple[Array, Array, Array, Array]:
        """`rms`, `correlation`, `factors` and `simultaneous`, interpolated in the logarithm of the noise scale."""
        rows = np.arange(self.scales.shape[0])
        place = jnp.interp(jnp.log(scale), jnp.log(self.scales), as_float(rows))
        weights = jnp.maximum(1 - jnp.abs(place - rows), 0.0)  # of all rows: linear between the two nearest
        rms, correlation, factors, simultaneous = (
            (weights.reshape(-1, *[1] * (table.ndim - 1)) * table).sum(axis=0) for table in self[1:]
        )
        return rms, correlation, factors, simultaneous


def calibrated_scales(noise: tuple[float, float]) -> Float[Array, " scales"]:
    """The nine noise scales of a calibration, evenly spaced in the logarithm; one if the lowest is the highest."""
    return as_float(np.geomspace(*noise, 1 if noise[0] == noise[1] else 9))
