"""Ant colony optimisation for continuous domains (ACO_R): a population-based baseline.

An archive holds the best points so far. Each ant chooses one of them, preferring good ones, and samples from a Gaussian
around it. Its standard deviation along each direction is proportional to the mean distance of the archive from the
point. The new points replace the worst, so that the archive contracts around a minimum. The directions are drawn from
the archive.

Reference: Socha and Dorigo 2008, European Journal of Operational Research 185(3), 1155-1173: the kernels in sec. 3, and
the rotation for correlated variables in sec. 4. In the paper each ant has its own directions; here all ants of a sweep
share them.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Key, Scalar, integer, setting
from ..estimate import REACH
from ..shooting import ROUNDING, Stage, WindowUnknowns
from .solver import AbstractSolver, Found, cost_of

Points = Float[Array, "archive unknowns"]
Costs = Float[Array, " archive"]


class Colony(NamedTuple):
    """The archive, best point first.

    - `points`, `costs`: the unknowns of the points, in half-widths from the start, and their costs.
    - `start`: the unknowns where the search began.
    - `sweeps`: the number of sweeps so far.
    """

    points: Points
    costs: Costs
    start: WindowUnknowns
    sweeps: Int[Array, ""]


class AntColony(AbstractSolver[Colony]):
    """Ant colony optimisation (ACO_R) of the cost, without derivatives.

    It finds the same optimum as the other methods that shoot, with many times their rollouts, and so shows the value of
    derivatives. Use another method if the initial state is free, which adds 3 to 12 unknowns for each window.

    - `archive`: number of points. The first is the bracket's center, the others are uniform in the bracket.
    - `ants`: number of new points in each sweep. They are simulated in parallel.
    - `q`: the weight of a choice is a Gaussian of the point's rank, with this standard deviation, as a share of the
      archive.
    - `xi`: standard deviation of an ant's step, in mean distances of the archive from its point.
    - `tolerance`: the search ends once the worst point of the archive costs at most this much more than the best one.
      An error of one standard deviation costs 0.5.
    - `max_sweeps`: the search ends after this many sweeps at the latest.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    - `shares`: see `AbstractProblem.stages`; by default the likelihood is searched as a whole.

    `rollouts` count each point, and the Fisher information at the answer, whose inverse is the covariance. All flights
    have the same random numbers.
    """

    in_comparison: ClassVar[bool] = False  # `experiments/comparison` includes it
    is_local: ClassVar[bool] = False

    archive: int = eqx.field(static=True, converter=integer("archive", 2, static=True), default=50)
    ants: int = eqx.field(static=True, converter=integer("ants", 1, static=True), default=10)
    q: Scalar = eqx.field(converter=setting("q", positive=True), default=0.05)
    xi: Scalar = eqx.field(converter=setting("xi", positive=True), default=0.85)
    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=1e-3)
    max_sweeps: Count = eqx.field(converter=integer("max_sweeps", 1), default=5000)
    reach: Scalar = eqx.field(converter=setting("reach", positive=True), default=REACH)
    shares: tuple[float, ...] = eqx.field(static=True, default=())

    def init(self, stage: Stage, before: Found) -> Colony:
        """The start, and points drawn uniformly around it."""
        (windows, unknowns), count = stage.off.shape, stage.unknowns.count
        shape = self.archive, count + windows * (unknowns - count)
        points = jax.random.uniform(self._keys[1], shape, minval=-1, maxval=1, dtype=float).at[0].set(0.0)
        costs = self._shoot(stage, before.unknowns, points)
        return Colony(*self._best(points, costs), before.unknowns, jnp.zeros((), dtype=int))

    def step(self, stage: Stage, state: Colony) -> Colony:
        """One sweep: the ants' points replace the worst of the archive."""
        points = state.points
        basis_key, choice_key, step_key = jax.random.split(jax.random.fold_in(self._keys[0], state.sweeps), 3)
        log_weights = -0.5 * jnp.square(jnp.arange(self.archive) / (self.q * self.archive))
        chosen = jax.random.categorical(choice_key, log_weights, shape=(self.ants,))
        basis = _directions(points - points[chosen[0]], basis_key)
        along = (points[:, None, :] * basis).sum(axis=-1)
        distances = jnp.abs(along - along[chosen][:, None]).sum(axis=1) / (self.archive - 1)
        steps = self.xi * distances * jax.random.normal(step_key, distances.shape, dtype=float)
        new = jnp.clip(points[chosen] + (steps[:, :, None] * basis).sum(axis=1), -self.reach, self.reach)
        points = jnp.concatenate([points, new])
        costs = jnp.concatenate([state.costs, self._shoot(stage, state.start, new)])
        return Colony(*self._best(points, costs), state.start, state.sweeps + 1)

    def terminate(self, stage: Stage, state: Colony) -> Bool[Array, ""]:
        """Whether the archive has contracted."""
        return self._settled(state.costs) | (state.sweeps >= self.max_sweeps)

    def postprocess(self, stage: Stage, state: Colony, before: Found) -> Found:
        """The best point."""
        unknowns = self._unknowns(stage, state.start, state.points[0])
        rollouts = self.archive + self.ants * state.sweeps + 1 + state.points.shape[1]
        model, done = stage.local_model(unknowns), self._settled(state.costs)
        return Found(unknowns, model, before.spread, state.sweeps, rollouts, done)

    @property
    def _keys(self) -> tuple[Key, Key]:
        """The random keys of the sweeps and of the first archive."""
        sweeps, first = jax.random.split(jax.random.key(0))
        return sweeps, first

    def _unknowns(self, stage: Stage, start: WindowUnknowns, point: Float[Array, " unknowns"]) -> WindowUnknowns:
        """The unknowns of a point in the rows of windows: the shared ones, then the window's initial state."""
        count, width = stage.unknowns.count, jnp.where(stage.searched, stage.off, 0.0)
        own = point[count:].reshape(start.shape[0], -1)
        steps = jnp.concatenate([jnp.broadcast_to(point[:count], (start.shape[0], count)), own], axis=1)
        return jnp.clip(start + width * steps, *stage.limits(self.reach))

    def _shoot(self, stage: Stage, start: WindowUnknowns, points: Float[Array, "some unknowns"]) -> Array:
        """The cost of each point; infinite if its trajectory fails."""
        return jax.vmap(lambda point: cost_of(stage.local_model(self._unknowns(stage, start, point))))(points)

    def _best(self, points: Float[Array, "tried unknowns"], costs: Float[Array, " tried"]) -> tuple[Points, Costs]:
        """The best points, as many as the archive holds, in order of cost; points of equal cost in order of age."""
        order = jnp.argsort(costs, stable=True)[: self.archive]
        return points[order], costs[order]

    def _settled(self, costs: Costs) -> Bool[Array, ""]:
        """Whether the costs of the archive agree, within their rounding errors, or none is finite."""
        tolerance = self.tolerance + ROUNDING * jnp.finfo(costs.dtype).eps * costs[0]
        return ~(costs[-1] - costs[0] > tolerance)


def _directions(differences: Points, key: Key) -> Float[Array, "unknowns unknowns"]:
    """An orthonormal basis, one direction in each row, drawn from the differences of the archive from a point.

    Gram-Schmidt: a remaining difference of length d is drawn with a probability proportional to d^4. If none remains,
    the direction is 0.
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
