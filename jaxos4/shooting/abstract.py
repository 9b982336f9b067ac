"""`AbstractProblem`: a likelihood of one flight, and its unknowns. Searches know nothing else of it."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import InitialStates, Numeric, Parameters, Scalar, as_float
from ..bracket import NO_PRIOR, Bracket, is_identifiable
from ..flight import Flight
from ..models.abstract import AbstractModel
from .scans import Curvature, Shot

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar  # what type checkers understand
else:
    from equinox import AbstractClassVar

# The unknowns of each window: those that all windows share, and then the window's own initial state if it is free.
WindowUnknowns = Float[Array, "windows unknowns"]
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
        held = np.isin(self.names, list(values))
        if held.all() or not (isinstance(self.free, Tracer) or (np.asarray(self.free) & ~held).any()):
            raise ValueError("`values` holds every unknown that is still free; leave at least one.")
        given = [as_float(values.get(name, 0.0)) for name in self.names]
        center, free = _held(self.center, self.free, held, given)
        return dataclasses.replace(self, center=center, free=free)

    @property
    def valid(self) -> Bool[Array, ""]:
        """Whether every bracket is finite, and its lower end is below its upper end, unless the unknown is held."""
        wide = (self.half_width > 0) | ~self.free
        return (wide & jnp.isfinite(self.half_width) & jnp.isfinite(self.center)).all()

    @property
    def usable(self) -> "Unknowns":
        """The unknowns themselves if they are valid; otherwise 0 +- 1, so that a batch stays finite.

        The half-width of a held unknown is 1 if it was 0.
        """
        center = jnp.where(self.valid, self.center, 0.0)
        half_width = jnp.where(self.valid & (self.half_width > 0), self.half_width, 1.0)
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


@eqx.filter_jit  # one compiled program instead of one for each operation
def _held(
    center: Values, free: Bool[Array, " unknowns"], held: Bool[Numeric, " unknowns"], given: list[Scalar]
) -> tuple[Values, Bool[Array, " unknowns"]]:
    return jnp.where(held, jnp.stack(given), center), free & ~held


class Stages(NamedTuple):
    """A problem in stages, from the one that is the easiest to search to the whole problem.

    All stages have the same unknowns; an early stage may search only some of them, on a part of the data.

    - `number`: how many stages there are.
    - `evaluate`: from the number of a stage and the unknowns, the curvature of the stage's cost in all unknowns; 0 in
      those that it does not search.
    - `searched`: for each stage, the unknowns that it searches.
    - `misfit`: from the number of a stage and its cost, the size of the residuals in standard deviations of the noise.
    - `smallest_step`: for each stage, the step in standard deviations below which rounding decides the sign of a slope.
    """

    number: int
    evaluate: Callable[[Int[Array, ""], WindowUnknowns], Curvature]
    searched: Bool[Array, "stages unknowns"]
    misfit: Callable[[Int[Array, ""], Scalar], Scalar]
    smallest_step: Float[Array, " stages"]


class AbstractProblem(eqx.Module):
    """The negative log-likelihood of a flight, with its derivatives, window by window.

    A flight may be cut into windows. All windows share the unknowns in `unknowns`, which come first; in addition, each
    window may have an initial state of its own.

    - `prior`: how the cost uses the bracket: `NO_PRIOR` or `GAUSSIAN_PRIOR` of `jaxos4.bracket`.
    """

    model: eqx.AbstractVar[AbstractModel]
    flight: eqx.AbstractVar[Flight]
    unknowns: eqx.AbstractVar[Unknowns]
    windows: eqx.AbstractVar[int]
    prior: AbstractClassVar[float]

    @property
    @abc.abstractmethod
    def free_size(self) -> int:
        """The number of unknowns in the initial state of one window; 0 if it is known."""

    @property
    @abc.abstractmethod
    def starts(self) -> Float[Array, "starts unknowns"]:
        """Where searches for the shared unknowns start: several rows if the likelihood has several maxima."""

    @abc.abstractmethod
    def hold(self, values: Mapping[str, Float[ArrayLike, ""]]) -> "AbstractProblem":
        """The same problem with some unknowns held at known values, see `Unknowns.hold`."""

    @abc.abstractmethod
    def within(self, bracket: Bracket | None) -> "AbstractProblem":
        """The same problem, with another bracket for the parameters; unchanged for `None`."""

    @abc.abstractmethod
    def first_state(self) -> tuple[InitialStates, InitialStates]:
        """The initial state of all windows at which a search starts, and how far off it may be."""

    @abc.abstractmethod
    def split(self, initial_state: InitialStates) -> Float[Array, "windows size"]:
        """The initial state of each window."""

    @abc.abstractmethod
    def shots(self, parameters: Parameters, initial_state: InitialStates) -> Shot:
        """The cost of all windows together. `parameters`: all shared unknowns."""

    @abc.abstractmethod
    def evaluator(self) -> Callable[[Parameters, InitialStates], Curvature]:
        """`curvatures` for a loop: everything that does not depend on the unknowns is computed once."""

    @abc.abstractmethod
    def stages(self, *, cascade: bool) -> Stages:
        """The problem in stages; without `cascade` as a whole."""

    @abc.abstractmethod
    def explains(self, cost: Scalar) -> Bool[Array, ""]:
        """Whether a cost is no larger than noise makes it; false if the noise is an unknown."""

    def curvatures(self, parameters: Parameters, initial_state: InitialStates) -> Curvature:
        """The curvature of each window, in the shared unknowns and the window's own initial state."""
        return self.evaluator()(parameters, initial_state)

    def join(self, parameters: Parameters, initial_state: InitialStates) -> WindowUnknowns:
        """The unknowns of each window: the shared ones, and its initial state if that is free."""
        repeated = jnp.broadcast_to(parameters, (self.windows, parameters.shape[0]))
        return jnp.concatenate([repeated, self.split(initial_state)[:, : self.free_size]], axis=1)

    def limits(self, reach: Scalar | float) -> tuple[WindowUnknowns, WindowUnknowns]:
        """The least and the greatest value of each unknown, see `Unknowns.limits`; a free initial state has none."""
        lower, upper = self.unknowns.usable.limits(reach)
        return self.each_window(lower, -jnp.inf), self.each_window(upper, jnp.inf)

    def each_window(self, shared: Parameters, own: float) -> WindowUnknowns:
        """A value for each shared unknown, and one value for all unknowns of the initial states."""
        repeated = jnp.broadcast_to(shared, (self.windows, shared.shape[0]))
        return jnp.concatenate([repeated, jnp.full((self.windows, self.free_size), own)], axis=1)
