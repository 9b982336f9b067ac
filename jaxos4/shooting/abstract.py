"""`AbstractProblem`: a likelihood of one flight. Searches know nothing else of it."""

import abc
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import InitialStates, Parameters, Scalar
from ..bracket import Bracket
from ..flight import Flight
from ..models.abstract import AbstractModel
from .scans import Curvature, Shot
from .unknowns import Unknowns

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar  # what type checkers understand
else:
    from equinox import AbstractClassVar

# The unknowns of each window: those that all windows share, and then the window's own initial state if it is free.
WindowUnknowns = Float[Array, "windows unknowns"]


class Stages(NamedTuple):
    """A problem in stages, from the one that is the easiest to search to the whole problem.

    All stages have the same unknowns; an early stage may search only some of them, on a part of the data.

    - `number`: how many stages there are.
    - `evaluate`: from the number of a stage and the unknowns, the curvature of the stage's cost in all unknowns; 0 in
      those that it does not search.
    - `searched`: for each stage, the unknowns that it searches.
    - `misfit`: from the number of a stage and its cost, by how much the residuals exceed the noise of the problem.
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
    def cascade(self) -> "tuple[AbstractProblem, ...]":
        """The problems to be solved one after the other; the last is this one."""

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
