"""crazyflow: simulated steps for each second. Its model is richer than ours, so the two rates are not a race.

It flies with a controller in the loop at 500 steps/s, in single precision; see its documentation.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from crazyflow.control import Control
from crazyflow.sim import Sim

from experiments.benchmarks.case import Case


def steps(case: Case) -> Callable[[], dict]:
    """As many worlds as the case has flights, for as many steps."""
    sim = Sim(n_worlds=case.flights, control=Control.attitude)
    sim.reset()
    sim.attitude_control(jnp.zeros((case.flights, 1, 4)).at[..., 3].set(0.3))

    def run() -> dict:
        sim.step(len(case.forcing))
        jax.block_until_ready(sim.data.states.pos)
        return {}

    return run
