"""The disturbance of each body rate, estimated from what was measured until then."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Parameters, Scalar, as_float
from .._xla import quick_jit
from ..models.state import CASCADE_ORDER
from ..shooting import ShootingProblem
from ..shooting.filters import LogNoise, Observed, gains_of, transition
from .frequency_response import modelled_acceleration


class Disturbances(NamedTuple):
    """Angular accelerations that act on the body rates besides the model.

    - `value`: at each sample, from the measurements until then [rad/s^2].
    - `time_constant`: with which they fade [s].
    """

    value: Float[np.ndarray, "samples 3"]
    time_constant: Float[np.ndarray, "3"]


def disturbances(problem: ShootingProblem, parameters: Parameters, noise: LogNoise) -> Disturbances:
    """The disturbance of each body rate by Kalman filters, for the noise that `FilterError` found.

    The model is evaluated at the measured rates. `noise`: its first three channels are p, q and r.
    """
    rates = np.asarray(problem.flight.states)[:, CASCADE_ORDER[:3]]
    modelled = np.zeros(rates.shape)
    modelled[:-1] = modelled_acceleration(problem, parameters)
    own = LogNoise(*(as_float(np.asarray(leaf)[:3]) for leaf in noise))
    begins = np.arange(rates.shape[0]) == 0
    if problem.flight.stretch is not None:
        begins = np.diff(np.asarray(problem.flight.stretch), prepend=-1) != 0
    value = _filtered(own, as_float(rates), as_float(modelled), jnp.asarray(begins), problem.flight.dt)
    return Disturbances(np.asarray(value), np.exp(np.asarray(own.time_constant)))


@quick_jit
def _filtered(
    noise: LogNoise,
    rates: Float[Array, "samples 3"],
    modelled: Float[Array, "samples 3"],
    begins: Bool[Array, " samples"],
    dt: Scalar,
) -> Float[Array, "samples 3"]:
    measured = ~jnp.isnan(rates)
    observed = Observed(rates[:, :, None], begins[:, None], begins[:, None])
    gains = gains_of(observed, noise, dt)
    kept, reach = transition(jnp.exp(noise.time_constant), dt)

    def step(known: tuple[Array, Array], row) -> tuple[tuple[Array, Array], Array]:
        (rate, disturbance), (y, measured, added, begins, by_rate, by_disturbance) = known, row
        rate, disturbance = (jnp.where(begins, 0.0, x) for x in (rate, disturbance))
        error = jnp.where(measured, y - rate, 0.0)
        disturbance = disturbance + by_disturbance * error
        moved = rate + by_rate * error + added * dt + reach * disturbance
        return (moved, kept * disturbance), disturbance

    zero = jnp.zeros(3, dtype=float)
    rows = rates, measured, modelled, begins, gains.rate[:, :, 0], gains.disturbance[:, :, 0]
    return jax.lax.scan(step, (zero, zero), rows)[1]
