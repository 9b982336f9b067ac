"""Ant colony optimisation for continuous domains (ACO_R): a baseline that searches by a population.

An archive holds the best points so far, in order of their cost. Each ant chooses one of them, a good one more often
than a bad one, and samples a Gaussian around it. The standard deviation along each direction is in proportion to the
mean distance of the archive from the chosen point. The new points replace the worst of the archive, so that the
archive contracts around a minimum. The directions are drawn from the archive, because the parameters are correlated.

Reference: Socha and Dorigo 2008, European Journal of Operational Research 185(3), 1155-1173: the kernels in sec. 3, and
the rotation for correlated variables in sec. 4. One thing differs: here all ants of a sweep share the directions, which
the reference draws for each ant.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Key, Scalar, integer, setting
from ..bracket import Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, estimate_at
from ..shooting import ROUNDING, AbstractProblem

Points = Float[Array, "archive unknowns"]
Costs = Float[Array, " archive"]


class _Colony(NamedTuple):
    """The archive, best point first: its unknowns in half-widths, and their costs. `sweeps`: how many are done."""

    points: Points
    costs: Costs
    sweeps: Int[Array, ""]


class AntColony(AbstractEstimator):
    """Ant colony optimisation (ACO_R) of the cost, without derivatives.

    It finds the optimum of the other methods that shoot, with many times their rollouts, and so shows what derivatives
    are worth. Use another method if the initial state is free: it adds 3 to 12 unknowns for each window.

    **Arguments:**

    - `archive`: number of points in the archive. The first is the bracket's center, the others are uniform in the
      bracket.
    - `ants`: number of new points in each sweep. They are simulated in parallel.
    - `q`: how many of the points are chosen, as a share of the archive. The weight of a choice is a Gaussian of the
      point's rank, with this standard deviation and a mean at the best point.
    - `xi`: standard deviation of an ant's step, in mean distances of the archive from its point. Smaller values
      contract the archive faster.
    - `tolerance`: the search ends once the worst point of the archive costs at most this much more than the best one.
      The cost is the negative logarithm of a likelihood: an error of one standard deviation costs 0.5.
    - `max_sweeps`: the search ends after this many sweeps at the latest.

    All flights have the same random numbers.
    """

    shoots: ClassVar[bool] = True
    in_closed_loop: ClassVar[bool] = True
    in_comparison: ClassVar[bool] = False  # `experiments/comparison` has it

    archive: int = eqx.field(static=True, converter=integer("archive", 2, static=True), default=50)
    ants: int = eqx.field(static=True, converter=integer("ants", 1, static=True), default=10)
    q: Scalar = eqx.field(converter=setting("q", positive=True), default=0.05)
    xi: Scalar = eqx.field(converter=setting("xi", positive=True), default=0.85)
    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=1e-3)
    max_sweeps: Count = eqx.field(converter=integer("max_sweeps", 1), default=5000)

    @eqx.filter_jit
    def __call__(self, problem: AbstractProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        The estimate's `rollouts` count each point that was simulated, and the Fisher information at the answer. The
        covariance is the inverse of this information, the only use of derivatives.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        problem = problem.within(bracket)
        usable, count, (first, off) = problem.unknowns.usable, problem.unknowns.count, problem.first_state()
        unknowns = count + problem.windows * problem.free_size

        def split(point: Float[Array, " unknowns"]) -> tuple[Array, Array]:
            """The shared unknowns and the initial state of a point."""
            start = first + off * point[count:] if problem.free_size else first
            return jnp.clip(usable.center + usable.width * point[:count], *usable.limits(REACH)), start

        @jax.vmap
        def shoot(point: Float[Array, " unknowns"]) -> Scalar:
            """The cost of a point; infinite if its trajectory fails."""
            cost, feasible = problem.shots(*split(point))
            return jnp.where(feasible & jnp.isfinite(cost), cost, jnp.inf)

        def sweep(colony: _Colony) -> _Colony:
            new = self._sample(colony.points, jax.random.fold_in(key, colony.sweeps))
            points, costs = jnp.concatenate([colony.points, new]), jnp.concatenate([colony.costs, shoot(new)])
            return _Colony(*self._best(points, costs), colony.sweeps + 1)

        key, begin = jax.random.split(jax.random.key(0))
        points = jax.random.uniform(begin, (self.archive, unknowns), minval=-1, maxval=1, dtype=float).at[0].set(0.0)
        colony = _Colony(*self._best(points, shoot(points)), jnp.zeros((), dtype=int))
        colony = jax.lax.while_loop(lambda c: ~self._settled(c.costs) & (c.sweeps < self.max_sweeps), sweep, colony)
        parameters, initial_state = split(colony.points[0])
        curvature = problem.curvatures(parameters, initial_state)
        answer = problem.join(parameters, initial_state)
        rollouts = self.archive + self.ants * colony.sweeps + 1 + unknowns
        return estimate_at(problem, answer, curvature, rollouts, colony.sweeps, done=self._settled(colony.costs))

    def _best(self, points: Float[Array, "tried unknowns"], costs: Float[Array, " tried"]) -> tuple[Points, Costs]:
        """The best points, as many as the archive holds, in order of their cost; equal ones by age."""
        order = jnp.argsort(costs, stable=True)[: self.archive]
        return points[order], costs[order]

    def _settled(self, costs: Costs) -> Bool[Array, ""]:
        """Whether the costs of the archive agree, within their rounding errors, or none is finite."""
        tolerance = self.tolerance + ROUNDING * jnp.finfo(costs.dtype).eps * costs[0]
        return ~(costs[-1] - costs[0] > tolerance)

    def _sample(self, points: Points, key: Key) -> Float[Array, "ants unknowns"]:
        """A new point of each ant."""
        basis_key, choice_key, step_key = jax.random.split(key, 3)
        log_weights = -0.5 * jnp.square(jnp.arange(self.archive) / (self.q * self.archive))
        chosen = jax.random.categorical(choice_key, log_weights, shape=(self.ants,))
        basis = _directions(points - points[chosen[0]], basis_key)
        along = (points[:, None, :] * basis).sum(axis=-1)
        distances = jnp.abs(along - along[chosen][:, None]).sum(axis=1) / (self.archive - 1)
        steps = self.xi * distances * jax.random.normal(step_key, distances.shape, dtype=float)
        return jnp.clip(points[chosen] + (steps[:, :, None] * basis).sum(axis=1), -REACH, REACH)


def _directions(differences: Points, key: Key) -> Float[Array, "unknowns unknowns"]:
    """An orthonormal basis, one direction in each row, drawn from the differences of the archive from a point.

    Each direction is a difference, less its part along the directions before it (Gram-Schmidt). A remaining difference
    of length d is drawn with a probability in proportion to d^4. If none remains, the other directions are 0.
    """
    rounding = ROUNDING * jnp.finfo(differences.dtype).eps
    floor = jnp.square(rounding) * jnp.square(differences).sum(axis=1).max()

    def draw(remaining: Points, key: Key) -> tuple[Points, Float[Array, " unknowns"]]:
        square = jnp.square(remaining).sum(axis=1)
        square = jnp.where(square > floor, square, 0.0)
        drawn = jax.random.categorical(key, 2 * jnp.log(square))
        exists = square[drawn] > 0
        size = jnp.sqrt(jnp.where(exists, square[drawn], 1.0))
        direction = jnp.where(exists, remaining[drawn] / size, 0.0)
        along = (remaining * direction).sum(axis=1)
        return remaining - along[:, None] * direction, direction

    return jax.lax.scan(draw, differences, jax.random.split(key, differences.shape[1]))[1]
