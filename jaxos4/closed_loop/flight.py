"""A flight in closed loop: the true vehicle, its controller, and the log of its sensors."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from .._custom_types import Key, Numeric, Scalar, as_float, integer, setting
from ..airframe import alpha_scalars
from ..excitation import References, random_references
from ..flight import ANGLES, RATES, VELOCITY, Flight
from ..linalg import invert
from ..models.os4 import CorrectedOS4
from ..models.state import Attitude, Forcing, Orientation, Rates, Vector, attitude_rates, to_earth
from ..noise import coloured
from ..rotations import sincos
from ..simulation import runge_kutta, until_failure
from .settings import ClosedLoop, PerAxis, Sensors


def fly_closed_loop(
    loop: ClosedLoop, references: References, *, dt: Float[ArrayLike, ""] = 0.004, key: Key, substeps: int = 4
) -> Flight:
    """Fly a vehicle in closed loop from hovering, and return what its autopilot logs. `vmap` it for a batch.

    - `references`: roll, pitch and yaw angle [rad] and vertical acceleration [m/s^2] in each sample, of shape (samples,
      4).
    - `dt`: the sample time of the log [s]. The controller runs `loop.log_every` times in each sample.
    - `key`: random key of the gusts and the noise.
    - `substeps`: Runge-Kutta steps of the physics in each sample, a multiple of `loop.log_every`.

    **Returns:** a `Flight` with noisy body rates, attitude and specific force. Row k of `omega` holds the commands that
    act from sample k on, or the speed of each rotor at sample k. After a failure (`result`), measurements are NaN and
    speeds are 0.

    **Raises:** `ValueError` that names the argument.
    """
    shape = jnp.shape(references)
    if len(shape) != 2 or shape[0] < 2 or shape[1] != 4:
        raise ValueError(f"`references` must have shape (samples, 4), at least two samples, got {shape}.")
    substeps = integer("substeps", 1, static=True)(substeps)
    if substeps % loop.log_every:
        raise ValueError(f"`substeps` must be a positive multiple of `log_every` = {loop.log_every}, got {substeps}.")
    return _fly(loop, as_float(references), setting("dt", positive=True)(dt), key, substeps)


def fly_standard(
    loop: ClosedLoop,
    *,
    references: Float[Numeric, "samples 4"] | None = None,
    duration: float = 20.0,
    dt: float = 0.004,
    seed: int,
) -> Flight:
    """Fly references, by default random ones, with all random numbers from `seed`: `jaxos4 simulate --closed-loop`.

    There are at least four Runge-Kutta steps in each sample.
    """
    first, flight = jax.random.split(jax.random.key(seed))
    if references is None:
        references = random_references(duration=duration, dt=dt, key=first)
    substeps = loop.log_every * -(-4 // loop.log_every)
    return fly_closed_loop(loop, as_float(references), dt=dt, key=flight, substeps=substeps)


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


def _physics(loop: ClosedLoop) -> tuple[Callable[..., BodyMotion], Callable[..., Vector]]:
    """The functions `derivative(motion, forcing, wind, gusts)` and `specific_force(velocity, forcing, wind)`.

    Motion, specific force [m/s^2] and wind are along the body's axes. The forcing is that of rotors and vertical gust;
    `gusts` are added to p', q', r'. Constants are scalars, because a batch of scalars vectorises.
    """
    airframe, air = loop.airframe, loop.air
    ix, iy, iz = jnp.asarray(airframe.inertia)
    rotor, gravity = jnp.asarray(airframe.rotor_inertia), jnp.asarray(airframe.gravity)
    alpha, reaction, damping = alpha_scalars(ix, iy, iz, rotor), rotor / iz, tuple(loop.damping)

    def specific_force(velocity: Vector | None, forcing: Forcing, wind: Vector | None) -> Vector:
        thrust = forcing.mean_specific_thrust
        if air is None or velocity is None or wind is None:
            return jnp.zeros_like(thrust), jnp.zeros_like(thrust), thrust
        each = zip((*air.drag, air.inflow), velocity, wind, strict=True)
        x, y, z = (drag * (blown - v) for drag, v, blown in each)
        return x, y, thrust + z

    def derivative(motion: BodyMotion, forcing: Forcing, wind: Vector | None, gusts: Vector) -> BodyMotion:
        p, q, r = motion.rates
        turning = CorrectedOS4().angular_acceleration(motion.rates, forcing, alpha)
        each = zip(turning, gusts, damping, motion.rates, strict=True)
        turning = Rates(*(total + gust - share * rate for total, gust, share, rate in each))
        turning = turning._replace(r=turning.r - reaction * forcing.spin_up)
        orientation = Orientation.of(motion.attitude)
        attitude = attitude_rates(motion.rates, orientation)
        if air is None or motion.velocity is None or wind is None:
            return BodyMotion(turning, attitude, None)
        (u, v, w), (wind_x, wind_y, _), (roll, pitch) = motion.velocity, wind, air.flapping
        turning = jax.tree.map(jnp.add, turning, Rates(roll * (v - wind_y), pitch * (u - wind_x), jnp.zeros_like(u)))
        sin_phi, cos_phi, sin_theta, cos_theta, _, _ = orientation
        x, y, z = specific_force(motion.velocity, forcing, wind)
        moving = (
            x + gravity * sin_theta - q * w + r * v,
            y - gravity * cos_theta * sin_phi - r * u + p * w,
            z - gravity * cos_theta * cos_phi - p * v + q * u,
        )
        return BodyMotion(turning, attitude, moving)

    return derivative, specific_force


def _draw(loop: ClosedLoop, key: Key, runs: int, steps: int, h: Scalar) -> tuple:
    """The random numbers of this many runs of the controller, each with `steps` of length `h`.

    **Returns:** in rows for each run: gusts, which include the constant torque, and winds at the ends of the steps; the
    noise of gyro, attitude and accelerometer; and the noise of the controller's own gyro.
    """
    (gust_key, noise_key), (wind_key, own_key) = jax.random.split(key), jax.random.split(jax.random.fold_in(key, 0))
    shape, rows = (runs * steps + 1, 4), steps * np.arange(runs)[:, None] + np.arange(steps + 1)
    gusts = jnp.append(loop.gust, loop.thrust_gust) * coloured(jax.random.normal(gust_key, shape), h / loop.gust_time)
    noise = jnp.repeat(jnp.stack([loop.gyro_noise, loop.attitude_noise, loop.force_noise]), 3)
    gusts, winds, own = (jnp.append(loop.offset, 0.0) + gusts)[rows], None, None
    if loop.air is not None:
        winds = loop.air.wind * coloured(jax.random.normal(wind_key, shape), h / loop.air.wind_time)[rows][..., :3]
    if loop.sensors is not None:
        own = jnp.nan_to_num(loop.sensors.controller_gyro_noise) * jax.random.normal(own_key, (runs, 3))
    return (gusts, winds), noise * jax.random.normal(noise_key, (runs, 9)), own


@eqx.filter_jit
def _fly(loop: ClosedLoop, references: References, dt: Scalar, key: Key, substeps: int) -> Flight:
    samples, steps = references.shape[0], substeps // loop.log_every
    runs, period = samples * loop.log_every, dt / loop.log_every
    h, airframe, (derivative, specific_force) = period / steps, loop.airframe, _physics(loop)
    sense_key, log_key = jax.random.split(jax.random.fold_in(key, 1))
    sense = loop.sensors and _sensing(loop.sensors, jnp.asarray(airframe.hover_speed), period, sense_key)
    mixer, spins, motor = jnp.asarray(airframe.mixer), jnp.asarray(airframe.rotor_spins), loop.motor
    allocation = mixer.T @ invert(mixer @ mixer.T)  # the mixer's inverse, without a call of LAPACK
    hover_cube = jnp.asarray(airframe.hover_speed) ** 3
    # A command acts `late` runs after its own. In the first `part` of a run, the command before it still acts.
    late = jnp.floor(loop.rotor_delay / period).astype(int)
    part = loop.rotor_delay / period - late

    def acting(weak, squares, residual, spin_up, gust, wind) -> tuple[Forcing, Vector | None, Vector]:
        roll, pitch, yaw, thrust = weak * (mixer @ squares)
        *gusts, pushing = gust
        forcing = Forcing(roll, pitch, yaw, thrust / airframe.mass + pushing, residual, spin_up)
        return forcing, None if wind is None else tuple(wind), tuple(gusts)

    def run(carry, row):
        (motion, before_run, integral, commands, signals), (k, reference, (blown, error, own_error)) = carry, row
        weak, nothing = 1 - loop.sag * k / (runs - 1), jnp.zeros(())
        first = jax.tree.map(lambda ends: ends[0], blown)
        forcing, wind, _ = acting(weak, jnp.square(before_run), nothing, nothing, *first)
        specific = jnp.stack(specific_force(motion.velocity, forcing, wind)) + error[6:]
        rates, attitude = jnp.stack(motion.rates), jnp.stack(motion.attitude) + error[3:6]
        seen = gyro = rates + error[:3]
        if sense is not None and signals is not None:
            signals, gyro, seen = sense(signals, k, before_run, gyro, rates + own_error, specific)
            specific = signals.filtered[6:]
        command, integral = _control(loop, allocation, reference, seen, attitude, integral, period)
        commands = commands.at[k + 1].set(command)
        before, now = (commands[jnp.maximum(k + 1 - late - i, 0)] for i in (1, 0))

        def step(moving, row):
            motion, speeds = moving
            j, *gust_and_wind = row
            share = jnp.clip(steps * part - j, 0, 1)
            wanted = now + share * (before - now)
            load = (speeds**3).mean() / hover_cube
            after = motor.step(speeds, (1 - loop.load_sag * (load - 1)) * wanted, h)
            squares = (speeds * speeds + speeds * after + after * after) / 3
            residual, spin_up = (speeds + after) @ spins / 2, (after - speeds) @ spins / h
            forced = acting(weak, squares, residual, spin_up, *gust_and_wind)
            return (runge_kutta(lambda motion: derivative(motion, *forced), motion, h), after), (speeds + after) / 2

        middle = jax.tree.map(lambda ends: (ends[:-1] + ends[1:]) / 2, blown)
        (later, speeds), means = jax.lax.scan(step, (motion, before_run), (jnp.arange(steps), *middle))
        mean = means.mean(axis=0)
        signals = None if signals is None else signals._replace(angles=signals.angles + period * mean)
        omega = command if loop.logged == "commands" else before_run
        return (later, speeds, integral, commands, signals), (omega, motion, gyro, attitude, specific)

    inputs = jnp.arange(runs), jnp.repeat(references, loop.log_every, axis=0), _draw(loop, key, runs, steps, h)
    return _log(loop, dt, jax.lax.scan(run, _hovering(loop, allocation, runs), inputs)[1], log_key)


def _hovering(loop: ClosedLoop, allocation: Array, runs: int) -> tuple:
    """The state before the first run: level and at rest, with rotors that carry the weight.

    **Returns:** motion, rotor speeds, integrators, commands, of which row k + 1 holds that of run k, and signals.
    """
    airframe, zero = loop.airframe, jnp.zeros(())
    weight = as_float(airframe.mass * airframe.gravity)
    hover, _ = _speeds(allocation, jnp.zeros(3), weight, airframe.max_rotor_speed)
    velocity = None if loop.air is None else (zero, zero, zero)
    motion = BodyMotion(Rates(zero, zero, zero), Attitude(zero, zero, zero), velocity)
    still = jnp.zeros(9).at[8].set(airframe.gravity)
    signals = None if loop.sensors is None else Signals(still, still, jnp.zeros(4), jnp.zeros((runs, 3)))
    commands = jnp.broadcast_to(loop.motor.command(hover), (runs + 1, 4))
    return motion, hover, jnp.zeros(3), commands, signals


def _control(
    loop: ClosedLoop,
    allocation: Array,
    reference: Array,
    seen: PerAxis,
    attitude: PerAxis,
    integral: PerAxis,
    dt: Scalar,
) -> tuple[Float[Array, "4"], PerAxis]:
    """The commands [rad/s] of one run, and the integrators after it. `seen`: the measured body rates."""
    airframe = loop.airframe
    error = loop.attitude_gain * (reference[:3] - attitude) - seen
    demand = loop.rate_gain * error + integral
    upright = jnp.maximum(jnp.cos(attitude[0]) * jnp.cos(attitude[1]), loop.steepest)
    thrust = as_float(airframe.mass * (reference[3] + airframe.gravity) / upright)
    inertia = as_float(airframe.inertia) if loop.controller_inertia is None else loop.controller_inertia
    speeds, saturated = _speeds(allocation, inertia * demand, thrust, airframe.max_rotor_speed)
    return loop.motor.command(speeds), jnp.where(saturated, integral, integral + dt * loop.integral_gain * error)


def _speeds(allocation: Array, torque: PerAxis, thrust: Scalar, fastest: Numeric) -> tuple[Float[Array, "4"], Array]:
    """The rotor speeds [rad/s] that make torque [N m] and thrust [N], and whether one of them saturates."""
    wanted = allocation @ jnp.append(torque, thrust)
    squares = jnp.clip(wanted, 0.0, jnp.asarray(fastest) ** 2)
    return jnp.sqrt(squares), jnp.any(squares != wanted)


def _sensing(
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


def _log(loop: ClosedLoop, dt: Scalar, logged: tuple[Array, BodyMotion, Array, Array, Array], key: Key) -> Flight:
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
