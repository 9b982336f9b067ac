"""One stage of the search: a problem on some of its channels."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._custom_types import Parameters, Scalar
from ...bracket import Bracket
from ...flight import Inputs
from ...shooting import ROUNDING, Curvature, Length, Rows, ShootingProblem, each_window
from .directions import unknown_of_each

Limits = tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]


class Stage(NamedTuple):
    """What does not change while one stage is searched.

    The *unknowns* have one row for each window: the parameters, the same in all rows, then the window's own initial
    state if it is free. All stages have the same unknowns; a stage on few channels searches the first of the initial
    state alone.

    - `problem`: on all channels. `parts`: the problem on each choice of channels that a stage fits.
    - `part`: the position in `parts` of what this stage fits.
    - `searched`: which unknowns of a window this stage searches; the others stay where they are.
    - `order`: the numbers of all directions, those that this stage searches first.
    - `length`: how many samples are fitted, from the first on. `None`: all.
    - `rows`: the flight.
    - `starts`: initial states, used where these are known.
    - `inputs`: what the forcing is computed from.
    - `prior`: information about the unknowns without the flight: a bracket's half-width is two standard deviations.
      The windows share the information about a parameter, so that it counts once.
    - `limits`: the least and the greatest value of each unknown.
    - `measurements`: how many there are.
    - `smallest_step`: the step, in standard deviations, below which rounding decides the sign of a slope.
    """

    problem: ShootingProblem
    parts: tuple[ShootingProblem, ...]
    part: Int[Array, ""]
    searched: Bool[Array, " unknowns"]
    order: Int[Array, " unknowns"]
    length: Length
    rows: Rows
    starts: Float[Array, "windows size"]
    inputs: Inputs
    prior: Float[Array, "windows unknowns unknowns"]
    limits: Limits
    measurements: Scalar
    smallest_step: Scalar

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return len(self.problem.model.parameter_names)

    @property
    def size(self) -> Int[Array, ""]:
        """Number of unknowns of a window that this stage searches."""
        return self.searched.sum()

    def curvature(self, unknowns: Float[Array, "windows unknowns"]) -> Curvature:
        """The curvature of every window in all unknowns; 0 in those that this stage does not search."""
        parameters, size = unknowns[0, : self.parameter_count], unknowns.shape[1]
        rows = self.problem.with_forcing(self.rows, parameters, inputs=self.inputs)

        def of(part: ShootingProblem) -> Curvature:
            shot, gradient, information = self._curvature_on(part, rows, unknowns)
            more = (0, size - gradient.shape[1])
            none = (0, 0)
            return Curvature(shot, jnp.pad(gradient, (none, more)), jnp.pad(information, (none, more, more)))

        shot, gradient, information = self._on_part(of)
        both = self.searched & self.searched[:, None]
        return Curvature(shot, jnp.where(self.searched, gradient, 0.0), jnp.where(both, information, 0.0))

    def bisected(self, turn: Int[Array, ""], *, together: bool) -> Bool[Array, " n"]:
        """The directions of a turn: all that this stage searches, or one; none after the last turn."""
        places = unknown_of_each(self.searched.shape[0], self.parameter_count)
        if together:
            return self.searched[places] & (turn == 0)
        return (np.arange(places.size) == self.order[turn]) & (turn < self.size)

    def along(
        self, basis: Float[Array, "windows unknowns n"], gradient: Float[Array, "windows unknowns"]
    ) -> Float[Array, "windows n"]:
        """The slope along each direction: summed over the windows, if the direction belongs to all of them."""
        slopes, own = jnp.einsum("wud,wu->wd", basis, gradient), self.problem.free_size
        return slopes.at[:, own:].set(slopes[:, own:].sum(axis=0))

    def _on_part(self, function: Callable):
        """`function` of the part that this stage fits. The stage is the same in all lanes of a batch."""
        if len(self.parts) == 1:
            return function(self.parts[0])
        return jax.lax.switch(self.part, [functools.partial(function, part) for part in self.parts])

    def _curvature_on(self, part: ShootingProblem, rows: Rows, unknowns: Float[Array, "windows unknowns"]) -> Curvature:
        part = eqx.tree_at(lambda p: p.length, part, self.length, is_leaf=lambda leaf: leaf is None)
        count, states = self.parameter_count, self.problem.size
        fitted = rows.measured[: part.size] + rows.measured[states:]
        starts = unknowns[:, count : count + part.size] if part.free_size else self.starts[:, : part.size]
        return each_window(part.curvature, rows._replace(measured=fitted), unknowns[:, :count], starts)


def stages(
    problem: ShootingProblem,
    bracket: Bracket,
    limits: Limits,
    plan: Sequence[tuple[str, float]],
    free: Bool[Array, " parameters"],
) -> Callable[[Int[Array, ""]], Stage]:
    """The stages by number.

    `plan`: for each stage its channels, and the share of the flight that it fits. `free`: the parameters to search.
    """
    names, count = tuple(dict.fromkeys(channels for channels, _ in plan)), bracket.lower.shape[0]
    parts = tuple(problem.restrict(channels) for channels in names)
    place = np.array([names.index(channels) for channels, _ in plan])
    fitted = np.array([np.isin(problem.columns, part.columns) for part in parts])[place]
    measured, eps = problem.measured(), jnp.finfo(problem.sigma.dtype).eps
    samples = measured.shape[0] if problem.length is None else problem.length
    lengths = jnp.ceil(np.array([share for _, share in plan]) * samples).astype(int)
    # Number and mean square of the measurements in each stage and column.
    within = (jnp.arange(measured.shape[0]) < lengths[:, None]).astype(float)
    known = within @ (~jnp.isnan(measured)).astype(float)
    squares = (within @ jnp.square(jnp.nan_to_num(measured))) / jnp.maximum(known, 1)
    largest = jnp.where(fitted, jnp.sqrt(squares) / problem.sigma[problem.columns], 0.0).max(axis=1)
    own = np.arange(problem.free_size) < np.array([part.free_size for part in parts])[place, None]
    searched = jnp.concatenate([jnp.broadcast_to(free, (len(plan), count)), own], axis=1)
    prior = 1 / jnp.square(prior_std(problem, bracket))
    prior = prior.at[:, :count].divide(problem.windows)[:, :, None] * np.eye(prior.shape[1])
    everything = Stage(
        problem=problem,
        parts=parts,
        part=jnp.asarray(place),
        searched=searched,
        order=jnp.argsort(~searched[:, unknown_of_each(prior.shape[1], count)], axis=1),
        length=lengths if problem.windows == 1 else None,
        rows=problem.rows(),
        starts=problem.split(problem.first_state()[0]),
        inputs=problem.flight.inputs,
        prior=prior,
        limits=limits,
        measurements=jnp.where(fitted, known, 0.0).sum(axis=1),
        smallest_step=jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * largest),
    )
    changing = ("part", "searched", "order", "length", "measurements", "smallest_step")

    def stage(number: Int[Array, ""]) -> Stage:
        values = {name: getattr(everything, name) for name in changing}
        return everything._replace(**{name: None if x is None else x[number] for name, x in values.items()})

    return stage


def join(
    problem: ShootingProblem, parameters: Parameters, initial_state: Float[Array, " starts"]
) -> Float[Array, "windows unknowns"]:
    """The unknowns of each window: the parameters, and its initial state if that is free."""
    repeated = jnp.broadcast_to(parameters, (problem.windows, parameters.shape[0]))
    return jnp.concatenate([repeated, problem.split(initial_state)[:, : problem.free_size]], axis=1)


def prior_std(problem: ShootingProblem, bracket: Bracket) -> Float[Array, "windows unknowns"]:
    """Standard deviation of each unknown without the flight: half of how far off the unknown may be."""
    return join(problem, bracket.half_width, problem.first_state()[1]) / 2


def misfit(cost: Scalar, measurements: Scalar) -> Scalar:
    """Root mean square of the weighted residuals: 1 if the noise is as large as the problem's sigma."""
    return jnp.sqrt(2 * cost / jnp.maximum(measurements, 1))
