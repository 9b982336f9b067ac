"""`AbstractProblem`: the likelihood of one flight, and its unknowns. Solvers use nothing else."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from .._custom_types import Count, Numeric, Scalar, as_float
from ..bracket import NO_PRIOR, Bracket, is_identifiable
from ..models.abstract import AbstractModel

# The unknowns of each window: the ones that all windows share, then the window's initial state if that is free.
WindowUnknowns = Float[Array, "windows unknowns"]
Values = Float[Array, " unknowns"]
Problem = TypeVar("Problem", bound="AbstractProblem")


def _as_mask(x: ArrayLike) -> Bool[Array, "..."]:
    return x if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype=bool))


class Unknowns(eqx.Module):
    """The unknowns that all windows of a flight share, with what is known about them before the search.

    The model's parameters come first. A likelihood may add further unknowns, such as noise levels.

    - `names`, `units`: of each unknown.
    - `parameter_count`: the number of the model's parameters, which come first.
    - `largest_std`: of an identifiable unknown, in half-widths: `NO_PRIOR` or `PROPER_PRIOR` of `jaxos4.bracket`.
    - `center`, `half_width`: of the bracket in which each unknown is searched.
    - `free`: whether an unknown is searched. The others are fixed at `center`.
    - `precision`: of a Gaussian prior around `center`, as the reciprocal of a variance; 0: no prior.
    - `lowest`, `highest`: the values beyond which no search may go, however wide the bracket.
    - `stride`: the longest step that can be trusted where the information about an unknown is inexact; infinite
      elsewhere. Levenberg-Marquardt takes no longer step; it and IBSS also damp by it.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    parameter_count: int = eqx.field(static=True)
    largest_std: float = eqx.field(static=True)
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
            parameter_count=count,
            largest_std=NO_PRIOR,
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
        """The unknowns in another bracket; fixed ones keep their values. Raises `ValueError` for another length."""
        if bracket.lower.shape != (self.count,):
            raise ValueError(f"`bracket` must hold {self.count} parameters, got {bracket.lower.shape[0]}.")
        known_free = not isinstance(self.free, Tracer) and bool(np.asarray(self.free).all())
        center = bracket.center if known_free else jnp.where(self.free, bracket.center, self.center)
        return dataclasses.replace(self, center=center, half_width=bracket.half_width)

    def fix(self, values: Mapping[str, Float[ArrayLike, ""]]) -> "Unknowns":
        """The same unknowns, some fixed at values. Raises `ValueError` for an unknown name, or if none remains free."""
        unknown = [name for name in values if name not in self.names]
        if unknown:
            raise ValueError(f"`values`: {unknown[0]} is no unknown; the unknowns are {', '.join(self.names)}.")
        fixed = np.isin(self.names, list(values))
        if fixed.all() or not (isinstance(self.free, Tracer) or (np.asarray(self.free) & ~fixed).any()):
            raise ValueError("`values` holds every unknown that is still free; leave at least one.")
        given = [as_float(values.get(name, 0.0)) for name in self.names]
        center, free = _fixed(self.center, self.free, fixed, given)
        return dataclasses.replace(self, center=center, free=free)

    @property
    def valid(self) -> Bool[Array, ""]:
        """Whether every bracket is finite, and its lower end is below its upper end, unless the unknown is fixed."""
        wide = (self.half_width > 0) | ~self.free
        return (wide & jnp.isfinite(self.half_width) & jnp.isfinite(self.center)).all()

    @property
    def usable(self) -> "Unknowns":
        """The unknowns if they are valid, else 0 +- 1, so that a batch stays finite. A half-width of 0 becomes 1."""
        center = jnp.where(self.valid, self.center, 0.0)
        half_width = jnp.where(self.valid & (self.half_width > 0), self.half_width, 1.0)
        return dataclasses.replace(self, center=center, half_width=half_width)

    @property
    def free_half_width(self) -> Values:
        """The half-width of each free unknown, and 0 for fixed ones."""
        return jnp.where(self.free, self.half_width, 0.0)

    @property
    def bracket(self) -> Bracket:
        """The bracket of all unknowns."""
        return Bracket.around(self.center, self.half_width)

    def limits(self, reach: Float[ArrayLike, ""]) -> tuple[Values, Values]:
        """The lowest and highest values of a search that may go `reach` half-widths from the center."""
        lower, upper = self.center - reach * self.half_width, self.center + reach * self.half_width
        return jnp.maximum(lower, self.lowest), jnp.minimum(upper, self.highest)

    def identifiable(
        self, std: Float[Array, " unknowns"], largest_std: float | None = None
    ) -> Bool[Array, " unknowns"]:
        """Whether each unknown is identifiable or fixed. `largest_std`: by default that of the cost."""
        largest = self.largest_std if largest_std is None else largest_std
        return jnp.asarray(is_identifiable(std, self.half_width, largest)) | ~self.free


@eqx.filter_jit  # one compiled program instead of one for each operation
def _fixed(
    center: Values, free: Bool[Array, " unknowns"], fixed: Bool[Numeric, " unknowns"], given: list[Scalar]
) -> tuple[Values, Bool[Array, " unknowns"]]:
    return jnp.where(fixed, jnp.stack(given), center), free & ~fixed


class Parts(NamedTuple):
    """The likelihood of each part of a flight, without the prior.

    - `gradient`, `information`: in all unknowns.
    - `products`: for each channel, sums of the products of standardised innovations 0, 1, 2, ... samples apart.
    - `noise_feedthrough`: the feedthroughs of the whole flight; the innovations that they explain count as noise.
    """

    gradient: Float[Array, "parts unknowns"]
    information: Float[Array, "parts unknowns unknowns"]
    products: Float[Array, "parts channels lags"]
    noise_feedthrough: Float[Array, "channels feedthroughs"]


