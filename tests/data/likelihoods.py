"""Likelihoods of two unknowns, in which nothing flies: what tests of solvers share."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxos4.bracket import NO_PRIOR
from jaxos4.shooting import AbstractProblem, LocalModel, Unknowns
from jaxos4.shooting.abstract import InitialGuess, Stage, Stages

NAMES = ("x", "y")
MINIMUM, SLOPES = np.array([0.4, -0.3]), np.array([[30.0, 10.0], [0.0, 20.0], [5.0, 0.0]])


def quadratic(x):
    """Residuals that are linear in both unknowns."""
    return SLOPES @ (x - MINIMUM)


def valley(x):
    """Those of Rosenbrock: the minimum (1, 1) lies in a valley that is bent."""
    return 10 * jnp.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def narrow(x):
    """A valley along which both unknowns move together. The minimum is (0.4, -0.3)."""
    return jnp.stack([30 * (x[0] + x[1] - 0.1), 5 * (x[0] - x[1] - 0.7)])


def misfit(x):
    """Residuals that remain, so that Gauss-Newton steps in x are four times too long. y is known less well."""
    return jnp.stack([5 * (x[0] - 0.4), 10 + 4 * (x[0] - 0.3) ** 2, 0.3 * (x[1] + 0.3), 0.2 * x[0] * x[1]])


def shallow(x):
    """Residuals that remain, so that Gauss-Newton steps in x are five times too short."""
    return jnp.stack([5 * (x[0] - 0.4), 10 - 1.03 * (x[0] - 0.35) ** 2, 3 * (x[1] + 0.3), 0.2 * x[0] * x[1]])


def wall(x):
    """A slope that ends at a wall, so that the first steps are much too long, and secants much steeper than before."""
    return jnp.stack([0.1 * x[0] - 1, 3 * jnp.maximum(x[0] - 1, 0.0), x[1]])


def late(x):
    """One unknown that would go far beyond its limit, and one that hardly matters: y = -0.5 at the minimum."""
    return jnp.stack([1e4 * (x[0] - 400), 0.1 * (x[1] + 0.5)])


def two_minima(x):
    """Near y = -1 and y = 1; the second is the lower one."""
    return jnp.stack([5 * x[0], 5 * (x[1] ** 2 - 1), x[1] - 1])


class Squares(AbstractProblem):
    """Half the sum of the squares of some residuals.

    - `starts`: where searches start; by default at the center of the bracket.
    - `change`: what a test changes in the gradient, from the unknowns and the gradient.
    - `hear`: is called with the unknowns of each shot.
    """

    unknowns: Unknowns
    residuals: Callable = eqx.field(static=True)
    starts: jax.Array | None = None
    change: Callable = eqx.field(static=True, default=lambda x, gradient: gradient)
    hear: Callable | None = eqx.field(static=True, default=None)

    @property
    def initial_guess(self):
        starts = self.unknowns.usable.center[None] if self.starts is None else self.starts
        return InitialGuess(starts[:, None], self.unknowns.usable.half_width[None], jnp.zeros((1, 0)))

    @property
    def local_model(self):
        return self._at

    def _at(self, unknowns):
        x, free = unknowns[0], self.unknowns.free
        if self.hear is not None:
            jax.debug.callback(self.hear, x)
        errors, slopes = self.residuals(x), jax.jacfwd(self.residuals)(x)
        gradient = jnp.where(free, self.change(x, slopes.T @ errors), 0.0)
        information = jnp.where(free & free[:, None], slopes.T @ slopes, 0.0)
        cost = jnp.square(errors).sum() / 2
        return LocalModel(cost[None], jnp.isfinite(cost)[None], gradient[None], information[None])

    def fix(self, values, bracket=None):
        unknowns = self.unknowns if bracket is None else self.unknowns.within(bracket)
        unknowns = unknowns.fix(values) if values else unknowns
        return eqx.tree_at(lambda problem: problem.unknowns, self, unknowns)

    def stages(self, shares=()):
        stage = Stage(
            unknowns=self.unknowns,
            off=self.initial_guess.off,
            local_model=self._at,
            searched=self.unknowns.free,
            measurements=jnp.zeros(()),
            smallest_step=jnp.asarray(1e-8),
            last=jnp.asarray(True),
        )
        return Stages(number=1, first=0, whole=0, at=lambda number, before: stage)


def squares(residuals, center=(0.0, 0.0), half_width=1.0, **more):
    """The likelihood of these residuals, with its bracket."""
    infinite = np.full(2, np.inf)
    unknowns = Unknowns(
        names=NAMES,
        units=("1", "1"),
        parameter_count=more.pop("parameter_count", 2),
        largest_std=NO_PRIOR,
        center=np.array(center),
        half_width=np.full(2, half_width),
        free=np.ones(2, dtype=bool),
        precision=np.zeros(2),
        lowest=more.pop("lowest", -infinite),
        highest=infinite,
        stride=more.pop("stride", infinite),
    )
    return Squares(unknowns, residuals, **more)
