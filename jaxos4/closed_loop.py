"""Simulation of a flight in closed loop: a controller flies the vehicle through gusts and logs what autopilots log.

On a simulated flight with given rotor speeds (`jaxos4.simulate`) the inputs know nothing of the disturbances. On a real
flight the controller answers each gust, so inputs and disturbances are correlated. This file makes such flights.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from ._custom_types import Key, Numeric, RotorSpeeds, Scalar, as_float
from ._xla import quick_jit
from .airframe import Airframe
from .flight import Flight
from .models.state import CASCADE_ORDER, Forcing, stack, unstack
from .models.vehicle import FlightModel
from .noise import FORCE_SIGMA
from .results import RESULTS
from .simulation import rk4_step

References = Float[Array, "samples 4"]
PerAxis = Float[Array, "3"]
# Body rates and attitude of the vehicle.
Motion = Float[Array, "6"]

LOGGED = ("commands", "speeds")
# The controller tilts the thrust no further than this to carry the weight: the cosine of 60 degrees.
_STEEPEST = 0.5


def _per_axis(name: str, low: float = 0.0) -> Callable[[ArrayLike | Sequence[float]], Array]:
    """A field's converter: accepts one number or three (roll, pitch, yaw), not below `low` unless traced."""

    def convert(value: ArrayLike | Sequence[float]) -> Array:
        array = as_float(np.asarray(value) if isinstance(value, Sequence) else value)
        if array.shape not in ((), (3,)):
            raise ValueError(f"`{name}` must be one number or three (roll, pitch, yaw), got shape {array.shape}.")
        _check(name, array, low)
        return jnp.broadcast_to(array, (3,))

    return convert


def _scalar(name: str) -> Callable[[ArrayLike], Array]:
    """A field's converter: accepts one number, not below 0 unless traced."""

    def convert(value: ArrayLike) -> Array:
        array = as_float(value)
        if array.shape != ():
            raise ValueError(f"`{name}` must be one number, got shape {array.shape}; use `vmap` for a batch.")
        _check(name, array, 0.0)
        return array

    return convert


def _check(name: str, array: Array, low: float) -> None:
    if not isinstance(array, Tracer) and not np.all((np.asarray(array) >= low) & np.isfinite(array)):
        least = "" if low == -np.inf else f" and at least {low:g}"
        raise ValueError(f"`{name}` must be finite{least}, got {np.asarray(array).tolist()}.")


class ClosedLoop(eqx.Module):
    """A vehicle with its controller, its disturbances and its sensors. `fly_closed_loop` flies it.

    A setting "for each axis" is one number for all axes, or three for roll, pitch and yaw.

    The vehicle. Its equations are those of `FlightModel` with the terms offset, damping, reaction, lag and delay:

    - `airframe`: the true constants. Rotor speeds lie between 0 and its `max_rotor_speed`. Its `rotor_inertia` makes
      the gyroscopic torque and the yaw moment of rotors that accelerate.
    - `rotor_lag`, `rotor_delay`: lag and delay of the rotors behind their commands [s], not only whole samples.
    - `offset`: a constant torque over the inertia, for each axis [rad/s^2].
    - `damping`: a moment against the body rate, for each axis [1/s].

    The gusts, which are Ornstein-Uhlenbeck processes:

    - `gust`: standard deviation of the disturbance torque over the inertia, for each axis [rad/s^2].
    - `thrust_gust`: standard deviation of the disturbance of the vertical specific force [m/s^2].
    - `gust_time`: their correlation time [s].

    The sensors have white noise:

    - `gyro_noise` [rad/s], `attitude_noise` [rad], `force_noise` (accelerometer) [m/s^2]: standard deviations.

    The controller: attitude error x `attitude_gain` is the wanted body rate. A PI controller of the body rate makes the
    wanted angular acceleration. Torque is that x `controller_inertia`. The thrust carries the weight. A rotor that
    would have to be slower than 0 or faster than its maximum saturates, and the integrators then stop.

    - `attitude_gain` [1/s], `rate_gain` [1/s], `integral_gain` [1/s^2]: for each axis.
    - `controller_inertia`: Ix, Iy, Iz that the controller knows [kg m^2]; the true ones by default.

    - `logged`: `"commands"`, or `"speeds"` for measured rotor speeds.

    **Raises:** `ValueError` that names the setting.
    """

    airframe: Airframe
    rotor_lag: Scalar = eqx.field(converter=_scalar("rotor_lag"), default=0.05)
    rotor_delay: Scalar = eqx.field(converter=_scalar("rotor_delay"), default=0.01)
    offset: PerAxis = eqx.field(converter=_per_axis("offset", -np.inf), default=0.0)
    damping: PerAxis = eqx.field(converter=_per_axis("damping", -np.inf), default=0.0)
    gust: PerAxis = eqx.field(converter=_per_axis("gust"), default=0.0)
    thrust_gust: Scalar = eqx.field(converter=_scalar("thrust_gust"), default=0.0)
    gust_time: Scalar = eqx.field(converter=_scalar("gust_time"), default=0.25)
    gyro_noise: Scalar = eqx.field(converter=_scalar("gyro_noise"), default=0.02)
    attitude_noise: Scalar = eqx.field(converter=_scalar("attitude_noise"), default=0.002)
    force_noise: Scalar = eqx.field(converter=_scalar("force_noise"), default=FORCE_SIGMA)
    attitude_gain: PerAxis = eqx.field(converter=_per_axis("attitude_gain"), default=(4.0, 4.0, 2.0))
    rate_gain: PerAxis = eqx.field(converter=_per_axis("rate_gain"), default=(12.0, 12.0, 6.0))
    integral_gain: PerAxis = eqx.field(converter=_per_axis("integral_gain"), default=(10.0, 10.0, 5.0))
    controller_inertia: PerAxis | None = eqx.field(
        converter=lambda x: None if x is None else _per_axis("controller_inertia")(x), default=None
    )
    logged: str = eqx.field(static=True, default="commands")

    def __check_init__(self):
        if self.logged not in LOGGED:
            raise ValueError(f"`logged` must be one of {', '.join(LOGGED)}, got {self.logged!r}.")


