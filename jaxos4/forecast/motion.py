"""The free motion of a vehicle from many starts: attitude as a quaternion, so that no attitude is singular."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Scalar
from .._xla import quick_jit
from ..models.state import Forcing, Rates, Samples, State, Vector
from ..models.vehicle import FlightModel
from ..shooting import FASTEST, ShootingProblem
from ..shooting.gains import Covariance, LogNoise, Observed, first_covariance, gains_after, transition
from ..simulation import rk4_step

Quaternion = tuple[Samples, Samples, Samples, Samples]
PARTS = {"position": np.r_[0:3], "velocity": np.r_[3:6], "attitude": np.r_[6:10], "rates": np.r_[10:13]}
"""The places of the parts of a state in an array of 13. The attitude is the quaternion w, x, y, z, body to earth."""

CHUNK = 64
"""The number of starts that fly in one call of a program."""

# Rows after which the covariance of a filter no longer changes.
_SETTLED = 512


class Motion(NamedTuple):
    """Position [m], velocity [m/s] in the earth frame, attitude from body to earth, body rates [rad/s]."""

    position: Vector
    velocity: Vector
    attitude: Quaternion
    rates: Rates


class Known(NamedTuple):
    """What is known at a start; with a leading axis, at many.

    - `first`: the sample.
    - `state`: as measured, as in `PARTS`.
    - `rates`, `disturbance`: by the filters [rad/s], [rad/s^2; m/s^2].
    - `lateral`: the measured specific force along x and y [m/s^2], which lasts, for the terms that need it.
    """

    first: Int[Array, "*starts"]
    state: Float[Array, "*starts 13"]
    rates: Float[Array, "*starts 3"]
    disturbance: Float[Array, "*starts channels"]
    lateral: Float[Array, "*starts 2"]


class Lanes(NamedTuple):
    """Several futures of each start.

    - `parameters`: of the model. `forcing`: of these parameters, one row for each sample.
    - `filtered`: whether the future begins with the rates and the disturbance of the filters, or as measured.
    - `begin`: errors of the state at the start; of the attitude as a small rotation [rad].
    - `pushed`: errors of the disturbances at the start.
    - `gusts`: what rate and disturbance of each channel gain in each step besides the model.
    """

    parameters: Float[Array, "lanes parameters"]
    forcing: Forcing
    filtered: Bool[Array, " lanes"]
    begin: Float[Array, "lanes 12"]
    pushed: Float[Array, "lanes channels"]
    gusts: Float[Array, "lanes steps channels 2"]


class _Acting(NamedTuple):
    """What acts for a step: the forcing, and disturbances of p', q', r' [rad/s^2] and along the body's axes [m/s^2]."""

    forcing: Forcing
    turning: Vector
    pushing: Vector


class _Free(NamedTuple):
    """A `FlightModel` whose attitude is a quaternion, and whose velocity is that of the motion."""

    model: FlightModel

    def cascade(self, state: Motion, forcing: _Acting, parameters) -> Motion:
        """The time derivative of the motion."""
        acting = forcing.forcing._replace(velocity=turned(inverse(state.attitude), state.velocity))
        turning = self.model.angular_acceleration(state.rates, acting, parameters)
        force = self.model.specific_force(acting.thrust, acting, parameters)
        x, y, z = turned(state.attitude, _sum(force, forcing.pushing))
        spin = product(state.attitude, (jnp.zeros_like(x), *(rate / 2 for rate in state.rates)))
        moving = (x, y, z - self.model.airframe.gravity)
        return Motion(state.velocity, moving, spin, Rates(*_sum(turning, forcing.turning)))


def product(a, b) -> Quaternion:
    """The quaternion of the rotation `b`, and then `a`. NumPy and JAX."""
    (w, x, y, z), (k, l, m, n) = a, b
    return (
        w * k - x * l - y * m - z * n,
        w * l + x * k + y * n - z * m,
        w * m - x * n + y * k + z * l,
        w * n + x * m - y * l + z * k,
    )


def inverse(a) -> Quaternion:
    """The quaternion of the rotation back."""
    w, x, y, z = a
    return w, -x, -y, -z


def turned(a, vector) -> Vector:
    """A vector turned by a quaternion: from the body's axes to the earth's, if that is the attitude."""
    return product(product(a, (0.0 * vector[0], *vector)), inverse(a))[1:]


def deviation(a, b) -> Vector:
    """Twice the vector part of the rotation from attitude `a` to `b`, in the axes of `a`: [rad] if it is small."""
    w, *vector = product(inverse(a), b)
    return tuple(2 * x * (1 - 2 * (w < 0)) for x in vector)


def _sum(a: Vector, b: Vector) -> Vector:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _fly(model: FlightModel, lane: Lanes, start: Known, noise: LogNoise, dt: Scalar) -> Float[Array, "steps 13"]:
    """The states of one future of one start, from one step after it. A motion that diverges stays where it was."""
    kept, reach = transition(jnp.exp(noise.time_constant), dt)
    scalars, lateral, axes = tuple(lane.parameters), tuple(start.lateral), model.force_axes
    p, v, q, w = (start.state[places] for places in PARTS.values())
    # A gyro bias is part of the measurement, not of the state.
    still = _row(lane.forcing, start.first)._replace(velocity=(0.0, 0.0, 0.0), lateral=lateral)
    biased = jnp.stack(model.observe(State(Rates(*w)), still, scalars)[:3])
    w = jnp.where(lane.filtered, start.rates, w) - (biased - w) + lane.begin[9:]
    tilt = (jnp.ones(()), *(lane.begin[6:9] / 2))
    begin = Motion(
        tuple(p + lane.begin[:3]), tuple(v + lane.begin[3:6]), _unit(product(tuple(q), tilt)), Rates(*w)
    )

    def step(carry: tuple[Motion, Array, Array], row) -> tuple[tuple[Motion, Array, Array], Array]:
        (motion, disturbance, sound), (i, gust) = carry, row
        forcing = _row(lane.forcing, start.first + i)._replace(lateral=lateral)
        turning = (reach * disturbance + gust[:, 0])[:3] / dt
        pushing = jnp.zeros(3).at[np.asarray(axes, dtype=int)].set(disturbance[3:])
        moved = rk4_step(_Free(model), motion, _Acting(forcing, tuple(turning), tuple(pushing)), scalars, dt)
        moved = moved._replace(attitude=_unit(moved.attitude))
        values = jnp.stack(jax.tree.leaves(moved))
        sound = sound & jnp.isfinite(values).all() & (jnp.abs(jnp.stack(moved.rates)) < FASTEST).all()
        motion = jax.tree.map(lambda new, old: jnp.where(sound, new, old), moved, motion)
        return (motion, kept * disturbance + gust[:, 1], sound), jnp.stack(jax.tree.leaves(motion))

    pushed = jnp.where(lane.filtered, start.disturbance, 0.0) + lane.pushed
    steps = lane.gusts.shape[0]
    return jax.lax.scan(step, (begin, pushed, jnp.array(True)), (jnp.arange(steps), lane.gusts))[1]


def _row(forcing: Forcing, row: Int[Array, ""]) -> Forcing:
    return jax.tree.map(lambda leaf: leaf[row], forcing)


def _unit(a: Quaternion) -> Quaternion:
    length = jnp.sqrt(sum(x * x for x in a))
    return tuple(x / length for x in a)


def departures(states: Float[Array, "*batch 13"], others: Float[Array, "*batch 13"]) -> Float[Array, "*batch 12"]:
    """How far other states are off: position, velocity, attitude by `deviation`, rates. NumPy and JAX."""
    difference, xp = others - states, np if isinstance(states, np.ndarray) else jnp
    turn = deviation(xp.moveaxis(states[..., 6:10], -1, 0), xp.moveaxis(others[..., 6:10], -1, 0))
    return xp.concatenate([difference[..., :6], xp.stack(turn, axis=-1), difference[..., 10:]], axis=-1)


@eqx.filter_jit
def fly_chunk(
    model: FlightModel, lanes: Lanes, starts: Known, noise: LogNoise, dt: Scalar
) -> tuple[Float[Array, "starts 2 steps 13"], Float[Array, "starts steps 12"]]:
    """The first two lanes of each start, and the root mean square `departures` of the other lanes from the first."""

    def every(start: Known) -> tuple[Array, Array]:
        states = jax.vmap(lambda lane: _fly(model, lane, start, noise, dt))(lanes)
        off = departures(jnp.broadcast_to(states[0], states[2:].shape), states[2:])
        return states[:2], jnp.sqrt(jnp.square(off).mean(axis=0))

    return jax.vmap(every)(starts)


@quick_jit
def forcing_of(problem: ShootingProblem, parameters: Float[Array, "lanes parameters"]) -> Forcing:
    """The forcing of a flight for each row of parameters. Velocity and lateral force are those of the prediction."""
    forcing = jax.vmap(problem.forcing)(parameters)
    return forcing._replace(velocity=None, lateral=None, recording=())


@quick_jit
def settled(noise: LogNoise, dt: Scalar) -> tuple[Covariance, Covariance]:
    """The covariance of rate and disturbance after a measurement, and what a step adds to it, of each channel."""
    channels = noise.strength.shape[0]

    def rows(value: float, count: int) -> Observed:
        never = jnp.zeros((count, 1), dtype=bool)
        return Observed(jnp.full((count, channels, 1), value), never, never)

    known, unknown = rows(0.0, _SETTLED), rows(jnp.nan, 1)
    p, gains = gains_after(first_covariance(known, noise, dt), noise, known, dt)
    rate, disturbance = 1 - gains.rate[-1], gains.disturbance[-1]
    of_rate = p.disturbance - p.cross * disturbance
    is_rate = jnp.arange(channels)[:, None] < len(Rates._fields)
    after = Covariance(p.rate * rate, p.cross * rate, jnp.where(is_rate, of_rate, p.disturbance * (1 - disturbance)))
    none = jax.tree.map(jnp.zeros_like, p)
    return jax.tree.map(lambda x: x[:, 0], (after, gains_after(none, noise, unknown, dt)[0]))
