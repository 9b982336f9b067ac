"""A flight cut into windows, each of which is simulated from an initial state of its own."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Numeric
from ..models.state import Forcing

Series = TypeVar("Series", Forcing, tuple[Array, ...])


def cut(samples: int, windows: int) -> tuple[Int[np.ndarray, "windows length"], Bool[np.ndarray, "windows length"]]:
    """The samples of each window, and which of them belong to it. A shorter window repeats its last sample."""
    ends = np.arange(windows + 1) * samples // windows
    index = ends[:-1, None] + np.arange(np.diff(ends).max())
    within = index < ends[1:, None]
    return np.where(within, index, ends[1:, None] - 1), within


def windowed(series: Series, index: Int[Numeric, "windows length"]) -> Series:
    """The series of each window, from those of the flight. Windows of equal length need no copy."""

    def rows(leaf: Float[Array, "samples ..."]) -> Float[Array, "windows length ..."]:
        return leaf.reshape(index.shape) if index.size == leaf.shape[0] else leaf[index]

    return jax.tree.map(rows, series)


def each_window(function: Callable, *arguments: Any) -> Any:
    """`function` of each window. The only window of a flight needs no `vmap`, which takes long to trace."""
    if jax.tree.leaves(arguments[0])[0].shape[0] > 1:
        return jax.vmap(function)(*arguments)
    only = jax.tree.map(lambda leaf: leaf[0], arguments)
    return jax.tree.map(lambda leaf: leaf[None], function(*only))


def first_measured(
    measured: Float[Array, "windows length columns"],
) -> tuple[Float[Array, "windows columns"], Bool[Array, "windows columns"]]:
    """The first measurement of each window, or 0 if there is none; and whether it is that of the first sample."""
    first = jnp.argmin(jnp.isnan(measured), axis=1)
    value = jnp.take_along_axis(measured, first[:, None], axis=1)[:, 0]
    return jnp.nan_to_num(value), (first == 0) & ~jnp.isnan(value)