def random_references(
    *,
    duration: float = 20.0,
    dt: float = 0.004,
    hold: float = 0.5,
    amplitude: Sequence[float] = (0.3, 0.3, 0.3, 1.5),
    key: Key,
) -> References:
    """References of a standard flight: roll, pitch and yaw angle and vertical acceleration step to random levels.

    **Arguments:**

    - `duration`, `dt`: length and sample time [s].
    - `hold`: the time between two steps of one reference [s]. The references do not step at the same time.
    - `amplitude`: levels are uniform between -amplitude and amplitude: roll, pitch, yaw [rad], acceleration [m/s^2].

    **Returns:** the references in round(duration / dt) + 1 rows. The first and the last second are level.

    **Raises:** `ValueError` that names the argument.
    """
    for name, value in (("duration", duration), ("dt", dt), ("hold", hold)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"`{name}` must be positive and finite [s], got {value}.")
    if len(amplitude) != 4 or not np.all(np.isfinite(amplitude)):
        raise ValueError(f"`amplitude` must be four finite numbers, got {amplitude}.")
    time = dt * np.arange(round(duration / dt) + 1)
    steps = (time[:, None] / hold + np.arange(4) / 4).astype(int)
    flown = (time >= 1) & (time <= duration - 1)
    return _levels(key, steps, int(steps[-1, -1]) + 1, flown[:, None] * np.asarray(amplitude, dtype=float))


@functools.partial(jax.jit, static_argnums=2)
def _levels(key: Key, steps: Int[Array, "samples 4"], count: int, amplitude: References) -> References:
    """The level of each reference in each of its steps, of which there are at most `count`."""
    levels = jax.random.uniform(key, (count, 4), minval=-1, maxval=1)
    return amplitude * jnp.take_along_axis(levels, steps, axis=0)