class LocalModel(NamedTuple):
    """The quadratic model of a cost around some unknowns, for one window or with the windows as first axis.

    - `cost`: of the samples before the trajectory fails. `feasible`: whether it does not fail.
    - `gradient`, `information`: in the parameters, and then in a free initial state. The information is the Fisher
      information, J^T W^2 J for a shot.
    - `parts`: only of a likelihood whose parts are compared.
    """

    cost: Float[Array, "*windows"]
    feasible: Bool[Array, "*windows"]
    gradient: Float[Array, "*windows unknowns"]
    information: Float[Array, "*windows unknowns unknowns"]
    parts: Parts | None = None


class InitialGuess(NamedTuple):
    """Where a search starts.

    - `starts`: the unknowns of each window, the shared ones first; several starts if the likelihood has several maxima.
    - `off`: how far off each start may be, as a scale for steps: half-widths of brackets; for an
      initial state, the second value of `ShootingProblem.first_state`.
    - `known`: the part of each window's initial state that is known, and so not among the unknowns.
    """

    starts: Float[Array, "starts windows unknowns"]
    off: WindowUnknowns
    known: Float[Array, "windows known"]


class Stage(NamedTuple):
    """One stage of a likelihood, which may search only some of its unknowns, on a part of the data.

    - `unknowns`: of the likelihood. `off`: of its `InitialGuess`.
    - `local_model`: of the stage's cost, with derivatives of 0 in unknowns that are not searched.
    - `searched`: the unknowns that it searches: the free ones, and initial states that are unknowns.
    - `measurements`: the number of measurements that its cost compares; 0 if the noise is an unknown.
    - `smallest_step`: the step in standard deviations below which rounding decides the sign of a slope.
    - `last`: whether it is the last one.
    """

    unknowns: Unknowns
    off: WindowUnknowns
    local_model: Callable[[WindowUnknowns], LocalModel]
    searched: Bool[Array, " unknowns"]
    measurements: Scalar
    smallest_step: Scalar
    last: Bool[Array, ""]

    def misfit(self, cost: Scalar) -> Scalar:
        """The size of the residuals in standard deviations of the noise; 1 if the noise is an unknown."""
        return jnp.where(self.measurements > 0, jnp.sqrt(2 * cost / jnp.maximum(self.measurements, 1)), 1.0)

    def of_windows(self, shared: Float[Array, " shared"], own: float) -> WindowUnknowns:
        """A value for each shared unknown, and one value for all unknowns of the initial states."""
        return jnp.full(self.off.shape, own, dtype=float).at[:, : self.unknowns.count].set(shared)

    def limits(self, reach: Scalar | float) -> tuple[WindowUnknowns, WindowUnknowns]:
        """The lowest and highest value of each unknown, see `Unknowns.limits`; a free initial state has no limits."""
        lower, upper = self.unknowns.usable.limits(reach)
        return self.of_windows(lower, -jnp.inf), self.of_windows(upper, jnp.inf)

    @property
    def stride(self) -> WindowUnknowns:
        """The longest useful step of each unknown."""
        return self.of_windows(self.unknowns.stride, jnp.inf)


class Stages(NamedTuple):
    """A likelihood in stages. Each stage is searched from the answer of the stage before; the last is the whole.

    - `number`: the number of stages. `first`: the stage with which a search begins. `whole`: the first stage that fits
      all data.
    - `at`: a function of the number of a stage, and of the unknowns found before it. It returns the stage.
    """

    number: int
    first: Count | int
    whole: Count | int
    at: Callable[[Count | int, WindowUnknowns], Stage]


class AbstractProblem(eqx.Module):
    """The negative log-likelihood of a flight, which may be cut into windows.

    Windows share the unknowns in `unknowns`, and each window may also have a free initial state. The unknowns of all
    windows are one array: a row for each window, with the shared unknowns first. `initial_guess` has its shape.
    """

    unknowns: eqx.AbstractVar[Unknowns]

    @property
    @abc.abstractmethod
    def initial_guess(self) -> InitialGuess:
        """Where a search starts."""

    @property
    @abc.abstractmethod
    def local_model(self) -> Callable[[WindowUnknowns], LocalModel]:
        """The function from the unknowns to the cost of each window, with gradient, information and parts.

        Everything that does not depend on the unknowns is computed when the function is made: make it before a loop.
        """

    @property
    def no_parts(self) -> Parts | None:
        """Zeros in the shape of `parts`, which a search needs before its first shot, if `local_model` returns parts."""
        return None

    @abc.abstractmethod
    def fix(self: Problem, values: Mapping[str, Float[ArrayLike, ""]], bracket: Bracket | None = None) -> Problem:
        """The same likelihood, with some unknowns fixed at known values. `bracket`: where the others are searched.

        **Raises:** `ValueError` for a name that is no unknown, if none remains free, or for a bracket of another
        length.
        """

    @abc.abstractmethod
    def stages(self, shares: tuple[float, ...] = ()) -> Stages:
        """The likelihood in stages.

        `shares`: a likelihood that simulates first fits the body rates to these shares of the flight, one by one.
        """

    def hold(self: Problem, values: Mapping[str, Float[ArrayLike, ""]]) -> Problem:
        """`fix` under the name that users know: `problem.hold({"rotor_lag": 0.06})`."""
        return self.fix(values)

    def within(self: Problem, bracket: Bracket | None) -> Problem:
        """The same likelihood, with another bracket for the parameters; unchanged for `None`."""
        return self if bracket is None else self.fix({}, bracket)
