"""`AbstractSolver`: an estimator that minimises the cost of any likelihood step by step. `solve` is their loop."""

import abc
import functools
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar
from ..batching import in_blocks
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate, as_estimate
from ..linalg import covariance_of_shared
from ..shooting import AbstractProblem, LocalModel, Stage, WindowUnknowns

S = TypeVar("S")


class Found(NamedTuple):
    """The findings of a search in a stage, or the knowledge before the first stage.

    - `unknowns`: the best unknowns of each window. `model`: the local model of the cost there.
    - `spread`: the covariance of the unknowns of each window.
    - `sweeps`, `rollouts`: of this stage alone, see `Estimate`; in `solve`, the sums over all stages.
    - `done`: whether the stage ended by itself.
    """

    unknowns: WindowUnknowns
    model: LocalModel
    spread: Float[Array, "windows unknowns unknowns"]
    sweeps: Count
    rollouts: Count
    done: Bool[Array, ""]


class AbstractSolver(AbstractEstimator, Generic[S]):
    """An algorithm that minimises the cost of a likelihood. It uses only the members of `AbstractProblem`.

    - `is_local`: whether the answer depends on the start, so that the search is repeated from all starts of a problem.
    - `shares`: the requested stages, see `AbstractProblem.stages`.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    """

    shoots: ClassVar[bool] = True
    in_closed_loop: ClassVar[bool] = True
    is_local: ClassVar[bool] = True
    shares: eqx.AbstractVar[tuple[float, ...]]
    reach: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def init(self, stage: Stage, before: Found) -> S:
        """The first state of a stage's search, at `before.unknowns` with the covariance `before.spread`."""

    @abc.abstractmethod
    def step(self, stage: Stage, state: S) -> S:
        """One iteration."""

    @abc.abstractmethod
    def terminate(self, stage: Stage, state: S) -> Bool[Array, ""]:
        """Whether the stage has ended."""

    @abc.abstractmethod
    def postprocess(self, stage: Stage, state: S, before: Found) -> Found:
        """The findings of the stage, from its last state."""

    @eqx.filter_jit
    def __call__(
        self,
        problem: AbstractProblem,
        bracket: Bracket | None = None,
        *,
        start: Float[Array, " unknowns"] | None = None,
    ) -> Estimate:
        """Identifies one flight. Raises `ValueError` for a bracket or a start of another length than the unknowns.

        - `problem`, `bracket`: see `AbstractEstimator`. The parameters may turn out to lie outside of the bracket.
        - `start`: where the search begins, unless it is NaN; by default the problem's `initial_guess`.
        """
        return in_blocks(solve, self, problem.within(bracket), start)


