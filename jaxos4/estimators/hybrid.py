"""The hybrid estimator: a network gives the start of the search, and IBSS finds the answer near it."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Numeric, Scalar
from ..batching import in_blocks
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..networks import TrainedNetwork
from ..results import RESULTS
from ..shooting import AbstractProblem, InnovationsProblem, ShootingProblem
from .ibss import IBSS
from .solver import solve

_LEVEL = 0.999  # the share of flights in which the seed's intervals contain all parameters at once
# The seed was wrong if the answer is more than this many half-widths of its intervals away.
_MISSED = 2.0
# Residuals are not explained if the cost is this many standard deviations above that of pure noise.
_UNEXPLAINED = 5.0


class Hybrid(AbstractEstimator):
    """IBSS near the answer of a network.

    The network's answer, the *seed*, and its covariance open the first search intervals. The search then compares all
    of the problem's channels; states that the network does not see start at their first measurements. If the search
    shows that the seed was wrong, or if the network had no answer, IBSS searches the whole bracket too. The better
    answer is returned.

    The estimate's `seed` is the bracket of the network's 99.9 % intervals for all parameters at once. `rollouts` are
    those of network and search together.

    - `network`: a trained network. A network that sees all of the problem's channels makes the search shortest.
    - `ibss`: the settings of the search.
    - `seen`: the part of the flight that the network sees, by default the shooting problem. It may differ from the
      training problem only in the measured values.
    """

    shoots: ClassVar[bool] = True
    needs_network: ClassVar[bool] = True
    in_closed_loop: ClassVar[bool] = True

    network: TrainedNetwork
    ibss: IBSS = eqx.field(default_factory=IBSS)
    seen: ShootingProblem | None = None

    def __call__(self, problem: AbstractProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises as the network does."""
        problem = problem.within(bracket)
        whole: Any = problem.problem if isinstance(problem, InnovationsProblem) else problem
        return search_from_seed(self.ibss, problem, self.network(whole if self.seen is None else self.seen))


class Seed(NamedTuple):
    """The start of a search: the answer of another estimator.

    - `parameters`, `covariance`: the covariance is infinite if there is no answer.
    - `half_width`: of the 99.9 % intervals for all parameters at once.
    - `initial_state`: at the first sample of each window, in the channels that the other estimator sees.
    - `rollouts`: of the other estimator.
    """

    parameters: Float[Numeric, " parameters"]
    covariance: Float[Numeric, "parameters parameters"]
    half_width: Float[Numeric, " parameters"]
    initial_state: Float[Numeric, " starts"]
    rollouts: Int[Numeric, ""]

    @classmethod
    def of(cls, answer: Estimate) -> "Seed":
        """The seed of an answer."""
        half_width = answer.half_width(_LEVEL, simultaneous=True)
        return cls(answer.parameters, answer.covariance, half_width, answer.initial_state, answer.rollouts)

    @classmethod
    def none(cls, parameters: int, starts: int) -> "Seed":
        """A seed without an answer. `parameters`, `starts`: the lengths of `parameters` and `initial_state`."""
        kind = jnp.result_type(float)
        nowhere, unknown = np.zeros(parameters, kind), np.full((parameters, parameters), np.inf, kind)
        return cls(nowhere, unknown, nowhere, np.zeros(starts, kind), np.zeros((), jnp.result_type(int)))


@eqx.filter_jit
def search_from_seed(ibss: IBSS, problem: AbstractProblem, answer: Estimate) -> Estimate:
    """`search_near` the seed of an `answer`, as one program."""
    return search_near(ibss, problem, Seed.of(answer))


def search_near(ibss: IBSS, problem: AbstractProblem, seed: Seed) -> Estimate:
    """Searches near the `seed`, and in the whole bracket if the seed was wrong or has no answer."""
    return in_blocks(_search_near, ibss, problem, seed)


def _search_near(ibss: IBSS, problem: AbstractProblem, seed: Seed) -> Estimate:
    answered, unknowns, count = jnp.isfinite(seed.covariance).all(), problem.unknowns, seed.parameters.shape[0]
    guess, stages = problem.initial_guess, problem.stages(ibss.shares)
    # The half-width is two standard deviations.
    wide_spread = jnp.diag(jnp.square(guess.off[0, :count] / 2))
    (windows, size), own = guess.off.shape, unknowns.count
    # The network's channels come first. A problem whose initial state is not unknown needs none of them.
    estimated = seed.initial_state.reshape(windows, -1)[:, : size - own]
    begin = jnp.full((windows, size), jnp.nan).at[:, :count].set(seed.parameters)
    begin = begin.at[:, own : own + estimated.shape[1]].set(estimated)

    def search(hit: Bool[Array, ""], near: Bool[Array, ""]) -> tuple[Bool[Array, ""], Estimate]:
        found = solve(
            ibss,
            problem,
            start=jnp.where(near, begin, jnp.nan),
            spread=jnp.where(near, seed.covariance, wide_spread),
            is_close=near,
            skip=jnp.where(near, ~answered, hit),
        )
        measurements = stages.at(stages.number - 1, guess.starts[0]).measurements
        return hit | (near & answered & _confirms(found, seed, measurements)), found

    # A loop over the two searches, so that the search is compiled once. A batch of hits skips the second.
    hit, both = jax.lax.scan(search, jnp.zeros((), dtype=bool), jnp.asarray([True, False]))
    near, wide = (jax.tree.map(lambda leaf, place=place: leaf[place], both) for place in (0, 1))
    near_is_right = answered & (near.result == RESULTS.successful)
    better = ~hit & (~near_is_right | ((wide.result == RESULTS.successful) & (wide.cost < near.cost)))
    best = jax.tree.map(lambda w, n: jnp.where(better, w, n), wide, near)
    return dataclasses.replace(
        best,
        rollouts=seed.rollouts + near.rollouts + wide.rollouts,
        sweeps=near.sweeps + wide.sweeps,
        seed=Bracket.around(seed.parameters, seed.half_width),
    )


def _confirms(near: Estimate, seed: Seed, measurements: Scalar) -> Bool[Array, ""]:
    """Whether the search near a seed ended well, close to the seed, and with residuals no larger than noise."""
    far = jnp.abs(near.parameters[: seed.parameters.shape[0]] - seed.parameters) > _MISSED * seed.half_width
    # A parameter that is not identifiable near the seed is not identifiable elsewhere either.
    ended = (near.result == RESULTS.successful) | (near.result == RESULTS.unidentifiable)
    # If the noise is an unknown, `measurements` is 0, and the cost does not show whether the residuals are noise.
    explained = 2 * near.cost < measurements + _UNEXPLAINED * jnp.sqrt(2 * measurements)
    explained = explained & (measurements > 0)
    return ended & ~far.any() & explained
