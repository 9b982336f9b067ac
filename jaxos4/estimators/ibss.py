"""Iterative Bi-Section Shooting: halve a bracket on the slope of the trajectory mismatch, one direction at a time.

The paper names the method; its steps are not available to us, and those below are our choice. A *shot* simulates the
flight at trial unknowns and returns the slope of the cost along a direction, by one forward-mode derivative. The sign
of the slope tells which half of the bracket holds the minimum. A *sweep* bisects along every direction once, each in a
bracket around the point where the cost's quadratic model has its minimum; the bracket is as wide as the last sweep's
predictions were off, and grows where a search ended at its end.

Of a flight cut into windows, each has its initial state: directions of the parameters are bisected on the sum of the
windows' slopes, those of the initial states in all windows at once, each on its own slope. Unknowns are held window by
window, a row each, the same parameters in all of them.
"""

import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Parameters, Scalar, as_float
from ..bracket import NO_PRIOR, Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, check_bracket, conclude
from ..linalg import covariance_of_shared, covariances, inverse_transpose, joint_factor
from ..models.state import CHANNELS
from ..results import RESULTS
from ..shooting import ROUNDING, Curvature, Rows, ShootingProblem, Shot

DIRECTIONS = ("whitened", "coordinate")

# Shares of the flight against which the rates are fitted before the whole of it. Errors grow with time, and the cost
# of a long flight has other minima: CorrectedOS4 falls into one in a fifth of all cases otherwise.
_HORIZONS = (0.1, 0.3)
# A stage that is not the last stops once no direction has more than this many standard deviations to go.
_COARSE = 0.5
# The first sweep goes this many of the start's standard deviations at most, in brackets of this share of them.
_OPENING = 4.0
_FIRST = 0.05
# Later brackets are this many times as wide as the prediction is off, of which this share of the way is the least.
_SAFETY = 2.0
_LEAST = 0.01
# A bracket whose search ended at its end grows by this factor.
_GROWTH = 4.0
# A seed is missed where the answer is this many of its 99.9 % half-widths away: then the wide bracket is searched too.
_MISSED = 2.0
# So it is where the cost is this many of its standard deviations above what noise of the problem's sigma makes it.
_UNEXPLAINED = 5.0


class _Search(NamedTuple):
    """Where a search stands; `curvature` and `basis`, the directions, are those of the last look around."""

    unknowns: Float[Array, "windows unknowns"]
    curvature: Curvature
    basis: Float[Array, "windows unknowns unknowns"]
    off: Scalar
    growth: Float[Array, "windows unknowns"]
    sweeps: Int[Array, ""]
    done: Bool[Array, ""]
    ended: Bool[Array, ""]
    brackets: Float[Array, "record 2 parameters"] | None


