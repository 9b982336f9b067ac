"""Calibrated intervals: how wide they must be to hold the truth as often as they say (split-conformal prediction)."""

import statistics
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Scalar, as_float
from .architecture import Regressor, Scaling
from .features import AbstractFeatures
from .training import Pair, draw_many

# Levels of the calibrated intervals: evenly spaced in Gaussian standard deviations, from 50 to 99.9 %.
_NORMAL = statistics.NormalDist()
LEVELS = np.array([2 * _NORMAL.cdf(z) - 1 for z in np.linspace(_NORMAL.inv_cdf(0.75), _NORMAL.inv_cdf(0.9995), 28)])
CHUNK = 1000  # flights that are simulated at once
_SCALES = 9  # noise scales at which intervals are calibrated, evenly spaced in the logarithm


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
        knots = jnp.log(self.scales)

        def interpolate(table):
            flat = table.reshape(table.shape[0], -1)
            values = jax.vmap(lambda column: jnp.interp(jnp.log(scale), knots, column), in_axes=1)(flat)
            return values.reshape(table.shape[1:])

        rms, correlation, factors, simultaneous = map(interpolate, self[1:])
        return rms, correlation, factors, simultaneous


def uncalibrated(noise: tuple[float, float], parameters: int) -> ErrorTable:
    """The table of a network before training: noise scales from the lowest to the highest, and ones for the errors."""
    scales, levels = as_float(np.asarray(noise)), 1 if noise[0] == noise[1] else _SCALES
    return ErrorTable(
        jnp.geomspace(scales[0], scales[1], levels),
        jnp.ones((levels, parameters)),
        jnp.tile(jnp.eye(parameters), (levels, 1, 1)),
        jnp.ones((levels, len(LEVELS), parameters)),
        jnp.ones((levels, len(LEVELS))),
    )


@eqx.filter_jit
def calibrate(
    regressor: Regressor,
    scaling: Scaling,
    features: AbstractFeatures,
    scales: Float[Array, " scales"],
    count: int,
    key: Key,
) -> ErrorTable:
    """Measures a network's errors on `count` new simulated flights at each noise scale.

    Each quantile is the smallest that holds its level for one more flight. Flights that diverge do not count.
    """
    parameters = len(features.problem.model.parameter_names)

    def standardised(pair: Pair) -> Float[Array, " parameters"]:
        output = regressor(pair.features, pair.scale, scaling)
        return ((output.u - pair.u) / (scaling.bound(pair.scale) * jnp.exp(output.log_spread)))[:parameters]

    def at(number_and_scale):
        number, scale = number_and_scale
        scale_key = jax.random.fold_in(key, number)

        def errors(chunk):
            pairs = draw_many(features, jnp.stack([scale, scale]), CHUNK, key=jax.random.fold_in(scale_key, chunk))
            return jax.vmap(standardised)(pairs)

        error = jax.lax.map(errors, jnp.arange(-(-count // CHUNK))).reshape(-1, parameters)
        flown = jnp.isfinite(error).all(axis=1)
        error = jnp.where(flown[:, None], error, 0.0)
        moments = error.T @ error / flown.sum()
        rms = jnp.sqrt(jnp.diagonal(moments))
        relative = jnp.where(flown[:, None], jnp.abs(error) / rms, jnp.inf)
        ordered = jnp.sort(jnp.column_stack([relative, relative.max(axis=1)]), axis=0)
        rank = jnp.ceil((flown.sum() + 1) * as_float(LEVELS)).astype(int) - 1
        quantiles = jnp.where((rank < flown.sum())[:, None], ordered[jnp.minimum(rank, flown.size - 1)], jnp.inf)
        return rms, moments / (rms[:, None] * rms[None, :]), quantiles[:, :-1], quantiles[:, -1]

    numbers = jnp.arange(scales.shape[0])
    return ErrorTable(scales, *jax.lax.map(at, (numbers, scales)))
