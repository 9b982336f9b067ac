"""The free motion of a vehicle from many starts: attitude as a quaternion, so that no attitude is singular."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Numeric, Scalar
from ..analysis.prediction import Filtered, filtered, gyro_bias, open_loop
from ..flight import RATES, STATE_NAMES, Flight
from ..models.flight_model import FlightModel
from ..models.state import Forcing, Rates, State
from ..rotations import Quaternion, Vector, conjugate, deviation, quaternion_product, rotated
from ..shooting import FASTEST
from ..shooting.gains import Covariance, LogNoise, Transition, first_covariance, is_rate, next_gains, step_of
from ..simulation import runge_kutta

PARTS = {"position": np.r_[0:3], "velocity": np.r_[3:6], "attitude": np.r_[6:10], "rates": np.r_[10:13]}
"""The places of the parts of a state in an array of 13. The attitude is the quaternion w, x, y, z, body to earth."""


MEMORY = 5.0  # s; offsets of a recording are forgotten with this time constant: batteries and propellers change slowly
PUSH = 1.0  # m/s^2; standard deviation of an offset of the specific force, and of the force that a model lacks
PUSH_TIME = 0.25  # s; the correlation time of that force


class Motion(NamedTuple):
    """Position [m], velocity [m/s] in the earth frame, attitude from body to earth, body rates [rad/s]."""

    position: Vector
    velocity: Vector
    attitude: Quaternion
    rates: Rates


Known = tuple[Float[Numeric, "... 13"], Filtered, Float[Numeric, "... 6"]]
"""At each sample, or at one: the measured state; rates [rad/s] and unexplained specific forces [m/s^2], with their
disturbances [rad/s^2; m/s^2], as filters know them; and the standard deviation of each offset, see `Futures`."""


class Futures(NamedTuple):
    """Several futures of each start.

    - `parameters`: of the model. `forcing`: with these parameters, one row for each sample.
    - `offset`: p', q', r' [rad/s^2] and specific force [m/s^2] that the model lacks in this recording, estimated from
      all samples before.
    - `filtered`: whether the future begins with the rates and the disturbance of the filters, or with measured rates
      and no disturbance.
    - `errors`: errors of the filters at the start.
    - `off`: errors of the offsets in standard deviations, and the changes of the disturbances that these errors cause.
    - `gusts`: random increments of each channel in each step.
    """

    parameters: Float[Array, "futures parameters"]
    forcing: Forcing
    offset: Float[Array, "futures samples 6"]
    filtered: Bool[Array, " futures"]
    errors: Filtered
    off: Float[Array, "futures 2 6"]
    gusts: Filtered


def _sum(a, b) -> tuple[Scalar, Scalar, Scalar]:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _fly_future(
    model: FlightModel, future: Futures, first: Int[Array, ""], start: Known, noise: LogNoise, dt: Scalar
) -> Float[Array, "steps 13"]:
    """The states of one future after each step from its start. A motion that diverges keeps its last state."""
    scalars, axes, (state, filters, offset_std) = tuple(future.parameters), model.force_axes, start
    p, v, q, w = (state[places] for places in PARTS.values())
    steps = future.gusts.driven.shape[0]
    rows = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, steps), future.forcing)
    still = jax.tree.map(lambda leaf: leaf[0], rows)._replace(velocity=(0.0, 0.0, 0.0))
    error, absorbed = offset_std * future.off
    measured = Filtered(jnp.zeros(noise.strength.size).at[:3].set(w), jnp.zeros(noise.strength.size))
    known = jax.tree.map(lambda x, y, e: jnp.where(future.filtered, x, y) + e, filters, measured, future.errors)
    known = known._replace(disturbance=known.disturbance.at[:3].add(absorbed[:3]))
    w = known.driven[:3] - gyro_bias(model, w, still, scalars)
    offset = future.offset[first] + error
    begin = Motion(tuple(p), tuple(v), _unit(tuple(q)), Rates(*w))

    def advance(carry: tuple[Motion, Array], forcing: Forcing, added: Array) -> tuple[Motion, Array]:
        motion, feasible = carry
        turning = offset[:3] + added[:3] / dt
        pushing = offset[3:].at[np.asarray(axes, dtype=int)].add(added[3:])

        @jax.jit  # traced once for the four stages of a step
        def derivative(motion: Motion) -> Motion:
            row = forcing._replace(velocity=rotated(conjugate(motion.attitude), motion.velocity))
            accelerations = _sum(model.angular_acceleration(motion.rates, row, scalars), turning)
            force = _sum(model.specific_force(row.mean_specific_thrust, row, scalars), pushing)
            x, y, z = rotated(motion.attitude, force)
            spin = quaternion_product(motion.attitude, (jnp.zeros_like(x), *(rate / 2 for rate in motion.rates)))
            return Motion(motion.velocity, (x, y, z - model.airframe.gravity), spin, Rates(*accelerations))

        moved = runge_kutta(derivative, motion, dt)
        moved = moved._replace(attitude=_unit(moved.attitude))
        finite = jnp.isfinite(jnp.stack(jax.tree.leaves(moved))).all()
        feasible = feasible & finite & (jnp.abs(jnp.stack(moved.rates)) < FASTEST).all()
        return jax.tree.map(lambda new, old: jnp.where(feasible, new, old), moved, motion), feasible

    motion, _ = open_loop(advance, (begin, jnp.array(True)), known, rows, future.gusts, Transition.of(noise, dt))
    return jnp.stack(jax.tree.leaves(motion), axis=1)


def _unit(a: Quaternion) -> Quaternion:
    w, x, y, z = a
    share = 1 / jnp.sqrt(w * w + x * x + y * y + z * z)
    return share * w, share * x, share * y, share * z


def departures(states: Any, others: Any) -> Any:
    """`others` minus `states`, (..., 13) to (..., 12): attitudes differ by `deviation`. NumPy and JAX."""
    difference, xp = others - states, np if isinstance(states, np.ndarray) else jnp
    turn = deviation(xp.moveaxis(states[..., 6:10], -1, 0), xp.moveaxis(others[..., 6:10], -1, 0))
    return xp.concatenate([difference[..., :6], xp.stack(turn, axis=-1), difference[..., 10:]], axis=-1)


@eqx.filter_jit
def fly_chunk(
    model: FlightModel, futures: Futures, known: Known, first: Int[Array, " starts"], noise: LogNoise, dt: Scalar
) -> tuple[Float[Array, "starts 2 steps 13"], Float[Array, "starts steps 12"]]:
    """The first two futures from each sample `first`, and the root mean square `departures` of the others from them."""

    def every(first: Int[Array, ""]) -> tuple[Array, Array]:
        start = jax.tree.map(lambda leaf: leaf[first], known)
        states = jax.vmap(lambda future: _fly_future(model, future, first, start, noise, dt))(futures)
        off = departures(jnp.broadcast_to(states[0], states[2:].shape), states[2:])
        return states[:2], jnp.sqrt(jnp.square(off).mean(axis=0))

    return jax.vmap(every)(first)


@eqx.filter_jit
def known_at_samples(
    model: FlightModel,
    flight: Flight,
    length: Count,
    parameters: Float[Array, "futures parameters"],
    measured: tuple[Float[Array, "samples 13"], Float[Array, "samples 6"], Float[Array, "3"]],
    noise: LogNoise,
    prior: Float[Array, "6"],
) -> tuple[Known, Forcing, Float[Array, "futures samples 6"]]:
    """The `Known` of each sample by the first row of `parameters`; forcing and offsets by each row, see `Futures`.

    The forcing has no velocity, because a prediction simulates it.

    - `length`: the samples of the flight that are no padding.
    - `measured`: states, accelerations and the white noise of velocity: see `jaxos4.forecast.measured.Measured`.
    - `noise`: levels of the filters. `prior`: the standard deviation of each offset before the flight.
    """
    state, accelerations, velocity_noise = measured
    rates, inputs = flight.states[:, RATES], flight.inputs._replace(length=length)
    middle = jnp.nan_to_num((rates + jnp.roll(rates, -1, axis=0)) / 2)
    kept = jnp.exp(-flight.dt / MEMORY)
    sensor = jnp.concatenate([jnp.exp(noise.sensor[:3]), velocity_noise])
    weight, offset_std = _offset_weights(model, accelerations, noise, sensor, prior, kept, flight.dt)

    def of_future(values: Array) -> tuple[Forcing, Array, Array, Array]:
        forcing, scalars = model.forcing(inputs, values), tuple(values)
        turning = jnp.stack(model.angular_acceleration(Rates(*middle.T), forcing, scalars), axis=1)
        pushing = jnp.stack(model.specific_force(forcing.mean_specific_thrust, forcing, scalars), axis=1)
        residual = accelerations - jnp.concatenate([turning, pushing], axis=1)
        offset = weight * _past(jnp.nan_to_num(residual), kept)
        observe = jax.vmap(lambda rates, row: model.observe(State(Rates(*rates)), row, scalars))
        seen = observe(jnp.nan_to_num(rates), forcing)
        return forcing._replace(velocity=None, recording=()), offset, turning, jnp.stack(seen[3:], axis=1)

    forcing, offset, turning, expected = jax.vmap(of_future)(parameters)
    force = flight.channels[:, len(STATE_NAMES) + np.asarray(model.force_axes, dtype=int)] - expected[0]
    # The bias of an accelerometer is its mean over the memory.
    force = force - _past(jnp.nan_to_num(force), kept) / jnp.maximum(_past(~jnp.isnan(force), kept), 1.0)
    modelled = jnp.concatenate([turning[0] + offset[0, :, :3], jnp.zeros(force.shape)], axis=1)
    seen = jnp.concatenate([rates, force], axis=1)
    filters, _ = filtered(noise, seen, modelled, flight.stretch_numbers, flight.dt)
    return (state, filters, offset_std), forcing, offset


def _offset_weights(
    model: FlightModel,
    accelerations: Array,
    noise: LogNoise,
    sensor: Array,
    prior: Array,
    kept: Scalar,
    dt: Scalar,
) -> tuple[Float[Array, "samples 6"], Float[Array, "samples 6"]]:
    """The factor that makes an offset of a sum of earlier residuals, and the standard deviation of the offsets.

    An offset is the mean of a recording's residuals, drawn towards 0 by its `prior`.
    """
    channels = np.array([0, 1, 2, *(3 + axis for axis in model.force_axes)])
    strength, time_constant = (jnp.full(6, x) for x in (PUSH, PUSH_TIME))
    strength = strength.at[channels].set(jnp.exp(noise.strength))
    smoothing = 0.0 if noise.smoothing is None else jnp.where(is_rate(noise.strength), 0.0, jnp.exp(noise.smoothing))
    time_constant = time_constant.at[channels].set(jnp.exp(noise.time_constant) + smoothing)
    is_known, prior = ~jnp.isnan(accelerations), jnp.square(prior)
    total, squares = _past(is_known, kept), _past(is_known, kept**2)
    count = jnp.maximum(total, 1.0)
    seconds = dt * count**2 / jnp.maximum(squares, 1.0)  # a uniform mean over this time is as exact
    variance = strength**2 * jnp.minimum(1.0, 2 * time_constant / seconds) + 2 * (sensor / (dt * count)) ** 2
    share = prior / (prior + variance)
    return share / count, jnp.sqrt(jnp.where(total > 0, share * variance, prior))


def _past(values: Array, kept: Scalar) -> Float[Array, "samples columns"]:
    """The sum of the values before each sample; each sample earlier has less weight by the factor `kept`."""

    def gather(total: Array, row: Array) -> tuple[Array, Array]:
        return kept * total + row, total

    return jax.lax.scan(gather, jnp.zeros(values.shape[1:], dtype=float), values)[1]


@eqx.filter_jit
def settled(noise: LogNoise, dt: Scalar, rows: int) -> tuple[Covariance, Covariance, Float[Array, " channels"]]:
    """The state of each channel's filter when its gains no longer change, after this many `rows`.

    **Returns:** the covariance of a rate or force and its disturbance after a measurement; what a step adds to it; and
    the share of a constant acceleration that the disturbance absorbs.
    """
    step = step_of(noise, dt)
    measured, never = jnp.ones(step.sensor.shape, dtype=bool), jnp.zeros(1, dtype=bool)
    p, gains = jax.lax.scan(lambda p, _: next_gains(p, step, measured, never), first_covariance(step, 1), length=rows)
    driven, disturbance = gains.driven[-1], gains.disturbance[-1]
    after, _ = next_gains(p, step_of(noise, jnp.zeros_like(dt)), measured, never)
    absorbed = disturbance * dt / (disturbance * step.transition.driven_by + (1 - step.transition.kept) * driven)
    return jax.tree.map(lambda x: x[:, 0], (after, step.added, absorbed))