class _Progress(NamedTuple):
    unknowns: Float[Array, "windows unknowns"]
    spread: Float[Array, "windows unknowns unknowns"]
    sweeps: Int[Array, ""]
    rollouts: Int[Array, ""]
    done: Bool[Array, ""]
    brackets: Float[Array, "record 2 parameters"] | None


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
    - `tolerance`: the search ends once no direction has more than this share of its standard deviation to go, judged
      from the actual residuals, so that noise-free data are fitted to rounding.
    - `reach`: hard limits, in half-widths of the bracket around its center.
    - `record`: how many sweeps' brackets the estimate keeps, to show how a search went.

    An initial state that is free is searched like the parameters, from the first measurement of each channel.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    directions: str = eqx.field(static=True, default="whitened")
    halvings: int = eqx.field(static=True, default=4)
    max_sweeps: int = eqx.field(static=True, default=60)
    tolerance: Scalar = eqx.field(converter=as_float, default=0.02)
    reach: Scalar = eqx.field(converter=as_float, default=REACH)
    record: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.directions not in DIRECTIONS:
            raise ValueError(f"`directions` must be one of {', '.join(DIRECTIONS)}, got {self.directions!r}.")
        for name, least in (("halvings", 2), ("max_sweeps", 1), ("record", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        for name in ("tolerance", "reach"):
            value = getattr(self, name)
            if not isinstance(value, Tracer) and not value > 0:
                raise ValueError(f"`{name}` must be positive, got {value}.")

    @eqx.filter_jit
    def __call__(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        *,
        start: Parameters | None = None,
        spread: Float[Array, "parameters parameters"] | None = None,
        seed: Estimate | None = None,
    ) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `problem`: what is to be explained.
        - `bracket`: where the parameters are looked for; it may turn out not to hold them.
        - `start`: where in the bracket the search begins; its center by default.
        - `spread`: the covariance of `start`, which sizes the first brackets; by default they are as wide as `bracket`.
        - `seed`: an earlier estimate of the same flight. The search then begins against all of the problem's channels
          at once, in brackets around the seed that are sized by its covariance. Where that does not end well, or far
          from the seed, or leaves more unexplained than noise, the bracket is searched as if there were none, and the
          better answer is returned.

        **Raises:** `ValueError` for a bracket or a start of another length than the model's parameters.
        """
        check_bracket(problem, bracket)
        names = problem.model.parameter_names
        if start is not None and jnp.shape(start) != (len(names),):
            raise ValueError(f"`start` must hold {len(names)} parameters, got shape {jnp.shape(start)}.")
        trusted = bracket.usable
        begin = trusted.center if start is None else as_float(start)
        if seed is None:
            wide = self._descend(problem, trusted, begin, spread=spread, asleep=jnp.zeros((), dtype=bool))
            return self._finish(problem, bracket, *wide)

        near = self._finish(problem, bracket, *self._from_seed(problem, trusted, seed))
        half_width = seed.half_width(0.999, simultaneous=True)
        far = jnp.abs(near.parameters - seed.parameters) > _MISSED * half_width
        measurements = jnp.sum(~jnp.isnan(problem.measured()))
        explained = 2 * near.cost < measurements + _UNEXPLAINED * jnp.sqrt(2.0 * measurements)
        told = jnp.isfinite(seed.covariance).all()
        # What the flight does not tell near the seed, it does not tell elsewhere.
        ended = (near.result == RESULTS.successful) | (near.result == RESULTS.unidentifiable)
        hit = told & ended & ~far.any() & explained

        def search_wide(carry: tuple[Estimate, Bool[Array, ""]]) -> tuple[Estimate, Bool[Array, ""]]:
            near, hit = carry
            wide = self._finish(problem, bracket, *self._descend(problem, trusted, begin, asleep=hit))
            sound = told & (near.result == RESULTS.successful)
            better = ~sound | ((wide.result == RESULTS.successful) & (wide.cost < near.cost))
            best = jax.tree.map(lambda w, n: jnp.where(better, w, n), wide, near)
            spent = near.rollouts + wide.rollouts, near.sweeps + wide.sweeps
            return eqx.tree_at(lambda e: (e.rollouts, e.sweeps), best, spent), jnp.ones_like(hit)

        # A loop and not a condition: a batch without a miss skips it as a whole.
        best, _ = jax.lax.while_loop(lambda carry: ~carry[1], search_wide, (near, hit))
        return Estimate(
            parameters=best.parameters,
            covariance=best.covariance,
            initial_state=best.initial_state,
            cost=best.cost,
            rollouts=seed.rollouts + best.rollouts,
            sweeps=best.sweeps,
            result=best.result,
            seed=Bracket.around(seed.parameters, half_width),
            brackets=best.brackets,
        )

    def _from_seed(self, problem: ShootingProblem, bracket: Bracket, seed: Estimate) -> tuple[_Progress, Curvature]:
        """Against all channels at once, from a seed; a lane whose seed says nothing is left where it is."""
        told = jnp.isfinite(seed.covariance).all()
        progress = self._begin(problem, bracket, seed.parameters, spread=seed.covariance, asleep=~told)
        return self._search(problem, problem.rows(), progress, bracket, last=jnp.asarray(True))

    def _descend(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        begin: Parameters,
        *,
        spread: Float[Array, "parameters parameters"] | None = None,
        asleep: Bool[Array, ""],
    ) -> tuple[_Progress, Curvature]:
        """Down the cascade, from anywhere in the bracket; a lane that is `asleep` is left where it is."""
        progress = self._begin(problem, bracket, begin, spread=spread, asleep=asleep)

        def fit(channels: str, progress: _Progress, share: Scalar) -> tuple[_Progress, Curvature]:
            stage = problem.restrict(channels)
            last = (channels == problem.channels) & (share == 1)
            progress = progress._replace(done=asleep)
            return self._search(stage, _until(share, stage.rows()), progress, bracket, last=last)

        whole = as_float(1.0)
        if self.directions == "coordinate":
            return fit(problem.channels, progress, whole)
        # A flight cut into windows is short enough as it is.
        shares = jnp.asarray((*_HORIZONS, 1.0) if problem.windows == 1 else (1.0,), dtype=float)
        # One scan, so that the search against the rates is compiled once.
        progress, curvatures = jax.lax.scan(lambda p, share: fit("rates", p, share), progress, shares)
        curvature = jax.tree.map(lambda c: c[-1], curvatures)
        for channels, size in CHANNELS.items():
            if CHANNELS["rates"] < size <= problem.size:
                progress, curvature = fit(channels, progress, whole)
        return progress, curvature

    def _begin(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        parameters: Parameters,
        *,
        spread: Float[Array, "parameters parameters"] | None,
        asleep: Bool[Array, ""],
    ) -> _Progress:
        lower, upper = self._limits(problem, bracket)
        unknowns, count = _joined(problem, parameters, problem.first_state()[0]), parameters.shape[0]
        prior = jax.vmap(jnp.diag)(jnp.square(_prior(problem, bracket)))
        if spread is not None:
            prior = prior.at[:, :count, :count].set(jnp.where(asleep, prior[:, :count, :count], spread))
        none = jnp.zeros((), dtype=int)
        brackets = jnp.full((self.record, 2, count), jnp.nan) if self.record else None
        return _Progress(jnp.clip(unknowns, lower, upper), prior, none, none, asleep, brackets)

    def _limits(
        self, problem: ShootingProblem, bracket: Bracket
    ) -> tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]:
        """How far the search may go: an initial state that is free has no limits."""
        reach, far = self.reach * bracket.half_width, jnp.full(problem.free_size, jnp.inf)
        return jnp.concatenate([bracket.center - reach, -far]), jnp.concatenate([bracket.center + reach, far])

    def _finish(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        progress: _Progress,
        curvature: Curvature,
    ) -> Estimate:
        """The estimate, and how it ended."""
        count = bracket.lower.shape[0]
        initial_state = progress.unknowns[:, count:].ravel() if problem.free_size else problem.first_state()[0]
        estimate = conclude(
            bracket,
            parameters=progress.unknowns[0, :count],
            covariance=covariance_of_shared(curvature.information, count),
            initial_state=initial_state,
            cost=curvature.shot.cost.sum(),
            rollouts=progress.rollouts,
            sweeps=progress.sweeps,
            sound=curvature.shot.sound.all(),
            done=progress.done,
            reach=self.reach,
        )
        return eqx.tree_at(lambda e: e.brackets, estimate, progress.brackets, is_leaf=lambda leaf: leaf is None)

    def _search(
        self,
        problem: ShootingProblem,
        rows: Rows,
        progress: _Progress,
        bracket: Bracket,
        *,
        last: Bool[Array, ""],
    ) -> tuple[_Progress, Curvature]:
        """Sweeps until nothing is left to go, over as many of the unknowns as the problem has.

        **Arguments:**

        - `rows`: the part of the flight that is fitted.
        - `progress`: where to start, and the covariance of that, which opens the brackets. `done`: stay there.
        - `bracket`: its half-width over 2 stands for what is known of each parameter without the flight.
        - `last`: whether to stop at `tolerance`, or coarsely.
        """
        count = bracket.lower.shape[0]
        size, driving = count + problem.free_size, len(problem.model.forcing_parameters)
        own = size - count
        starts, inputs = problem.split(problem.first_state()[0]), problem.flight.inputs
        limits, finest = self._limits(problem, bracket), _finest(problem, rows)
        prior = 1 / jnp.square(_prior(problem, bracket))
        # What is known of the parameters without the flight counts once, not once a window.
        regular = jax.vmap(jnp.diag)(prior.at[:, :count].divide(problem.windows))
        spread = progress.spread[:, :size, :size]

        def gathered(shared: Bool[Array, ""], slopes: Float[Array, " windows"]) -> Float[Array, " windows"]:
            """A slope along a direction that all windows share is the sum of theirs."""
            return jnp.where(shared, slopes.sum(), slopes)

        def driven(u, *, tangents: bool = False) -> Rows:
            return problem.with_forcing(rows, u[0, :count], inputs=inputs, tangents=tangents)

        def fly(function, rows, u):
            return jax.vmap(function)(rows, u[:, :count], u[:, count:] if problem.free_size else starts)

        def slope(rows_at, u, direction, shared) -> Callable[[Float[Array, " windows"]], Float[Array, " windows"]]:
            def at(step: Float[Array, " windows"]) -> Float[Array, " windows"]:
                def cost(s: Float[Array, " windows"]) -> Float[Array, " windows"]:
                    moved = u + s[:, None] * direction
                    return fly(problem.shot, rows_at(moved), moved).cost

                value = gathered(shared, jax.jvp(cost, (step,), (jnp.ones_like(step),))[1])
                return jnp.where(jnp.isfinite(value), value, step)  # a failing shot points back to where it came from

            return at

        def sweep(search: _Search) -> _Search:
            """Looks around, and unless the search ends there goes along each direction."""
            here = driven(search.unknowns, tangents=True)
            curvature = fly(problem.curvature, here, search.unknowns)
            information = curvature.information + regular
            factor, basis = self._directions(information, count, problem.model.forcing_parameters)
            slopes = jnp.einsum("wud,wu->wd", basis, curvature.gradient)
            slopes = slopes.at[:, own:].set(slopes[:, own:].sum(axis=0))
            rooms = jax.vmap(lambda direction: _room(search.unknowns, direction, limits), -1, -1)(basis)
            # What lies beyond the limits is not ahead.
            ahead = jnp.abs(jnp.clip(-slopes, -rooms[0], rooms[1])).max()
            misfit = _misfit(curvature.shot.cost.sum(), rows)
            coarse = _COARSE * jnp.maximum(misfit, 1.0)
            enough = jnp.where(last, jnp.maximum(self.tolerance * misfit, finest), coarse)
            at_first = search.sweeps == 0
            done = ~at_first & (ahead <= enough)
            finite = jnp.isfinite(curvature.shot.cost).all()
            stay = done | ~finite | (search.sweeps >= self.max_sweeps)

            opening = _OPENING * jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", factor, spread, factor))
            later = jnp.maximum(search.off * ahead, finest) * search.growth
            half_width = jnp.where(at_first, _FIRST * opening, later)
            leash = jnp.where(at_first, opening, jnp.inf)

            def along(rows_at, number, moves):
                u, steps, errors, at_end = moves
                direction, shared = basis[:, :, number], number >= own
                below, above = (jnp.minimum(room, leash[:, number]) for room in _room(u, direction, limits))
                moved = curvature.gradient + jnp.einsum("wuv,wv->wu", information, u - search.unknowns)
                predicted = gathered(shared, -(direction * moved).sum(axis=-1))
                predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
                lower = jnp.maximum(predicted - half_width[:, number], -below)
                upper = jnp.minimum(predicted + half_width[:, number], above)
                step, at_lower, at_upper = _bisect(slope(rows_at, u, direction, shared), lower, upper, self.halvings)
                ended = (at_lower & (lower > -below)) | (at_upper & (upper < above))
                return (
                    u + step[:, None] * direction,
                    steps.at[:, number].set(step),
                    errors.at[:, number].set(step - predicted),
                    at_end.at[:, number].set(ended),
                )

            nothing = jnp.zeros_like(search.unknowns)
            moves = (search.unknowns, nothing, nothing, nothing.astype(bool))
            # Of the directions, only the last change what the forcing depends on.
            first = 0 if driving and self.directions == "coordinate" else size - driving
            for begin, end, rows_at in (
                (0, first, lambda _: here._replace(forcing_tangents=None)),
                (first, size, driven),
            ):
                if begin < end:
                    along_these = functools.partial(along, rows_at)
                    moves = jax.lax.fori_loop(begin, jnp.where(stay, begin, end), along_these, moves)
            moved, steps, errors, at_end = moves
            off = _SAFETY * jnp.abs(errors).max() / jnp.maximum(jnp.abs(steps).max(), finest)
            sound = finite & jnp.isfinite(moved).all()
            widest = jnp.abs(basis * half_width[:, None, :]).max(axis=(0, 2))[:count]
            around = search.unknowns[0, :count] + jnp.stack([-widest, widest])
            cost, trusted = curvature.shot
            return _Search(
                unknowns=jnp.where(sound, moved, search.unknowns),
                curvature=curvature._replace(shot=Shot(cost, trusted & sound)),
                basis=basis,
                off=jnp.clip(off, _LEAST, 1.0),
                growth=jnp.where(at_end, _GROWTH * search.growth, 1.0),
                sweeps=search.sweeps + jnp.where(stay, 0, 1),
                done=done | ~sound,
                ended=stay | ~sound,
                brackets=_kept(search.brackets, progress.sweeps + search.sweeps, around, unless=stay),
            )

        begin = progress.unknowns[:, :size]
        zero, one = jnp.zeros((begin.shape[0],), dtype=float), jnp.ones((), dtype=float)
        square = jnp.zeros((*begin.shape, size), dtype=float)
        nowhere = Curvature(Shot(zero, zero > 0), jnp.zeros_like(begin), square)
        search = _Search(
            unknowns=begin,
            curvature=nowhere,
            basis=square,
            off=one,
            growth=jnp.ones_like(begin),
            sweeps=jnp.zeros((), dtype=int),
            done=progress.done,
            ended=progress.done,
            brackets=progress.brackets,
        )
        search = jax.lax.while_loop(lambda s: ~s.ended, sweep, search)
        curvature = search.curvature
        misfit = jnp.maximum(_misfit(curvature.shot.cost.sum(), rows), 1.0)
        if self.directions == "coordinate":
            covariance = covariances(curvature.information + regular, count)
        else:
            covariance = (search.basis[:, :, None, :] * search.basis[:, None, :, :]).sum(axis=-1)
        rollouts = jnp.where(progress.done, 0, size * (1 + search.sweeps * (self.halvings + 1)))
        return _Progress(
            progress.unknowns.at[:, :size].set(search.unknowns),
            progress.spread.at[:, :size, :size].set(jnp.square(misfit) * covariance),
            progress.sweeps + search.sweeps,
            progress.rollouts + rollouts,
            search.done,
            search.brackets,
        ), curvature

    def _directions(
        self, information: Float[Array, "windows n n"], count: int, driving: tuple[int, ...]
    ) -> tuple[Float[Array, "windows n n"], Float[Array, "windows n n"]]:
        """A factor A of the information A A^T, and A^-T: the search directions, the initial state's first.

        The initial state comes first in the Cholesky factorisation, so that a step along a parameter takes the initial
        states along to where they fit best. Parameters that the forcing depends on, `driving`, come last: directions
        before theirs leave it as it is.
        """
        if self.directions == "coordinate":
            size = information.shape[-1]
            diagonal = jax.vmap(jnp.diagonal)(information)
            scale = jnp.sqrt(diagonal.at[:, :count].set(diagonal[:, :count].sum(axis=0)))
            columns = jnp.eye(size)[:, jnp.roll(jnp.arange(size), -count)]
            return scale[:, :, None] * columns, columns / scale[:, :, None]
        if not driving:
            factor = joint_factor(information, count)
            return factor, inverse_transpose(factor, count)
        others = np.delete(np.arange(information.shape[-1]), driving)
        order = np.concatenate([others[: count - len(driving)], driving, others[count - len(driving) :]])
        factor = joint_factor(information[:, order][:, :, order], count)
        back = np.argsort(order)
        return factor[:, back], inverse_transpose(factor, count)[:, back]


def _kept(
    brackets: Float[Array, "record 2 parameters"] | None,
    sweep: Int[Array, ""],
    around: Float[Array, "2 parameters"],
    *,
    unless: Bool[Array, ""],
) -> Float[Array, "record 2 parameters"] | None:
    """The record with one more sweep; what is beyond its length is dropped."""
    if brackets is None:
        return None
    return brackets.at[jnp.where(unless, brackets.shape[0], sweep)].set(around, mode="drop")


def _joined(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"]
) -> Float[Array, "windows unknowns"]:
    """The unknowns of each window: the parameters, and its initial state where that is free."""
    shared = jnp.broadcast_to(parameters, (problem.windows, parameters.shape[0]))
    return jnp.concatenate([shared, problem.split(initial_state)[:, : problem.free_size]], axis=1)


def _prior(problem: ShootingProblem, bracket: Bracket) -> Float[Array, "windows unknowns"]:
    """Standard deviation of each unknown without the flight: half of how far off it may be."""
    return _joined(problem, bracket.half_width, problem.first_state()[1]) / 2


def _until(share: Scalar, rows: Rows) -> Rows:
    """The rows with nothing measured after a share of each window."""
    samples = rows.measured[0].shape[-1]
    within = jnp.arange(samples) < jnp.ceil(share * samples)
    return rows._replace(measured=tuple(jnp.where(within, y, jnp.nan) for y in rows.measured))


def _finest(problem: ShootingProblem, rows: Rows) -> Scalar:
    """The move, in standard deviations, below which the sign of a slope is rounding."""
    eps = jnp.finfo(problem.sigma.dtype).eps
    squares = [jnp.nanmean(jnp.square(y)) for y in rows.measured]
    weighted = jnp.sqrt(jnp.nan_to_num(jnp.stack(squares))) / problem.sigma[problem.columns]
    return jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * weighted.max())


def _misfit(cost: Scalar, rows: Rows) -> Scalar:
    """Root mean square of the weighted residuals: 1 where the noise is what the problem's sigma says."""
    return jnp.sqrt(2 * cost / jnp.maximum(_measurements(rows), 1))


def _measurements(rows: Rows) -> Int[Array, ""]:
    return jnp.stack(rows.measured).size - jnp.isnan(jnp.stack(rows.measured)).sum()


def _room(
    u: Float[Array, "windows n"],
    direction: Float[Array, "windows n"],
    limits: tuple[Float[Array, " n"], Float[Array, " n"]],
) -> tuple[Float[Array, " windows"], Float[Array, " windows"]]:
    """How far one can go in each window from `u` against and along `direction` within `limits`."""
    to_lower, to_upper = ((limit - u) / jnp.where(direction == 0, 1.0, direction) for limit in limits)
    ahead = jnp.where(direction > 0, to_upper, to_lower)
    behind = jnp.where(direction > 0, to_lower, to_upper)
    above = jnp.where(direction == 0, jnp.inf, ahead).min(axis=-1)
    below = jnp.where(direction == 0, jnp.inf, -behind).min(axis=-1)
    return jnp.maximum(below, 0.0), jnp.maximum(above, 0.0)


def _bisect(
    slope: Callable[[Float[Array, " windows"]], Float[Array, " windows"]],
    lower: Float[Array, " windows"],
    upper: Float[Array, " windows"],
    halvings: int,
) -> tuple[Float[Array, " windows"], Bool[Array, " windows"], Bool[Array, " windows"]]:
    """The middle of each bracket after `halvings`, and whether its search ended at its lower or its upper end."""

    def halve(ends, _):
        low, high = ends
        middle = (low + high) / 2
        value = slope(middle)
        return (jnp.where(value <= 0, middle, low), jnp.where(value >= 0, middle, high)), None

    (low, high), _ = jax.lax.scan(halve, (lower, upper), length=halvings)
    return (low + high) / 2, low == lower, high == upper