def fly_closed_loop(
    loop: ClosedLoop,
    references: References,
    *,
    dt: Float[ArrayLike, ""] = 0.004,
    key: Key,
    substeps: int = 4,
) -> Flight:
    """Fly a vehicle in closed loop from hovering, and return what its autopilot logs.

    The flight is one `lax.scan`. `vmap` it over keys, gust strengths or airframes.

    **Arguments:**

    - `references`: roll, pitch and yaw angle [rad] and vertical acceleration [m/s^2] in each sample, of shape
      (samples, 4); `random_references` makes some.
    - `dt`: the sample time of the controller and of the log [s].
    - `key`: for the gusts and the noise.
    - `substeps`: Runge-Kutta steps of the physics in each sample.

    **Returns:** a `Flight` with noisy body rates, attitude and specific force. Row k of `omega` holds the commands from
    sample k to sample k + 1, or the mean speed of each rotor in that time. Its `result` is that of `simulate`. After a
    failure the measurements are NaN and the rotor speeds are 0.

    **Raises:** `ValueError` that names the argument.
    """
    shape = jnp.shape(references)
    if len(shape) != 2 or shape[0] < 2 or shape[1] != 4:
        raise ValueError(f"`references` must have shape (samples, 4), at least two samples, got {shape}.")
    if not isinstance(dt, Tracer) and not np.asarray(dt) > 0:
        raise ValueError(f"`dt` must be positive, got {dt}.")
    if substeps < 1:
        raise ValueError(f"`substeps` must be at least 1, got {substeps}.")
    return _fly(loop, as_float(references), as_float(dt), key, substeps)


def fly_standard(
    loop: ClosedLoop,
    *,
    references: Float[Numeric, "samples 4"] | None = None,
    duration: float = 20.0,
    dt: float = 0.004,
    seed: int,
) -> Flight:
    """Fly references, by default random ones, with all random numbers from `seed`: `jaxos4 simulate --closed-loop`."""
    first, flight = jax.random.split(jax.random.key(seed))
    if references is None:
        references = random_references(duration=duration, dt=dt, key=first)
    return fly_closed_loop(loop, as_float(references), dt=dt, key=flight)


class _Carry(NamedTuple):
    """The state from sample to sample. Row k + 1 of `commands` is the command of sample k, row 0 the one before."""

    motion: Motion
    speeds: Float[Array, "4"]
    integral: PerAxis
    commands: RotorSpeeds


@quick_jit
def _fly(loop: ClosedLoop, references: References, dt: Scalar, key: Key, substeps: int) -> Flight:
    samples, h = references.shape[0], dt / substeps
    airframe, gust_key, noise_key = loop.airframe, *jax.random.split(key)
    strength = jnp.append(loop.gust, loop.thrust_gust)
    gusts = strength * ornstein_uhlenbeck(gust_key, samples * substeps + 1, h / loop.gust_time)
    spread = jnp.repeat(jnp.stack([loop.gyro_noise, loop.attitude_noise, loop.force_noise]), 3)
    noise = spread * jax.random.normal(noise_key, (samples, 9))

    model = FlightModel(airframe, terms=("offset", "damping", "reaction"))
    mixer, spins = jnp.asarray(airframe.mixer), jnp.asarray(airframe.rotor_spins)
    *alpha, reaction = model.alpha[jnp.array([*range(8), -1])]
    # A command acts `late` samples after its own, and in the first `part` of a sample the one before it still acts.
    late = jnp.floor(loop.rotor_delay / dt).astype(int)
    part = loop.rotor_delay / dt - late

    def physics(motion: Motion, speeds: Array, command: Array, gust: Array) -> tuple[Motion, Array]:
        after = command + (speeds - command) * jnp.exp(-h / loop.rotor_lag)
        roll, pitch, yaw, thrust = mixer @ ((speeds * speeds + speeds * after + after * after) / 3)
        residual, spin_up = (speeds + after) @ spins / 2, (after - speeds) @ spins / h
        forcing = Forcing(roll, pitch, yaw, thrust / airframe.mass, residual, spin_up)
        parameters = (*alpha, *(loop.offset + gust[:3]), *loop.damping, reaction)
        return stack(rk4_step(model, unstack(motion), forcing, parameters, h)), after

    def sample(carry: _Carry, row):
        k, reference, gust, error = row
        measured = carry.motion + error[:6]
        thrust = mixer[3] @ jnp.square(carry.speeds) / airframe.mass + gust[0, 3]
        specific = jnp.stack([jnp.zeros_like(thrust), jnp.zeros_like(thrust), thrust]) + error[6:]
        command, integral = _control(loop, mixer, reference, measured, carry.integral, dt)
        commands = carry.commands.at[k + 1].set(command)
        before, now = (commands[jnp.maximum(k + 1 - late - i, 0)] for i in (1, 0))

        def step(moving, row):
            motion, speeds = moving
            j, begin, end = row
            share = jnp.clip(substeps * part - j, 0, 1)
            motion, after = physics(motion, speeds, now + share * (before - now), (begin + end) / 2)
            return (motion, after), (speeds + after) / 2

        rows = (jnp.arange(substeps), gust[:-1], gust[1:])
        (motion, speeds), means = jax.lax.scan(step, (carry.motion, carry.speeds), rows)
        omega = command if loop.logged == "commands" else means.mean(axis=0)
        return _Carry(motion, speeds, integral, commands), (omega, carry.motion, measured, specific)

    weight = as_float(airframe.mass * airframe.gravity)
    hover, _ = _speeds(mixer, jnp.zeros(3), weight, airframe.max_rotor_speed)
    first = _Carry(jnp.zeros(6), hover, jnp.zeros(3), jnp.broadcast_to(hover, (samples + 1, 4)))
    rows = substeps * np.arange(samples)[:, None] + np.arange(substeps + 1)
    inputs = (jnp.arange(samples), references, gusts[rows], noise)
    omega, motion, measured, specific = jax.lax.scan(sample, first, inputs)[1]
    return _log(loop, dt, omega, motion, measured, specific)


