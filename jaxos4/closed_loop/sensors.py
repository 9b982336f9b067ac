"""The sensors of a flight in closed loop: vibration, filters, and the faults of a recorder."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, Scalar
from ..flight import ANGLES, RATES, VELOCITY, Flight
from ..models.state import Attitude, Orientation, Rates, Vector, to_earth
from ..rotations import sincos
from ..simulation import until_failure
from .settings import ClosedLoop, PerAxis, Sensors


class BodyMotion(NamedTuple):
    """Body rates [rad/s], attitude [rad], and the velocity along the body's axes [m/s]; `None`: not simulated."""

    rates: Rates
    attitude: Attitude
    velocity: Vector | None


class Signals(NamedTuple):
    """The log's gyro, the controller's gyro and the accelerometer, raw and filtered; `angles` of the rotors [rad].

    `gyros`: the log's gyro after its filter, in each run so far [rad/s].
    """

    raw: Float[Array, "9"]
    filtered: Float[Array, "9"]
    angles: Float[Array, "4"]
    gyros: Float[Array, "runs 3"]


def sensing(
    sensors: Sensors, hover_speed: Scalar, period: Scalar, key: Key
) -> Callable[..., tuple[Signals, PerAxis, PerAxis]]:
    """The sensors of a flight: vibration with random phases, low-pass filters, and a delay of the gyro.

    Filters are of the first order, y' = (x - y) / T, and exact for signals that are linear in each run.

    **Returns:** a function of the signals, the number of a run, and its rotor speeds and unfiltered measurements. It
    returns the signals of the next run, the body rates for the log, and the body rates for the controller.
    """
    phases = jax.random.uniform(key, (4, 6), maxval=2 * np.pi)
    amplitude = jnp.repeat(jnp.stack([sensors.gyro_vibration, sensors.force_vibration]), 3)
    times = jnp.repeat(jnp.stack([sensors.gyro_filter, sensors.controller_gyro_filter, sensors.force_filter]), 3)
    decay, has_own_gyro = jnp.exp(-period / times), ~jnp.isnan(sensors.controller_gyro_noise)
    last = (1 - decay) * times / period
    sine, cosine = amplitude * jnp.cos(phases), amplitude * jnp.sin(phases)
    late = sensors.gyro_delay / period

    def sense(
        signals: Signals, k: Int[Array, ""], speeds: Float[Array, "4"], gyro: PerAxis, own_gyro: PerAxis, force: PerAxis
    ) -> tuple[Signals, PerAxis, PerAxis]:
        strength, (sin, cos) = jnp.square(speeds / hover_speed), sincos(signals.angles)
        shaken = (strength * sin) @ sine + (strength * cos) @ cosine
        raw = jnp.concatenate([gyro + shaken[:3], own_gyro, force + shaken[3:]])
        filtered = decay * signals.filtered + (last - decay) * signals.raw + (1 - last) * raw
        gyros, whole = signals.gyros.at[k].set(filtered[:3]), jnp.floor(late).astype(int)
        now, before = (gyros[jnp.maximum(k - whole - i, 0)] for i in (0, 1))
        logged = now + (late - whole) * (before - now)
        return Signals(raw, filtered, signals.angles, gyros), logged, jnp.where(has_own_gyro, filtered[3:6], logged)

    return sense


def log(loop: ClosedLoop, dt: Scalar, logged: tuple[Array, BodyMotion, Array, Array, Array], key: Key) -> Flight:
    """The log up to the first sample at which the vehicle pitches to 90 degrees or a number is not finite.

    `logged`: rotor speeds, motion, body rates, attitude and specific force in each run of the controller.
    """
    every, sensors, keys = loop.log_every, loop.sensors, jax.random.split(key, 3)
    commands = loop.logged == "commands"
    omega = logged[0]
    if sensors is not None:  # recorded late, also by fractions of a run
        runs, latest = sensors.clock_offset * every / dt, len(omega) - 1
        whole = jnp.floor(runs).astype(int)
        now, before = (omega[jnp.clip(jnp.arange(latest + 1) - whole - i, 0, latest)] for i in (0, 1))
        omega = now + (runs - whole) * (before - now)
    omega, motion, rates, attitude, specific = jax.tree.map(lambda x: x[::every], (omega, *logged[1:]))
    axes = loop.airframe.sensor_axes
    rates, specific = rates @ axes, specific @ axes  # along the axes of the sensors
    states = jnp.full((omega.shape[0], 12), jnp.nan).at[:, ANGLES].set(attitude)
    if sensors is not None:
        omega, step = omega + sensors.speed_noise * jax.random.normal(keys[0], omega.shape), sensors.speed_step
        omega = jnp.where(step > 0, step * jnp.round(omega / jnp.where(step > 0, step, 1.0)), omega)
        bad_key, lost_key = jax.random.split(keys[1])
        measured = jnp.concatenate([rates, specific], axis=1)
        draw = jax.random.uniform(bad_key, measured.shape)
        beyond = jnp.append(jnp.sort(draw.ravel()), 1.0)[sensors.bad_samples.astype(int)]
        measured = jnp.where(draw < beyond, sensors.impossible, measured)
        lost = jax.random.uniform(lost_key, (len(measured), 2)) < sensors.dropouts
        rates, specific = jnp.split(jnp.where(jnp.repeat(lost, 3, axis=1), jnp.nan, measured), 2, axis=1)
    if sensors is not None and motion.velocity is not None:
        velocity = jnp.stack(to_earth(Orientation.of(motion.attitude), motion.velocity), axis=1)
        noise = sensors.velocity_noise * jax.random.normal(keys[2], velocity.shape)
        states = states.at[:, VELOCITY].set(velocity + noise)
    states = states.at[:, RATES].set(rates)

    valid, result = until_failure(jnp.stack(jax.tree.leaves(motion), axis=1), motion.attitude.theta)
    return Flight(
        time=dt * jnp.arange(omega.shape[0]),
        omega=jnp.where(valid[:, None], omega, 0.0),
        states=jnp.where(valid[:, None], states, jnp.nan),
        specific_force=jnp.where(valid[:, None], specific, jnp.nan),
        result=result,
        commanded=commands,
        held=commands,
    )
