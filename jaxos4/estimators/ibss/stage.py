"""One stage of the search: a problem on some of its channels, and the slope of its cost along a direction."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._custom_types import Parameters, Scalar
from ...bracket import Bracket
from ...flight import Inputs
from ...shooting import ROUNDING, Rows, ShootingProblem

Limits = tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]
RowsAt = Callable[[Float[Array, "windows unknowns"]], Rows]


class Stage(NamedTuple):
    """What does not change while one stage is searched.

    The *unknowns* have one row for each window: the parameters, the same in all rows, then the window's own initial
    state if it is free. Directions are numbered in the opposite order: those of the initial states come first.

    - `rows`: the part of the flight that is fitted.
    - `starts`: initial states, used where these are known.
    - `inputs`: what the forcing is computed from.
    - `prior`: information about the unknowns without the flight: a bracket's half-width is two standard deviations.
      The windows share the information about a parameter, so that it counts once.
    - `limits`: the least and the greatest value of each unknown.
    - `smallest_step`: the step, in standard deviations, below which rounding decides the sign of a slope.
    """

    problem: ShootingProblem
    rows: Rows
    starts: Float[Array, "windows size"]
    inputs: Inputs
    prior: Float[Array, "windows unknowns unknowns"]
    limits: Limits
    smallest_step: Scalar

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return len(self.problem.model.parameter_names)

    @property
    def size(self) -> int:
        """Number of unknowns of one window."""
        return self.parameter_count + self.problem.free_size

    def with_forcing(self, unknowns: Float[Array, "windows unknowns"], *, tangents: bool = False) -> Rows:
        """The rows with the forcing of these parameters, and its derivatives if wanted."""
        return self.problem.with_forcing(
            self.rows, unknowns[0, : self.parameter_count], inputs=self.inputs, tangents=tangents
        )

    def fly(self, function: Callable, rows: Rows, unknowns: Float[Array, "windows unknowns"]):
        """`function` (`problem.shot` or `problem.curvature`) of every window."""
        starts = unknowns[:, self.parameter_count :] if self.problem.free_size else self.starts
        return jax.vmap(function)(rows, unknowns[:, : self.parameter_count], starts)

    def summed(self, number: Int[Array, ""], slopes: Float[Array, " windows"]) -> Float[Array, " windows"]:
        """Slopes along direction `number`: summed over the windows, if the direction belongs to all of them."""
        return jnp.where(number >= self.problem.free_size, slopes.sum(), slopes)

    def slope(
        self,
        rows_at: RowsAt,
        unknowns: Float[Array, "windows unknowns"],
        direction: Float[Array, "windows unknowns"],
        number: Int[Array, ""],
    ) -> Callable[[Float[Array, " windows"]], Float[Array, " windows"]]:
        """The slope of the cost as a function of the step from `unknowns` along direction `number`.

        Each call is one shot. A failed shot returns the step itself as the slope, which points back to the beginning.
        """

        def at(step: Float[Array, " windows"]) -> Float[Array, " windows"]:
            def cost(s: Float[Array, " windows"]) -> Float[Array, " windows"]:
                moved = unknowns + s[:, None] * direction
                return self.fly(self.problem.shot, rows_at(moved), moved).cost

            value = self.summed(number, jax.jvp(cost, (step,), (jnp.ones_like(step),))[1])
            return jnp.where(jnp.isfinite(value), value, step)

        return at


def make_stage(problem: ShootingProblem, rows: Rows, bracket: Bracket, limits: Limits) -> Stage:
    """The stage that fits `rows` of a problem."""
    count = bracket.lower.shape[0]
    starts, inputs = problem.split(problem.first_state()[0]), problem.flight.inputs
    prior = 1 / jnp.square(prior_std(problem, bracket))
    prior = jax.vmap(jnp.diag)(prior.at[:, :count].divide(problem.windows))
    return Stage(problem, rows, starts, inputs, prior, limits, _smallest_step(problem, rows))


def join(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"]
) -> Float[Array, "windows unknowns"]:
    """The unknowns of each window: the parameters, and its initial state if that is free."""
    repeated = jnp.broadcast_to(parameters, (problem.windows, parameters.shape[0]))
    return jnp.concatenate([repeated, problem.split(initial_state)[:, : problem.free_size]], axis=1)


def prior_std(problem: ShootingProblem, bracket: Bracket) -> Float[Array, "windows unknowns"]:
    """Standard deviation of each unknown without the flight: half of how far off the unknown may be."""
    return join(problem, bracket.half_width, problem.first_state()[1]) / 2


def keep_first(share: Scalar, rows: Rows) -> Rows:
    """The rows with all measurements after the first `share` of each window removed."""
    samples = rows.measured[0].shape[-1]
    within = jnp.arange(samples) < jnp.ceil(share * samples)
    return rows._replace(measured=tuple(jnp.where(within, y, jnp.nan) for y in rows.measured))


def misfit(cost: Scalar, rows: Rows) -> Scalar:
    """Root mean square of the weighted residuals: 1 if the noise is as large as the problem's sigma."""
    measured = jnp.stack(rows.measured)
    return jnp.sqrt(2 * cost / jnp.maximum(measured.size - jnp.isnan(measured).sum(), 1))


def _smallest_step(problem: ShootingProblem, rows: Rows) -> Scalar:
    eps = jnp.finfo(problem.sigma.dtype).eps
    squares = [jnp.nanmean(jnp.square(y)) for y in rows.measured]
    weighted = jnp.sqrt(jnp.nan_to_num(jnp.stack(squares))) / problem.sigma[problem.columns]
    return jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * weighted.max())