def _control(
    loop: ClosedLoop, mixer: Array, reference: Array, measured: Array, integral: PerAxis, dt: Scalar
) -> tuple[Float[Array, "4"], PerAxis]:
    """The commands [rad/s] of one sample, and the integrators after it."""
    airframe, rates, attitude = loop.airframe, measured[:3], measured[3:]
    error = loop.attitude_gain * (reference[:3] - attitude) - rates
    demand = loop.rate_gain * error + integral
    upright = jnp.maximum(jnp.cos(attitude[0]) * jnp.cos(attitude[1]), _STEEPEST)
    thrust = as_float(airframe.mass * (reference[3] + airframe.gravity) / upright)
    inertia = as_float(airframe.inertia) if loop.controller_inertia is None else loop.controller_inertia
    command, saturated = _speeds(mixer, inertia * demand, thrust, airframe.max_rotor_speed)
    return command, jnp.where(saturated, integral, integral + dt * loop.integral_gain * error)


def _speeds(mixer: Array, torque: PerAxis, thrust: Scalar, fastest: Numeric) -> tuple[Float[Array, "4"], Array]:
    """The rotor speeds [rad/s] that make torque [N m] and thrust [N], and whether one of them saturates."""
    wanted = jnp.linalg.solve(mixer, jnp.append(torque, thrust))
    squares = jnp.clip(wanted, 0.0, jnp.asarray(fastest) ** 2)
    return jnp.sqrt(squares), jnp.any(squares != wanted)


def ornstein_uhlenbeck(key: Key, count: int, step: Scalar) -> Float[Array, "count 4"]:
    """Four independent Ornstein-Uhlenbeck processes of unit variance; `step`: time step / correlation time."""
    decay, fresh = jnp.exp(-step), jnp.sqrt(-jnp.expm1(-2 * step))
    draws = jax.random.normal(key, (count, 4))

    def advance(value, draw):
        value = decay * value + fresh * draw
        return value, value

    return jnp.concatenate([draws[:1], jax.lax.scan(advance, draws[0], draws[1:])[1]])


def _log(loop: ClosedLoop, dt: Scalar, omega: RotorSpeeds, motion: Array, measured: Array, specific: Array) -> Flight:
    """The log up to the first sample at which the vehicle pitches to 90 degrees or a number is not finite."""
    finite = jnp.isfinite(motion).all(axis=1)
    valid = jnp.cumsum(~(finite & (jnp.abs(motion[:, 4]) < jnp.pi / 2))) == 0
    result = RESULTS.where(finite[jnp.argmin(valid)], RESULTS.attitude_singularity, RESULTS.nonfinite_trajectory)
    result = RESULTS.where(valid.all(), RESULTS.successful, result)
    states = jnp.full((omega.shape[0], 12), jnp.nan).at[:, CASCADE_ORDER[:6]].set(measured)
    return Flight(
        time=dt * jnp.arange(omega.shape[0]),
        omega=jnp.where(valid[:, None], omega, 0.0),
        states=jnp.where(valid[:, None], states, jnp.nan),
        specific_force=jnp.where(valid[:, None], specific, jnp.nan),
        result=result,
        commanded=loop.logged == "commands",
    )
