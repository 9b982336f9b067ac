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
from .training import Pair, Purpose, draw_chunks, noisy_chunk

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
        rows = np.arange(self.scales.shape[0])
        place = jnp.interp(jnp.log(scale), jnp.log(self.scales), as_float(rows))
        weights = jnp.maximum(1 - jnp.abs(place - rows), 0.0)  # of all rows: linear between the two nearest
        rms, correlation, factors, simultaneous = (
            (weights.reshape(-1, *(1 for _ in table.shape[1:])) * table).sum(axis=0) for table in self[1:]
        )
        return rms, correlation, factors, simultaneous


def calibrated_scales(noise: tuple[float, float]) -> Float[Array, " scales"]:
    """The noise scales at which a network is calibrated, from the lowest to the highest of its training."""
    return as_float(np.geomspace(*noise, 1 if noise[0] == noise[1] else _SCALES))


def uncalibrated(scales: Float[Array, " scales"], parameters: int) -> ErrorTable:
    """The table of a network before training: ones for the errors."""
    levels = scales.shape[0]
    return ErrorTable(
        scales,
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
    """Measures a network's errors on `count` new simulated flights, with new noise at each noise scale.

    Each quantile is the smallest that holds its level for one more flight. Flights that diverge do not count.

    **Raises:** `TrainingError` if too few flights can be flown.
    """
    parameters, tables = len(features.problem.model.parameter_names), []
    flights = draw_chunks(features, count, key=key, purpose=Purpose.CALIBRATION, uniform=True)
    for number, scale in enumerate(np.asarray(scales)):
        first = (1 + number) * len(flights)  # behind the places of the flights
        errors = [
            _standardised(regressor, scaling, noisy_chunk(features, chunk, np.stack([scale, scale]), key, place), scale)
            for place, chunk in zip(Purpose.CALIBRATION.place(first + np.arange(len(flights))), flights, strict=True)
        ]
        tables.append(_table(np.concatenate(errors)[:, :parameters]))
    return ErrorTable(scales, *(as_float(np.stack(column)) for column in zip(*tables, strict=True)))


@eqx.filter_jit
def _standardised(
    regressor: Regressor, scaling: Scaling, pairs: Pair, scale: Scalar
) -> Float[Array, "flights unknowns"]:
    """Errors in units of the standard deviation that the network gives, at one noise scale."""
    output = jax.vmap(regressor, in_axes=(0, None, None))(pairs.features, scale, scaling)
    return (output.u - pairs.u) / (scaling.bound(scale) * jnp.exp(output.log_spread))


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
