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
from ..shooting.gains import LogNoise, Moved, Observed, gains_of, transition
from .frequency_response import modelled_acceleration

Motion = TypeVar("Motion")


def open_loop(
    advance: Callable[[Motion, Any, Array], Motion],
    begin: Motion,
    disturbance: Float[Array, " channels"],
    rows: Any,
    gusts: Float[Array, "steps channels 2"],
    moved: Moved,
    force: Float[Array, " forces"],
) -> Motion:
    """The motion after each step. Nothing is measured any more, and the disturbance fades.

    - `advance(motion, row, added)`: the motion after one step. `added`: what disturbances add to each rate over the
      step, and the mean of each specific force that they add.
    - `disturbance`, `force`: of each channel, and the forces besides the model's, at the start as filters know them.
    - `rows`: the forcing of each step.
    - `gusts`: what each channel and its disturbance gain in each step besides.
    - `moved`: of a step, see `transition`.
    """
    rates = disturbance.size - force.size

    def step(carry: tuple[Motion, Array, Array], row: tuple[Any, Array]) -> tuple[tuple[Motion, Array, Array], Motion]:
        (motion, force, disturbance), (forcing, gust) = carry, row
        gained = moved.reach * disturbance + gust[:, 0]
        after = moved.driven_kept[rates:] * force + gained[rates:]
        motion = advance(motion, forcing, jnp.concatenate([gained[:rates], (force + after) / 2]))
        return (motion, after, moved.kept * disturbance + gust[:, 1]), motion

    return jax.lax.scan(step, (begin, force, disturbance), (rows, gusts))[1]


def gyro_bias(model: AbstractModel, rates: Float[Numeric, "3"], row: Forcing, scalars: tuple) -> Float[Array, "3"]:
    """The bias of a gyro at these rates. It is part of the measurement, not of the motion."""
    return jnp.stack(model.observe(State(Rates(*rates)), row, scalars)[:3]) - rates


class Filtered(NamedTuple):
    """Each channel's rate, or force besides the model's, and its disturbance, from all measurements until a sample."""

    driven: Float[Array, "samples channels"]
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
    is_known, moved = ~jnp.isnan(measured), transition(noise, dt)
    gains = gains_of(Observed(measured[:, :, None], begins[:, None], begins[:, None]), noise, dt)

    def step(known: Filtered, row) -> tuple[Filtered, Filtered]:
        y, is_known, added, begins, *gains = row
        known = Filtered(*(jnp.where(begins, 0.0, x) for x in known))
        error = jnp.where(is_known, y - known.driven, 0.0)
        driven, disturbance = (x + gain * error for x, gain in zip(known, gains, strict=True))
        later = moved.driven_kept * driven + added * dt + moved.reach * disturbance
        return Filtered(later, moved.kept * disturbance), Filtered(driven, disturbance)

    zero = jnp.zeros(measured.shape[1], dtype=float)
    rows = measured, is_known, modelled, begins, gains.driven[:, :, 0], gains.disturbance[:, :, 0]
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
    own = jax.tree.map(lambda leaf: as_float(np.asarray(leaf)[: len(RATES)]), noise)
    number = np.zeros(len(rates), dtype=int) if stretch is None else np.asarray(stretch)
    dt = problem.flight.dt
    known = eqx.filter_jit(filtered)(own, as_float(rates), as_float(modelled), number, dt)
    reach = np.asarray(transition(own, dt).reach)
    later = np.asarray(known.driven) + modelled * float(dt) + reach * np.asarray(known.disturbance)
    innovation = np.full(rates.shape, np.nan)
    innovation[1:] = np.where(np.diff(number)[:, None] == 0, rates[1:] - later[:-1], np.nan)
    return Traced(np.asarray(known.disturbance), innovation)
