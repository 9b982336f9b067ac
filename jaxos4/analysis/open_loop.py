"""The knowledge of filters at each sample, and the motion after a start in open loop: the owner for all predictions."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Numeric, Parameters, Scalar, as_float
from ..flight import RATES
from ..models.abstract import AbstractModel
from ..models.state import Forcing, Rates, State
from ..shooting import ShootingProblem
from ..shooting.gains import LogNoise, Transition, first_covariance, is_rate, next_gains, step_of
from .frequency_response import modelled_acceleration

Motion = TypeVar("Motion")


class Filtered(NamedTuple):
    """Each channel's rate, or force besides the model's, and its disturbance, as a filter knows them."""

    driven: Float[Numeric, "*samples channels"]
    disturbance: Float[Numeric, "*samples channels"]

    def later(self, over: Transition, driven: Numeric, disturbance: Numeric | float = 0.0) -> "Filtered":
        """One sample later, if nothing is measured. `driven`, `disturbance`: what each gains besides."""
        driven = over.driven_kept * self.driven + over.reach * self.disturbance + driven
        return Filtered(driven, over.kept * self.disturbance + disturbance)


@jax.jit
def filtered(
    noise: LogNoise,
    measured: Float[Numeric, "samples channels"],
    modelled: Float[Numeric, "samples channels"],
    stretch: Int[Numeric, " samples"],
    dt: Scalar,
) -> tuple[Filtered, Float[Array, "samples channels"]]:
    """The knowledge from all measurements until each sample, and the innovations. Filters begin anew in each stretch.

    The likelihood's filters (`jaxos4.shooting.filters`), with the model's accelerations as data instead of derivatives.

    - `modelled`: the angular acceleration, and 0 for a specific force, which is measured less its model.

    An innovation is NaN if it was not measured, or if a stretch begins.
    """
    begins, step = jnp.diff(stretch, prepend=-1) != 0, step_of(noise, dt)

    def follow(carry, row):
        (p, known), (y, added, begins) = carry, row
        p, gains = next_gains(p, step, ~jnp.isnan(y), begins)
        known = jax.tree.map(lambda x: jnp.where(begins, 0.0, x), known)
        innovation = y - known.driven
        error = jnp.where(jnp.isnan(y), 0.0, innovation)
        known = Filtered(known.driven + gains.driven * error, known.disturbance + gains.disturbance * error)
        return (p, known.later(step.transition, added * dt)), (known, jnp.where(begins, jnp.nan, innovation))

    zero = jnp.zeros((measured.shape[1], 1), dtype=float)  # one segment
    rows = measured[:, :, None], modelled[:, :, None], begins[:, None]
    found = jax.lax.scan(follow, (first_covariance(step, 1), Filtered(zero, zero)), rows)[1]
    return jax.tree.map(lambda leaf: leaf[:, :, 0], found)


def open_loop(
    advance: Callable[[Motion, Any, Array], Motion],
    begin: Motion,
    known: Filtered,
    rows: Any,
    gusts: Filtered,
    over: Transition,
) -> Motion:
    """The motion after each step. Nothing is measured any more, and the disturbance fades.

    - `advance(motion, row, added)`: the motion after one step. `added`: what disturbances add to each rate over the
      step, and the mean of each specific force that they add.
    - `known`: at the start. Its rates do not count, as they are part of the motion.
    - `rows`: the forcing of each step. `gusts`: what each channel gains in it besides.
    - `over`: the transition of the disturbance over a step.
    """
    rate = is_rate(over.reach)

    def step(carry: tuple[Motion, Filtered], row: tuple[Any, Filtered]) -> tuple[tuple[Motion, Filtered], Motion]:
        (motion, known), (forcing, gust) = carry, row
        known = known._replace(driven=jnp.where(rate, 0.0, known.driven))
        later = known.later(over, *gust)
        motion = advance(motion, forcing, jnp.where(rate, later.driven, (known.driven + later.driven) / 2))
        return (motion, later), motion

    return jax.lax.scan(step, (begin, known), (rows, gusts))[1]


def gyro_bias(model: AbstractModel, rates: Float[Numeric, "3"], row: Forcing, scalars: tuple) -> Float[Array, "3"]:
    """The bias of a gyro at these rates. It is part of the measurement, not of the motion."""
    return jnp.stack(model.observe(State(Rates(*rates)), row, scalars)[:3]) - rates


class Traced(NamedTuple):
    """The disturbance of each body rate [rad/s^2] at each sample, and its innovation [rad/s]; NaN: not measured."""

    disturbance: Float[np.ndarray, "samples 3"]
    innovation: Float[np.ndarray, "samples 3"]


def traced(problem: ShootingProblem, parameters: Parameters, noise: LogNoise) -> Traced:
    """The knowledge of Kalman filters at each sample from the measurements until then.

    The model is evaluated at the measured rates. An innovation is a measured rate less its prediction from the sample
    before. `noise`: its first three channels are p, q and r.
    """
    flight, rates = problem.flight, np.asarray(problem.flight.states)[:, RATES]
    modelled = np.pad(modelled_acceleration(problem, parameters), ((0, 1), (0, 0)))
    own = jax.tree.map(lambda leaf: as_float(np.asarray(leaf)[: len(RATES)]), noise)
    known, innovation = filtered(own, rates, modelled, flight.stretch_numbers, flight.dt)
    return Traced(np.asarray(known.disturbance), np.asarray(innovation))
