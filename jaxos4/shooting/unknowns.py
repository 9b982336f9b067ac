"""The unknowns of a problem: names, units, where to look for them, and which of them are free."""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from .._custom_types import as_float
from ..bracket import NO_PRIOR, Bracket, is_identifiable
from ..models.abstract import AbstractModel

Values = Float[Array, " unknowns"]


def _as_mask(x: ArrayLike) -> Bool[Array, "..."]:
    return x if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype=bool))


class Unknowns(eqx.Module):
    """Everything that is fixed about the unknowns of a problem before the search.

    The model's parameters come first. A likelihood may add unknowns of its own, such as the levels of the noise.

    - `names`, `units`: of each unknown.
    - `center`, `half_width`: of the bracket in which each is looked for.
    - `free`: whether it is searched. The others are held at `center`.
    - `precision`: of a Gaussian prior around `center`, as the reciprocal of a variance; 0: no prior.
    - `lowest`, `highest`: the values beyond which no search may go, however wide the bracket.
    - `stride`: the longest useful step of a search.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    center: Values = eqx.field(converter=as_float)
    half_width: Values = eqx.field(converter=as_float)
    free: Bool[Array, " unknowns"] = eqx.field(converter=_as_mask)
    precision: Values = eqx.field(converter=as_float)
    lowest: Values = eqx.field(converter=as_float)
    highest: Values = eqx.field(converter=as_float)
    stride: Values = eqx.field(converter=as_float)

    @classmethod
    def of(cls, model: AbstractModel, bracket: Bracket | None = None) -> "Unknowns":
        """The parameters of a model, all free, in a bracket; by default the model's own."""
        bracket, count = Bracket.default(model) if bracket is None else bracket, len(model.parameter_names)
        nothing, infinite = np.zeros(count), np.full(count, np.inf)
        unknowns = cls(
            names=model.parameter_names,
            units=model.parameter_units,
            center=nothing,
            half_width=infinite,
            free=np.ones(count, dtype=bool),
            precision=nothing,
            lowest=-infinite,
            highest=infinite,
            stride=infinite,
        )
        return unknowns.within(bracket)

    @property
    def count(self) -> int:
        """The number of unknowns."""
        return len(self.names)

    def within(self, bracket: Bracket) -> "Unknowns":
        """The same unknowns, looked for in another bracket. A held unknown keeps its value.

        **Raises:** `ValueError` for a bracket of another length.
        """
        if bracket.lower.shape != (self.count,):
            raise ValueError(f"`bracket` must hold {self.count} parameters, got {bracket.lower.shape[0]}.")
        center = bracket.center if _all(self.free) else jnp.where(self.free, bracket.center, self.center)
        return dataclasses.replace(self, center=center, half_width=bracket.half_width)

    def hold(self, values: Mapping[str, Float[ArrayLike, ""]]) -> "Unknowns":
        """The same unknowns, some of them held at known values.

        **Raises:** `ValueError` for a name that is no unknown, or if no unknown remains free.
        """
        strangers = [name for name in values if name not in self.names]
        if strangers:
            raise ValueError(f"`values`: {strangers[0]} is no unknown; the unknowns are {', '.join(self.names)}.")
        if len(values) == self.count:
            raise ValueError("`values` holds every unknown; leave at least one free.")
        held = np.isin(self.names, list(values))
        known = np.flatnonzero(held)
        center = self.center.at[known].set(jnp.stack([as_float(values[self.names[i]]) for i in known]))
        return dataclasses.replace(self, center=center, free=self.free & ~held)

    @property
    def valid(self) -> Bool[Array, ""]:
        """Whether every bracket is finite, and its lower end is below its upper end."""
        return ((self.half_width > 0) & jnp.isfinite(self.half_width) & jnp.isfinite(self.center)).all()

    @property
    def usable(self) -> "Unknowns":
        """The unknowns themselves if they are valid; otherwise 0 +- 1, so that a batch stays finite."""
        center, half_width = jnp.where(self.valid, self.center, 0.0), jnp.where(self.valid, self.half_width, 1.0)
        return dataclasses.replace(self, center=center, half_width=half_width)

    @property
    def width(self) -> Values:
        """The half-width of each free unknown, and 0 for held ones."""
        return jnp.where(self.free, self.half_width, 0.0)

    @property
    def bracket(self) -> Bracket:
        """The bracket of all unknowns."""
        return Bracket.around(self.center, self.half_width)

    def limits(self, reach: Float[ArrayLike, ""]) -> tuple[Values, Values]:
        """The least and the greatest values of a search that may go `reach` half-widths from the center."""
        lower, upper = self.center - reach * self.half_width, self.center + reach * self.half_width
        return jnp.maximum(lower, self.lowest), jnp.minimum(upper, self.highest)

    def identifiable(self, std: Float[Array, " unknowns"], prior: float = NO_PRIOR) -> Bool[Array, " unknowns"]:
        """Whether each unknown is identifiable, see `jaxos4.bracket.is_identifiable`; held ones count as known."""
        return jnp.asarray(is_identifiable(std, self.half_width, prior)) | ~self.free


def _all(mask: Bool[Array, "..."]) -> bool:
    """Whether all values are true and known while a program is traced."""
    return not isinstance(mask, Tracer) and bool(np.asarray(mask).all())
