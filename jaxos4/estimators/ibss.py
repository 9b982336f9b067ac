"""Iterative Bi-Section Shooting: halve a bracket on the slope of the trajectory mismatch, one direction at a time.

The paper names the method; its steps are not available to us, and those below are our choice. A *shot* simulates the
flight at trial unknowns and returns the slope of the cost along a direction, by one forward-mode derivative. The sign
of the slope tells which half of the bracket holds the minimum. A *sweep* bisects along every direction once; brackets
are then recentred, shrink with the moves, and grow where a search ended at their end.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Parameters, Scalar, as_float
from ..bracket import Bracket
from ..dynamics import CASCADE_ORDER, CHANNELS
from ..information import cholesky, invert, invert_factor, invert_marginal
from ..results import RESULTS
from ..shooting import ROUNDING, Rows, ShootingProblem
from ._estimate import AbstractEstimator, Estimate

DIRECTIONS = ("whitened", "coordinate")

# Shares of the flight against which the rates are fitted before the whole of it. Errors grow with time, and the cost
# of a long flight has other minima: CorrectedOS4 falls into one in a fifth of all cases otherwise.
_HORIZONS = (0.1, 0.3)
# A stage that is not the last stops once no direction moves by more than this many standard deviations.
_COARSE = 0.5
# A bracket opens this many predicted standard deviations to each side.
_OPENING = 4.0
# The next bracket holds this share of the sweep's largest move: what the other directions may have spoilt.
_SPOILT = 0.25
# A bracket whose search ended at its end grows by this factor.
_GROWTH = 4.0


class _Search(NamedTuple):
    unknowns: Float[Array, " unknowns"]
    half_width: Float[Array, " unknowns"]
    covariance: Float[Array, "unknowns unknowns"]
    sweeps: Int[Array, ""]
    rollouts: Int[Array, ""]
    done: Bool[Array, ""]


class _Progress(NamedTuple):
    unknowns: Float[Array, " unknowns"]
    spread: Float[Array, "unknowns unknowns"]
    sweeps: Int[Array, ""]
    rollouts: Int[Array, ""]
    done: Bool[Array, ""]


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    **Arguments:**

    - `directions`: `"whitened"`: the columns of L^-T, where F = L L^T is the Fisher information at the current
      estimate, in which the cost is nearly separable; taken down the cascade, first against the rates, then with the
      attitude, then with all channels, as far as the problem's channels go. `"coordinate"`: the parameters themselves
      against all of the problem's channels at once, in the manner of the paper; good on the rates, slow
      beyond them.
    - `halvings`: of each bracket in a sweep.
    - `max_sweeps`: in each stage.
    - `tolerance`: the search ends once no direction moves by more than this share of its standard deviation, judged
      from the actual residuals, so that noise-free data are fitted to rounding.
    - `reach`: hard limits, in half-widths of the bracket around its center.

    An initial state that is free is searched like the parameters, from the first measurement of each channel.
    """

    directions: str = eqx.field(static=True, default="whitened")
    halvings: int = eqx.field(static=True, default=6)
    max_sweeps: int = eqx.field(static=True, default=40)
    tolerance: Scalar = eqx.field(converter=as_float, default=0.02)
    reach: Scalar = eqx.field(converter=as_float, default=4.0)

    def __check_init__(self):
        if self.directions not in DIRECTIONS:
            raise ValueError(f"`directions` must be one of {', '.join(DIRECTIONS)}, got {self.directions!r}.")
        for name, least in (("halvings", 2), ("max_sweeps", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        for name in ("tolerance", "reach"):
            value = getattr(self, name)
            if not isinstance(value, Tracer) and not value > 0:
                raise ValueError(f"`{name}` must be positive, got {value}.")

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket, *, start: Parameters | None = None) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `problem`: what is to be explained.
        - `bracket`: where the parameters are looked for; it may turn out not to hold them.
        - `start`: where in the bracket the search begins; its center by default.

        **Raises:** `ValueError` for a bracket or a start of another length than the model's parameters.
        """
        names = problem.model.parameter_names
        if bracket.lower.shape != (len(names),):
            raise ValueError(f"`bracket` must hold {len(names)} parameters, got {bracket.lower.shape[0]}.")
        if start is not None and jnp.shape(start) != (len(names),):
            raise ValueError(f"`start` must hold {len(names)} parameters, got shape {jnp.shape(start)}.")
        center = jnp.where(bracket.valid, bracket.center, 0.0)
        half_width = jnp.where(bracket.valid, bracket.half_width, 1.0)
        lower, upper = center - self.reach * half_width, center + self.reach * half_width
        parameters = center if start is None else jnp.clip(as_float(start), lower, upper)

        initial_state, off = problem.first_state()
        free = problem.free_size
        prior = jnp.concatenate([half_width, off[:free]]) / 2
        far = jnp.full(free, jnp.inf)
        limits = (jnp.concatenate([lower, -far]), jnp.concatenate([upper, far]))

        def fit(channels: str, progress: _Progress, share: Scalar) -> _Progress:
            stage = problem.restrict(channels)
            rows = _until(share, stage.rows())
            size = len(names) + stage.free_size
            last = (channels == problem.channels) & (share == 1)
            search = self._search(
                stage,
                rows,
                progress.unknowns[:size],
                initial_state=initial_state[: stage.size],
                spread=progress.spread[:size, :size],
                prior=prior[:size],
                limits=(limits[0][:size], limits[1][:size]),
                last=last,
            )
            return _Progress(
                progress.unknowns.at[:size].set(search.unknowns),
                progress.spread.at[:size, :size].set(search.covariance),
                progress.sweeps + search.sweeps,
                progress.rollouts + search.rollouts,
                search.done,
            )

        none = jnp.zeros((), dtype=int)
        unknowns = jnp.concatenate([parameters, initial_state[:free]])
        progress = _Progress(unknowns, jnp.diag(prior**2), none, none, jnp.zeros((), dtype=bool))
        whole = as_float(1.0)
        if self.directions == "whitened":
            shares = jnp.asarray((*_HORIZONS, 1.0), dtype=float)
            # One scan, so that the search against the rates is compiled once.
            progress, _ = jax.lax.scan(lambda p, share: (fit("rates", p, share), None), progress, shares)
            for channels, size in CHANNELS.items():
                if CHANNELS["rates"] < size <= problem.size:
                    progress = fit(channels, progress, whole)
        else:
            progress = fit(problem.channels, progress, whole)

        parameters = progress.unknowns[: len(names)]
        if free:
            initial_state = progress.unknowns[len(names) :]
        (cost, trusted), _, information = problem.curvature(problem.rows(), parameters, initial_state)
        bound = invert_marginal(information, len(names))
        std = jnp.sqrt(jnp.diagonal(bound))
        at_bound = jnp.minimum(parameters - lower, upper - parameters) < 1e-3 * half_width
        sound = trusted & jnp.isfinite(cost) & jnp.isfinite(parameters).all() & jnp.isfinite(bound).all()
        result = RESULTS.where(progress.done, RESULTS.successful, RESULTS.max_sweeps)
        result = RESULTS.where(at_bound.any(), RESULTS.at_bound, result)
        result = RESULTS.where((std > half_width).any(), RESULTS.unidentifiable, result)
        result = RESULTS.where(sound, result, RESULTS.nonfinite_trajectory)
        result = RESULTS.where(bracket.valid, result, RESULTS.bracket_invalid)
        sound = sound & bracket.valid
        return Estimate(
            parameters=jnp.where(sound, parameters, center),
            covariance=jnp.where(sound, bound, jnp.inf),
            initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
            cost=jnp.where(sound, cost, jnp.inf),
            rollouts=progress.rollouts + prior.size,
            sweeps=progress.sweeps,
            result=result,
        )

    def _search(
        self,
        problem: ShootingProblem,
        rows: Rows,
        unknowns: Float[Array, " unknowns"],
        *,
        initial_state: Float[Array, " size"],
        spread: Float[Array, "unknowns unknowns"],
        prior: Float[Array, " unknowns"],
        limits: tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]],
        last: Bool[Array, ""],
    ) -> _Search:
        """Sweeps until the moves are small.

        **Arguments:**

        - `rows`: the part of the flight that is fitted.
        - `unknowns`: where to start: the parameters and, where it is free, the initial state.
        - `initial_state`: taken where it is not free.
        - `spread`: the covariance of `unknowns`, which opens the brackets.
        - `prior`: the standard deviation of each unknown without the flight, from the bracket.
        - `limits`: of the unknowns.
        - `last`: whether to stop at `tolerance`, or coarsely.
        """
        count = unknowns.size - problem.free_size

        finest = _finest(problem, rows)

        def split(u):
            return u[:count], u[count:] if problem.free_size else initial_state

        def slope(u, direction) -> Callable[[Scalar], Scalar]:
            def at(step: Scalar) -> Scalar:
                def cost(s: Scalar) -> Scalar:
                    return problem.shot(rows, *split(u + s * direction)).cost

                _, value = jax.jvp(cost, (step,), (jnp.ones_like(step),))
                return jnp.where(jnp.isfinite(value), value, step)  # a failing shot points back to where it came from

            return at

        def along(u, column) -> tuple[Float[Array, " unknowns"], tuple[Scalar, Bool[Array, ""]]]:
            direction, half_width = column
            below, above = _room(u, direction, limits)
            lower, upper = jnp.maximum(-half_width, -below), jnp.minimum(half_width, above)
            step, at_end = _bisect(slope(u, direction), lower, upper, self.halvings)
            limited = jnp.where(step < 0, below, above) <= half_width
            return u + step * direction, (step, at_end & ~limited)

        def sweep(search: _Search) -> _Search:
            (cost, _), _, information = problem.curvature(rows, *split(search.unknowns))
            information = information + jnp.diag(1 / jnp.square(prior))
            factor, basis = self._directions(information, count)
            first = _OPENING * jnp.sqrt(jnp.diagonal(factor.T @ spread @ factor))
            half_width = jnp.where(search.sweeps == 0, first, search.half_width)
            moved, (steps, at_end) = jax.lax.scan(along, search.unknowns, (basis.T, half_width))
            move = jnp.abs(steps).max()
            misfit = _misfit(cost, rows)
            coarse = _COARSE * jnp.maximum(misfit, 1.0)
            enough = jnp.where(last, jnp.maximum(self.tolerance * misfit, finest), coarse)
            sound = jnp.isfinite(cost) & jnp.isfinite(moved).all()
            shrunk = half_width * 2.0 ** (1 - self.halvings) + _SPOILT * move
            return _Search(
                unknowns=jnp.where(sound, moved, search.unknowns),
                half_width=jnp.where(at_end, _GROWTH * half_width, shrunk),
                covariance=invert(information) * jnp.square(jnp.maximum(misfit, 1.0)),
                sweeps=search.sweeps + 1,
                rollouts=search.rollouts + unknowns.size * (self.halvings + 1),
                done=~sound | ((move <= enough) & ~(at_end & (half_width > finest)).any()),
            )

        none = jnp.zeros((), dtype=int)
        begin = _Search(unknowns, prior, spread, none, none, jnp.zeros((), dtype=bool))
        return jax.lax.while_loop(lambda s: ~s.done & (s.sweeps < self.max_sweeps), sweep, begin)

    def _directions(
        self, information: Float[Array, "n n"], count: int
    ) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
        """A factor A of the information A A^T, and A^-T, whose columns are the search directions.

        The initial state comes first in the Cholesky factorisation, so that a step along a parameter takes the initial
        state along to where it fits best.
        """
        if self.directions == "coordinate":
            scale = jnp.sqrt(jnp.diagonal(information))
            return jnp.diag(scale), jnp.diag(1 / scale)
        order = jnp.roll(jnp.arange(information.shape[0]), -count)
        back = jnp.argsort(order)
        factor = cholesky(information[jnp.ix_(order, order)])
        return factor[back], invert_factor(factor).T[back]


def _until(share: Scalar, rows: Rows) -> Rows:
    """The rows with nothing measured after a share of the flight."""
    samples = rows.measured[0].size
    within = jnp.arange(samples) < jnp.ceil(share * samples)
    return Rows(rows.forcing, tuple(jnp.where(within, y, jnp.nan) for y in rows.measured))


def _finest(problem: ShootingProblem, rows: Rows) -> Scalar:
    """The move, in standard deviations, below which the sign of a slope is rounding."""
    eps = jnp.finfo(problem.sigma.dtype).eps
    squares = [jnp.nanmean(jnp.square(y)) for y in rows.measured]
    weighted = jnp.sqrt(jnp.nan_to_num(jnp.stack(squares))) / problem.sigma[CASCADE_ORDER[: problem.size]]
    return jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * weighted.max())


def _misfit(cost: Scalar, rows: Rows) -> Scalar:
    """Root mean square of the weighted residuals: 1 where the noise is what the problem's sigma says."""
    measurements = sum((~jnp.isnan(y)).sum() for y in rows.measured)
    return jnp.sqrt(2 * cost / jnp.maximum(measurements, 1))


def _room(
    u: Float[Array, " n"], direction: Float[Array, " n"], limits: tuple[Float[Array, " n"], Float[Array, " n"]]
) -> tuple[Scalar, Scalar]:
    """How far one can go from `u` against and along `direction` within `limits`."""
    to_lower, to_upper = ((limit - u) / jnp.where(direction == 0, 1.0, direction) for limit in limits)
    ahead = jnp.where(direction > 0, to_upper, to_lower)
    behind = jnp.where(direction > 0, to_lower, to_upper)
    above = jnp.where(direction == 0, jnp.inf, ahead).min()
    below = jnp.where(direction == 0, jnp.inf, -behind).min()
    return jnp.maximum(below, 0.0), jnp.maximum(above, 0.0)


def _bisect(
    slope: Callable[[Scalar], Scalar], lower: Scalar, upper: Scalar, halvings: int
) -> tuple[Scalar, Bool[Array, ""]]:
    """The middle of the bracket after `halvings`, and whether the search ended at one of the ends it began with."""

    def halve(ends: tuple[Scalar, Scalar], _) -> tuple[tuple[Scalar, Scalar], None]:
        low, high = ends
        middle = (low + high) / 2
        value = slope(middle)
        return (jnp.where(value <= 0, middle, low), jnp.where(value >= 0, middle, high)), None

    (low, high), _ = jax.lax.scan(halve, (lower, upper), length=halvings)
    return (low + high) / 2, (low == lower) | (high == upper)
