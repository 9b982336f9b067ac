"""Calibrated intervals: how wide they must be to hold the truth as often as they say (split-conformal prediction)."""

import statistics
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Scalar, as_float
from ..errors import TrainingError
from .architecture import Regressor, Scaling
from .features import AbstractFeatures
from .training import CHUNK, Pair, Purpose, draw_chunks

# Levels of the calibrated intervals: evenly spaced in Gaussian standard deviations, from 50 to 99.9 %.
_NORMAL = statistics.NormalDist()
LEVELS = np.array([2 * _NORMAL.cdf(z) - 1 for z in np.linspace(_NORMAL.inv_cdf(0.75), _NORMAL.inv_cdf(0.9995), 28)])
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

    **Raises:** `TrainingError` if too few flights can be flown.
    """
    parameters, chunks = len(features.problem.model.parameter_names), -(-count // CHUNK)
    tables = []
    for number, scale in enumerate(np.asarray(scales)):
        both, first = np.full(2, scale), number * chunks
        pairs = draw_chunks(features, both, count, key=key, purpose=Purpose.CALIBRATION, first=first)
        tables.append(_table(np.asarray(_standardised(regressor, scaling, pairs))[:, :parameters]))
    return ErrorTable(scales, *(as_float(np.stack(column)) for column in zip(*tables, strict=True)))


@eqx.filter_jit
def _standardised(regressor: Regressor, scaling: Scaling, pairs: Pair) -> Float[Array, "flights unknowns"]:
    """Errors in units of the standard deviation that the network gives."""

    def one(pair: Pair) -> Float[Array, " unknowns"]:
        output = regressor(pair.features, pair.scale, scaling)
        return (output.u - pair.u) / (scaling.bound(pair.scale) * jnp.exp(output.log_spread))

    return jax.vmap(one)(pairs)


def _table(error: Float[np.ndarray, "flights parameters"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`rms`, `correlation`, `factors` and `simultaneous` of an `ErrorTable` at one noise scale."""
    error = error[np.isfinite(error).all(axis=1)]
    flown = len(error)
    rank = np.ceil((flown + 1) * LEVELS).astype(int) - 1
    if rank[-1] >= flown:
        raise TrainingError("too few of the held-out flights can be flown to calibrate: narrow the bracket.")
    moments = error.T @ error / flown
    rms = np.sqrt(np.diagonal(moments))
    relative = np.abs(error) / rms
    quantiles = np.sort(np.column_stack([relative, relative.max(axis=1)]), axis=0)[rank]
    return rms, moments / np.outer(rms, rms), quantiles[:, :-1], quantiles[:, -1]
