"""The data that a scan over a flight reads, cut into windows."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
from jaxtyping import Array, Float, Int

from .._custom_types import Numeric
from ..models.state import Forcing

Series = TypeVar("Series", Forcing, tuple[Array, ...])


class Rows(NamedTuple):
    """One window, or a batch of windows: one leaf for each channel, one row for each sample.

    `forcing` acts from each sample to the next. A missing measurement is NaN. `forcing_tangents` is the derivative of
    the forcing in the parameters on which it depends, along the last axis.
    """

    forcing: Forcing
    measured: tuple[Float[Array, "*windows rows"], ...]
    forcing_tangents: Forcing | None = None


def each_window(function: Callable, *arguments: Any) -> Any:
    """`function` of each window. The only window of a flight needs no `vmap`, which takes long to trace."""
    if jax.tree.leaves(arguments[0])[0].shape[0] > 1:
        return jax.vmap(function)(*arguments)
    only = jax.tree.map(lambda leaf: leaf[0], arguments)
    return jax.tree.map(lambda leaf: leaf[None], function(*only))


def windowed(series: Series, index: Int[Numeric, "windows length"]) -> Series:
    """The series of each window, from those of the flight. Windows of equal length need no copy."""

    def rows(leaf: Float[Array, "samples ..."]) -> Float[Array, "windows length ..."]:
        return leaf.reshape(index.shape) if index.size == leaf.shape[0] else leaf[index]

    return jax.tree.map(rows, series)