def solve(
    solver: AbstractSolver,
    problem: AbstractProblem,
    start: Float[Array, " unknowns"] | WindowUnknowns | None = None,
    spread: Float[Array, "given given"] | None = None,
    *,
    is_close: Bool[Array, ""] | bool = False,
    skip: Bool[Array, ""] | bool = False,
) -> Estimate:
    """The estimate that a solver finds, stage by stage.

    The first stage is searched from each start of the problem. Equal starts count once. Later starts begin with the
    best parameters so far. The other stages are searched from the best answer of all starts.

    - `start`: where to start instead: shared unknowns, or all unknowns of each window. Values that are NaN, or of fixed
      unknowns, are ignored.
    - `spread`: the covariance of the first unknowns of each window at the start; by default that of the initial guess.
    - `is_close`: whether the start is so close that stages on a part of the data are skipped.
    - `skip`: whether to return no answer, without a step. Other lanes of the batch do not wait for this one.
    """
    stages = problem.stages(solver.shares)
    starts, skip = _starts(problem, start), jnp.asarray(skip)
    begin = before_search(problem, spread, skip)
    first_stage = stages.first if is_close is False else jnp.where(is_close, stages.whole, stages.first)
    start_count = 1
    if starts.shape[0] > 1 and solver.is_local:
        start_count = jnp.where((starts == starts[0]).all(), 1, starts.shape[0])

    def search(place: Count, best: Found) -> Found:
        """Searches from a start in the first stage, or from the best answer in a later stage."""
        from_start = place < start_count
        own = (jnp.arange(starts.shape[2]) < problem.unknowns.parameter_count) & (place > 0)
        own &= jnp.isfinite(cost_of(best.model))
        first = begin._replace(unknowns=jnp.where(own, best.unknowns, starts[jnp.minimum(place, start_count - 1)]))
        before = chosen(from_start, first, best)
        stage = stages.at(first_stage + jnp.maximum(place - start_count + 1, 0), before.unknowns)
        # Traced once, although a solver may call it twice. `partial` makes another function of it: of an equal one, JAX
        # would find the trace of another search.
        stage = stage._replace(local_model=jax.jit(functools.partial(stage.local_model), inline=True))
        # A start that was given may lie beyond the reach.
        before = before._replace(unknowns=jnp.clip(before.unknowns, *stage.limits(solver.reach)))
        state = jax.lax.while_loop(
            lambda state: ~(skip | solver.terminate(stage, state)),
            functools.partial(solver.step, stage),
            solver.init(stage, before),
        )
        found = solver.postprocess(stage, state, before)
        found = found._replace(model=chosen(skip, before_shots(found.model), found.model), done=skip | found.done)
        is_better = (place == 0) | ~from_start | (cost_of(found.model) < cost_of(best.model))
        total = {"sweeps": best.sweeps + found.sweeps, "rollouts": best.rollouts + found.rollouts}
        return chosen(is_better, found, best)._replace(**total)

    # One loop, so that the search is compiled once for all starts and stages.
    end = jax.lax.fori_loop(0, start_count + stages.number - 1 - first_stage, search, begin)
    shared = problem.unknowns.count
    return as_estimate(
        problem,
        parameters=end.unknowns[0, :shared],
        covariance=covariance_of_shared(end.model.information, shared),
        initial_state=jnp.concatenate([problem.initial_guess.known, end.unknowns[:, shared:]], axis=1).ravel(),
        cost=end.model.cost.sum(),
        rollouts=end.rollouts,
        sweeps=end.sweeps,
        feasible=end.model.feasible.all(),
        done=end.done,
        reach=solver.reach,
        parts=end.model.parts,
    )


def before_search(
    problem: AbstractProblem,
    spread: Float[Array, "given given"] | None = None,
    skip: Bool[Array, ""] | bool = False,
) -> Found:
    """The knowledge before a search: the first start and its covariance, and nothing about the cost.

    `spread`: see `solve`. By default, `off` of the initial guess counts as two standard deviations.
    """
    guess, zero = problem.initial_guess, jnp.zeros((), dtype=int)
    start, wide = guess.starts[0], jax.vmap(jnp.diag)(jnp.square(guess.off / 2))
    windows, count = start.shape
    none, no = jnp.zeros(windows, dtype=start.dtype), jnp.zeros(windows, dtype=bool)
    information = jnp.zeros((windows, count, count), dtype=start.dtype)
    nothing = LocalModel(none, no, jnp.zeros_like(start), information, problem.no_parts)
    if spread is not None:
        given = slice(spread.shape[0])
        # A search that is skipped may have no finite spread.
        wide = wide.at[:, given, given].set(jnp.where(skip, wide[:, given, given], spread))
    return Found(start, nothing, wide, zero, zero, jnp.zeros((), dtype=bool))


def _starts(problem: AbstractProblem, start: Array | None) -> Float[Array, "starts windows unknowns"]:
    """The starts of the problem, with the `start` that is given."""
    starts, unknowns = problem.initial_guess.starts, problem.unknowns
    if start is None:
        return starts
    if start.ndim == 1:
        if start.shape != (unknowns.count,):
            raise ValueError(f"`start` must hold {unknowns.count} unknowns, got shape {start.shape}.")
        start = jnp.full(starts.shape[1:], jnp.nan).at[:, : unknowns.count].set(start)
    free = jnp.ones(starts.shape[2], dtype=bool).at[: unknowns.count].set(unknowns.free)
    return jnp.where(jnp.isnan(start) | ~free, starts, start)


def cost_of(model: LocalModel) -> Scalar:
    """The cost of all windows; infinite for a trajectory that fails."""
    return jnp.where(model.feasible.all() & jnp.isfinite(model.cost).all(), model.cost.sum(), jnp.inf)


def before_shots(model: LocalModel) -> LocalModel:
    """A local model before the first shot: its cost is not known, and nothing is feasible."""
    return model._replace(cost=jnp.full_like(model.cost, jnp.nan), feasible=jnp.zeros_like(model.feasible))


def chosen(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """The tree `new` if the condition holds, else `old`."""
    return jax.tree.map(functools.partial(jnp.where, condition), new, old)
