"""Extended Kalman filter of the states and the parameters together, in square-root form.

Parameters and initial state are constants and the model is exact, so the covariance P = S S^T gains nothing between
measurements: each column of S is a tangent that travels with the state. A measurement only rotates and shrinks the
columns (Potter's update, one scalar at a time). No matrix is inverted, and P stays positive in single precision.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Parameters, Scalar, integer
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, as_estimate, recursively
from ..linalg import gram
from ..models.state import CASCADE_ORDER, stack, unstack
from ..shooting import Rows, ShootingProblem, Unknowns

_SETTLED = 0.1  # standard deviations; the passes end once a pass moves no parameter by more
# The joint estimate of states, parameters and, if it is free, the initial state; and the root S of its covariance.
_Joint = tuple[Float[Array, " joint"], Float[Array, "joint unknowns"]]


class JointEKF(AbstractEstimator):
    """Joint extended Kalman filter: states and constant parameters from one recursion over the flight.

    - `passes`: the most passes over the flight. The first pass linearises the model around its running estimate, as the
      textbook filter does. Each later pass is a Gauss-Newton step: it starts from the same prior and linearises around
      the trajectory of the answer before. The passes end once a pass changes no parameter by more than a tenth of its
      standard deviation; otherwise the result is `max_sweeps`. With 1 the first answer is accepted, but its covariance
      can be far too small.

    The bracket is a Gaussian prior: its center is the mean, its half-width the standard deviation. A free initial state
    has the first measurements as its prior, and is a constant part of the joint state. There is no process noise.
    `history` is from the last pass. `rollouts` count each unknown and the state in each pass; `sweeps` count the
    passes.

    Reference: Ljung 1979, IEEE Trans. Autom. Control 24(1), on the filter; Bierman 1977, Factorization Methods for
    Discrete Sequential Estimation, on Potter's update; Bell and Cathey 1993, IEEE Trans. Autom. Control 38(2), on
    iterated updates.
    """

    largest_std: ClassVar[float] = GAUSSIAN_PRIOR

    passes: Count = eqx.field(converter=integer("passes", 1), default=10)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises `ValueError` as `recursively` does."""
        return recursively(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        rows, prior = jax.tree.map(lambda leaf: leaf[0], problem.rows()), problem.unknowns.usable
        count, size = prior.center.shape[0], problem.size
        start = problem.first_state()[0]

        def split(joint: Float[Array, " joint"]) -> tuple[Parameters, Float[Array, " size"]]:
            return joint[size : size + count], joint[size + count :] if problem.free_size else start

        def again(carry):
            """One more pass: its result, the number of passes so far, and whether they are over."""
            (joint, *_), passes, _ = carry
            before, first = split(joint), passes == 0
            joint, root, history = _pass(problem, rows, prior, before, first=first)
            std = jnp.sqrt(jnp.square(root[size : size + count]).sum(axis=1))
            moved = (jnp.abs(split(joint)[0] - before[0]) / jnp.where(prior.free, std, 1.0)).max()
            # A NaN ends the passes: it stays NaN.
            done = jnp.where(first, self.passes == 1, ~(moved > _SETTLED))
            return (joint, root, history), passes + 1, done

        joint, unknowns = jnp.concatenate([start, prior.center, start[: problem.free_size]]), count + problem.free_size
        root, history = jnp.zeros((joint.size, unknowns)), jnp.zeros((rows.measured[0].size, count))
        none = (joint, root, history), jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        # The first pass is in the loop too, so that the filter is compiled once.
        found = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[1] < self.passes), again, none)
        (joint, root, history), passes, done = found
        parameters, initial_state = split(joint)
        cost, feasible = problem.shots(parameters, initial_state)
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=gram(root[size : size + count]),
            initial_state=initial_state,
            cost=cost,
            rollouts=passes * (unknowns + 1) + 1,
            sweeps=passes,
            feasible=feasible,
            largest_std=self.largest_std,
            done=done,
            history=history,
        )


def _pass(
    problem: ShootingProblem,
    rows: Rows,
    prior: Unknowns,
    about: tuple[Parameters, Float[Array, " size"]],
    *,
    first: Bool[Array, ""],
) -> tuple[Float[Array, " joint"], Float[Array, "joint unknowns"], Float[Array, "samples parameters"]]:
    """One pass: the joint estimate, the root of its covariance, and the parameters after each sample.

    The model is linearised around the running estimate in the `first` pass, and later around the trajectory of `about`.
    """
    count, size = prior.center.shape[0], problem.size
    start, off = problem.first_state()
    spread = jnp.concatenate([prior.free_half_width, off[: problem.free_size]])
    constants = jnp.diag(spread)
    # A known initial state has no tangent of its own.
    moving = jnp.zeros((size, spread.shape[0]), dtype=constants.dtype).at[: problem.free_size].set(constants[count:])
    begin = jnp.concatenate([start, prior.center, start[: problem.free_size]]), jnp.concatenate([moving, constants])
    places, variances = jnp.arange(size), jnp.square(problem.sigma[CASCADE_ORDER[:size]])

    def step(carry: tuple[_Joint, Array], row: Rows) -> tuple[tuple[_Joint, Array], Parameters]:
        before, nominal = carry  # the state on the trajectory around which the model is linearised
        measurements = places, jnp.stack(row.measured), variances
        (estimate, root), _ = jax.lax.scan(_update, before, measurements)
        states, parameters, constant = estimate[:size], estimate[size : size + count], estimate[size:]
        point = jnp.where(first, states, nominal), jnp.where(first, parameters, about[0])

        def advance(x: Float[Array, " size"], a: Parameters) -> Float[Array, " size"]:
            return stack(problem.advance(row.forcing, unstack(x), tuple(a))[0])

        following, linear = jax.linearize(advance, *point)
        predicted = following + linear(states - point[0], parameters - point[1])
        tangents = jax.vmap(linear, in_axes=1, out_axes=1)(root[:size], root[size : size + count])
        root = jnp.concatenate([tangents, root[size:]])
        return ((jnp.concatenate([predicted, constant]), root), following), parameters

    ((estimate, root), _), history = jax.lax.scan(step, (begin, about[1]), rows)
    return estimate, root, history


def _update(filter_: _Joint, measurement: tuple[Int[Array, ""], Scalar, Scalar]) -> tuple[_Joint, None]:
    """Potter's update of estimate and root with one measurement of one state; a NaN changes nothing."""
    (estimate, root), (channel, measured, variance) = filter_, measurement
    along = root[channel]
    total = (along * along).sum() + variance
    gain = jnp.where(jnp.isnan(measured), 0.0, (root * along).sum(axis=1) / total)
    error = jnp.where(jnp.isnan(measured), 0.0, measured - estimate[channel])
    shrink = 1 / (1 + jnp.sqrt(variance / total))
    return (estimate + gain * error, root - shrink * gain[:, None] * along[None, :]), None
