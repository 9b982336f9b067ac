"""The knowledge of filters at each sample, and the motion after a start in open loop: the owner for all predictions."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Numeric, Parameters, Scalar, as_float
from ..flight import RATES
from ..models.abstract import AbstractModel
from ..models.state import Forcing, Rates, State
from ..shooting import ShootingProblem
from ..shooting.gains import LogNoise, Observed, gains_of, is_rate, transition
from .frequency_response import modelled_acceleration

Motion = TypeVar("Motion")


def open_loop(
    advance: Callable[[Motion, Any, Array], Motion],
    begin: Motion,
    disturbance: Float[Array, " channels"],
    rows: Any,
    gusts: Float[Array, "steps channels 2"],
    fading: tuple[Float[Array, " channels"], Float[Array, " channels"]],
) -> Motion:
    """The motion after each step. Nothing is measured any more, and the disturbance fades.

    - `advance(motion, row, added)`: the motion after one step, to which disturbances add `added`.
    - `disturbance`: of each channel at the start, as filters know it.
    - `rows`: the forcing of each step.
    - `gusts`: what each channel and its disturbance gain in each step besides.
    - `fading`: of a step, see `transition`.
    """
    kept, reach = fading

    def step(carry: tuple[Motion, Array], row: tuple[Any, Array]) -> tuple[tuple[Motion, Array], Motion]:
        (motion, disturbance), (forcing, gust) = carry, row
        motion = advance(motion, forcing, reach * disturbance + gust[:, 0])
        return (motion, kept * disturbance + gust[:, 1]), motion

    return jax.lax.scan(step, (begin, disturbance), (rows, gusts))[1]


def gyro_bias(model: AbstractModel, rates: Float[Numeric, "3"], row: Forcing, scalars: tuple) -> Float[Array, "3"]:
    """The bias of a gyro at these rates. It is part of the measurement, not of the motion."""
    return jnp.stack(model.observe(State(Rates(*rates)), row, scalars)[:3]) - rates


class Filtered(NamedTuple):
    """The rate of each channel, and its disturbance, at each sample from all measurements until then."""

    rate: Float[Array, "samples channels"]
    disturbance: Float[Array, "samples channels"]


def filtered(
    noise: LogNoise,
    measured: Float[Array, "samples channels"],
    modelled: Float[Array, "samples channels"],
    stretch: Int[Numeric, " samples"],
    dt: Scalar,
) -> Filtered:
    """The rates and disturbances at each sample. Filters begin anew in each stretch.

    `modelled`: the model's angular acceleration, and 0 for a specific force, which is measured less its model.
    """
    begins = jnp.diff(stretch, prepend=-1) != 0
    is_known, memory = ~jnp.isnan(measured), is_rate(measured.shape[1])
    gains = gains_of(Observed(measured[:, :, None], begins[:, None], begins[:, None]), noise, dt)
    kept, reach = transition(jnp.exp(noise.time_constant), dt)

    def step(known: Filtered, row) -> tuple[Filtered, Filtered]:
        y, is_known, added, begins, by_rate, by_disturbance = row
        rate, disturbance = (jnp.where(begins, 0.0, x) for x in known)
        error = jnp.where(is_known, y - jnp.where(memory, rate, disturbance), 0.0)
        rate, disturbance = rate + by_rate * error, disturbance + by_disturbance * error
        later = Filtered(memory * rate + added * dt + reach * disturbance, kept * disturbance)
        return later, Filtered(rate, disturbance)

    zero = jnp.zeros(measured.shape[1], dtype=float)
    rows = measured, is_known, modelled, begins, gains.rate[:, :, 0], gains.disturbance[:, :, 0]
    return jax.lax.scan(step, Filtered(zero, zero), rows)[1]


class Traced(NamedTuple):
    """The disturbance of each body rate [rad/s^2] at each sample, and its innovation [rad/s]; NaN: not measured."""

    disturbance: Float[np.ndarray, "samples 3"]
    innovation: Float[np.ndarray, "samples 3"]


def traced(problem: ShootingProblem, parameters: Parameters, noise: LogNoise) -> Traced:
    """The knowledge of Kalman filters at each sample from the measurements until then.

    The model is evaluated at the measured rates. An innovation is a measured rate less its prediction from the sample
    before. `noise`: its first three channels are p, q and r.
    """
    rates, stretch = np.asarray(problem.flight.states)[:, RATES], problem.flight.stretch
    modelled = np.pad(modelled_acceleration(problem, parameters), ((0, 1), (0, 0)))
    own = LogNoise(*(as_float(np.asarray(leaf)[: len(RATES)]) for leaf in noise))
    number = np.zeros(len(rates), dtype=int) if stretch is None else np.asarray(stretch)
    dt = problem.flight.dt
    known = eqx.filter_jit(filtered)(own, as_float(rates), as_float(modelled), number, dt)
    _, reach = (np.asarray(x) for x in transition(jnp.exp(own.time_constant), dt))
    later = np.asarray(known.rate) + modelled * float(dt) + reach * np.asarray(known.disturbance)
    innovation = np.full(rates.shape, np.nan)
    innovation[1:] = np.where(np.diff(number)[:, None] == 0, rates[1:] - later[:-1], np.nan)
    return Traced(np.asarray(known.disturbance), innovation)
