"""A network before training: measured scales, the best linear map, random first weights for the rest."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric
from .architecture import Regressor, Scaling, compress
from .features import AbstractFeatures, Score
from .training import CHUNK, Pair, Purpose, draw_chunks, noisy_chunk

# Flights for each feature, and the ridge, of the fit of the linear map.
_PER_FEATURE, _RIDGE = 4, 1e-6
_DRAWN = 1024  # random numbers at once


def linear_samples(features: AbstractFeatures, scales: Float[np.ndarray, "2"], key: Key) -> list[Pair]:
    """The simulated flights of `scaling_and_linear_map`, in chunks."""
    count, purpose = max(CHUNK, _PER_FEATURE * features.size), Purpose.LINEAR_MAP
    chunks = draw_chunks(features, count, key=key, purpose=purpose)
    return [noisy_chunk(features, chunk, scales, key, purpose.place(len(chunks) + i)) for i, chunk in enumerate(chunks)]


def scaling_and_linear_map(
    features: AbstractFeatures, scales: Float[Numeric, "2"], chunks: list[Pair]
) -> tuple[Scaling, Float[Array, "unknowns features"]]:
    """Measures the features' sizes on simulated flights, and fits the best linear map from features to unknowns."""
    samples = jax.tree.map(lambda *parts: jnp.concatenate(parts), *chunks)
    # The score's own derivatives give the bound.
    score = features if isinstance(features, Score) else Score.of(features.problem, features.coordinates)
    unit = jnp.linalg.norm(score.noise_factor, axis=1)

    flown = jnp.isfinite(samples.features).all(axis=1)
    width = 1.5 * jnp.nanmedian(jnp.where(flown[:, None], jnp.abs(samples.features), jnp.nan), axis=0)
    # Scaled so that one learning rate suits both kinds of features, however many they are.
    width = jnp.where(width > 0, width, 1.0) * jnp.sqrt(features.size / unit.shape[0])
    inputs = jnp.where(flown[:, None], compress(samples.features / width), 0.0)
    targets = jnp.where(flown[:, None], samples.u, 0.0)
    ridge = _RIDGE * jnp.trace(inputs.T @ inputs) / features.size
    linear_map = jnp.linalg.solve(inputs.T @ inputs + ridge * jnp.eye(features.size), inputs.T @ targets).T
    gain = jnp.minimum(10 * unit, 1.0)
    span = jnp.maximum(jnp.abs(jnp.log(scales)).max(), 1.0)
    return Scaling(width, unit, gain, span), linear_map


def first_regressor(
    linear_map: Float[Array, "unknowns features"], approximator: str, *, width: int, depth: int, key: Key
) -> Regressor:
    """A `Regressor` with the distribution of Equinox's first weights: uniform within 1 / sqrt(inputs).

    All random numbers come from one draw: a draw for each array would take XLA five seconds to compile.
    """

    def layers(regressor: Regressor) -> list[eqx.nn.Linear]:
        nodes = jax.tree.leaves(regressor, is_leaf=lambda x: isinstance(x, eqx.nn.Linear))
        return [layer for layer in nodes if isinstance(layer, eqx.nn.Linear)]

    def arrays(regressor: Regressor) -> list:
        return [array for layer in layers(regressor) for array in (layer.weight, layer.bias)]

    def zero(leaf):
        return jnp.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf

    # All arrays outside the layers begin at 0, except the linear map.
    make = functools.partial(Regressor, linear_map, approximator, width=width, depth=depth)
    blank = jax.tree.map(zero, eqx.filter_eval_shape(make, key=key))
    limits = [1 / math.sqrt(layer.weight.shape[1]) for layer in layers(blank) for _ in ("weight", "bias")]
    shapes = [array.shape for array in arrays(blank)]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    keys = jax.random.split(key, -(-int(ends[-1]) // _DRAWN))
    drawn = jax.lax.map(lambda k: jax.random.uniform(k, (_DRAWN,), minval=-1, maxval=1, dtype=float), keys).ravel()
    values = [
        limit * part.reshape(shape)
        for limit, part, shape in zip(limits, jnp.split(drawn[: ends[-1]], ends[:-1]), shapes, strict=True)
    ]
    return eqx.tree_at(lambda r: [r.skip, *arrays(r)], blank, [linear_map, *values])
