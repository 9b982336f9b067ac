"""The likelihood of innovations, and its derivatives, as sums over samples.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Numeric
from .gains import PerSegment, Series

LAGS = 8
"""The largest lag at which innovations are compared, in samples."""


class Innovations(NamedTuple):
    """The innovations of each segment and their negative log-likelihood.

    The unknowns of a channel are the parameters, then its `LogNoise`, gains of input innovations, and feedthroughs.

    - `feasible`: whether the rates stay below `FASTEST`.
    - `information`: the Fisher information.
    - `products`: sums of the products of standardised innovations 0 to `LAGS` samples apart.
    """

    cost: PerSegment
    feasible: Bool[Array, " segments"]
    gradient: Float[Array, "channels unknowns segments"]
    information: Float[Array, "channels unknowns unknowns segments"]
    products: Float[Array, "channels lags segments"]


def likelihood(
    counts: Bool[Array, "time channels segments"],
    variance: Series,
    variance_slopes: Float[Array, "time levels channels segments"],
    last: Float[Array, "lags channels segments"],
    errors: Series,
    slopes: Float[Array, "time channels unknowns segments"],
    feedthrough_squares: Series,
    noise: slice,
) -> tuple[tuple[PerSegment, Array, Array, Array], Float[Array, "lags channels segments"]]:
    """The likelihood of innovations `errors` with the derivatives `slopes`, and the last standardised innovations.

    `feedthrough_squares`: the squares of the explained part of the innovations, which counts as noise. `noise`: the
    indices of the noise among the unknowns.

    **Returns:** `cost`, `gradient`, `information` and `products` of `Innovations`; then the next `last`.
    """
    weight = jnp.where(counts, 1 / variance, 0.0)
    logarithm = jnp.where(counts, jnp.log(variance), 0.0)
    relative = jnp.moveaxis(variance_slopes * weight[:, None], 1, 2)  # (time, channels, levels, segments)
    gradient = jnp.einsum("tcul,tcl->cul", slopes, weight * errors)
    squares = errors**2 + feedthrough_squares
    surprise = (weight > 0) * (1 - weight * squares) / 2
    gradient = gradient.at[:, noise].add(jnp.einsum("tcul,tcl->cul", relative, surprise))
    information = jnp.einsum("tcul,tcvl->cuvl", slopes * weight[:, :, None], slopes)
    information = information.at[:, noise, noise].add(jnp.einsum("tcul,tcvl->cuvl", relative, relative) / 2)
    cost = (weight * squares + logarithm).sum(axis=(0, 1)) / 2
    standard = jnp.concatenate([last, jnp.sqrt(weight) * errors])
    now = standard[LAGS:]
    products = [(now * standard[LAGS - lag : standard.shape[0] - lag]).sum(axis=0) for lag in range(LAGS + 1)]
    return (cost, gradient, information, jnp.stack(products, axis=1)), standard[-LAGS:]


def joined(
    gradient: Float[Array, "channels some"], information: Float[Array, "channels some some"], count: int
) -> tuple[Float[Array, " unknowns"], Float[Array, "unknowns unknowns"]]:
    """Gradient and information in all unknowns, from each channel's in `count` parameters and its other unknowns."""
    channels, each = gradient.shape[0], gradient.shape[1] - count
    size = count + each * channels
    total = jnp.concatenate([gradient[:, :count].sum(axis=0), gradient[:, count:].ravel()])
    whole = jnp.zeros((size, size), dtype=float).at[:count, :count].set(information[:, :count, :count].sum(axis=0))
    for i in range(channels):
        own = slice(count + each * i, count + each * (i + 1))
        whole = whole.at[:count, own].set(information[i, :count, count:])
        whole = whole.at[own, :count].set(information[i, count:, :count])
        whole = whole.at[own, own].set(information[i, count:, count:])
    return total, whole


def placed(
    gradient: Float[Array, "segments some"],
    information: Float[Array, "segments some some"],
    places: Int[Numeric, "segments some"],
    size: int,
) -> tuple[Float[Array, "segments size"], Float[Array, "segments size size"]]:
    """Gradient and information of each segment in all `size` unknowns, from its own, which are at `places`."""
    segments = np.arange(places.shape[0])
    pairs = segments[:, None, None], places[:, :, None], places[:, None, :]
    return (
        jnp.zeros((places.shape[0], size), dtype=float).at[segments[:, None], places].add(gradient),
        jnp.zeros((places.shape[0], size, size), dtype=float).at[pairs].add(information),
    )
