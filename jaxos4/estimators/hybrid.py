"""The hybrid: a network says where to look, and shooting finds the answer there."""

from typing import ClassVar

import equinox as eqx

from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate
from ..networks import TrainedNetwork
from ..shooting import ShootingProblem
from .ibss import IBSS


class Hybrid(AbstractEstimator):
    """IBSS from brackets that a network seeds.

    The network's answer and its covariance open the brackets, against all of the problem's channels at once. A seed
    that does not hold the answer is noticed: brackets grow, and where the answer lies far from the seed, or does not
    explain the flight, or the network had none, IBSS searches the whole bracket as it would alone. The estimate's
    `seed` is the bracket that the network's intervals make (99.9 % for all parameters at once), so that hits can be
    counted; `rollouts` are those of both.

    **Arguments:**

    - `network`: a trained network. One that looks at all the channels of the problem makes the shortest search.
    - `ibss`: how to shoot. A seed is close enough for one halving less than a wide bracket takes.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = True

    network: TrainedNetwork
    ibss: IBSS = eqx.field(default_factory=lambda: IBSS(halvings=3))

    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. Raises as the network does."""
        return self.ibss(problem, bracket, seed=self.network(problem, bracket))
