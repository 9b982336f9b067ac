"""The OS4's equations of motion, as a cascade: rotor speeds -> torque -> rates -> attitude -> translation.

The parameters enter only the rate equations; attitude follows from the rates, translation from the attitude, and
neither feeds back. A `State` may therefore stop at any floor of the cascade: what is `None` is neither simulated nor
needed. States are held as separate scalars, because a batch of scalars vectorises and a batch of 12-vectors does not.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._custom_types import Parameters, RotorSpeeds, Scalar, StateVector
from .airframe import OS4, Airframe, alpha_from_inertia, alpha_scalars
from .trigonometry import sincos


class Rates(NamedTuple):
    """Body rates [rad/s]."""

    p: Scalar
    q: Scalar
    r: Scalar


class Attitude(NamedTuple):
    """Euler angles, yaw-pitch-roll [rad]."""

    phi: Scalar
    theta: Scalar
    psi: Scalar


class Translation(NamedTuple):
    """Position [m] and velocity [m/s] in the earth frame, z up."""

    x: Scalar
    vx: Scalar
    y: Scalar
    vy: Scalar
    z: Scalar
    vz: Scalar


class State(NamedTuple):
    """The state down to some floor of the cascade."""

    rates: Rates
    attitude: Attitude | None = None
    translation: Translation | None = None


class Forcing(NamedTuple):
    """What the rotors do: torques [N m], specific thrust U_c/m [m/s^2], residual rotor speed Omega_r [rad/s].

    Of a `FlightModel`, and nothing of others:

    - `spin_up`: Omega_r' [rad/s^2].
    - `specific_thrust`: U_c / m at the sample itself [m/s^2], as an accelerometer there feels it.
    - `recording`: for each recording, 1 where the sample belongs to it and 0 where not.
    - `velocity`: along the body's axes [m/s], where that is an input.
    - `lateral`: the measured specific force along x and y [m/s^2], where that is an input.
    """

    roll: Float[Array, "*samples"]
    pitch: Float[Array, "*samples"]
    yaw: Float[Array, "*samples"]
    thrust: Float[Array, "*samples"]
    residual_speed: Float[Array, "*samples"]
    spin_up: Float[Array, "*samples"] | None = None
    specific_thrust: Float[Array, "*samples"] | None = None
    recording: tuple[Float[Array, "*samples"], ...] = ()
    velocity: tuple[Float[Array, "*samples"], ...] | None = None
    lateral: tuple[Float[Array, "*samples"], ...] | None = None


class Stretches(NamedTuple):
    """For each sample of joined flights: the `number` of its uninterrupted stretch, and that one's ends.

    Numbers count from 0, in order. `first`, `last`: samples.
    """

    number: Int[Array, " samples"]
    first: Int[Array, " samples"]
    last: Int[Array, " samples"]

    @classmethod
    def of(cls, number: Int[Array, " samples"]) -> "Stretches":
        """With the ends found."""
        return cls(number, jnp.searchsorted(number, number), jnp.searchsorted(number, number, side="right") - 1)


class Inputs(NamedTuple):
    """What drives a vehicle, on the time grid of its flight.

    - `omega`: rotor speeds, measured or commanded [rad/s].
    - `dt`: the sample time [s].
    - `velocity`: along the body's axes [m/s], where that is known.
    - `force`: the measured specific force along the body's axes [m/s^2], where a model takes it as an input.
    - `stretches`: which uninterrupted stretch each sample belongs to; `None`: all to one.
    """

    omega: RotorSpeeds
    dt: Scalar
    velocity: Float[Array, "samples 3"] | None = None
    force: Float[Array, "samples 3"] | None = None
    stretches: Stretches | None = None


# Where the leaves of a `State` stand in the paper's order, Eq. (14).
CASCADE_ORDER = np.array([7, 9, 11, 6, 8, 10, 0, 1, 2, 3, 4, 5])
# How many of them each choice of channels needs.
CHANNELS = {"rates": 3, "attitude": 6, "all": 12}

PARAMETER_NAMES = tuple(f"alpha{i}" for i in range(1, 9))
# How far from alpha a bracket reaches for the OS4: our choice, 45 % of alpha3, alpha6 and alpha8.
DEFAULT_HALF_WIDTH = np.array([0.35, 0.05, 60.0, 0.35, 0.05, 60.0, 0.2, 35.0])


def unstack(values: Float[Array, " states"]) -> State:
    """A `State` from its first 3, 6 or 12 leaves in cascade order."""
    v = tuple(values)
    return State(
        Rates(*v[:3]), Attitude(*v[3:6]) if len(v) > 3 else None, Translation(*v[6:12]) if len(v) > 6 else None
    )


def stack(state: State) -> Float[Array, "*batch states"]:
    """The leaves of a `State` as one array, in cascade order along the last axis."""
    return jnp.stack(jax.tree.leaves(state), axis=-1)


class AbstractModel(eqx.Module):
    """A quadrotor whose unknown parameters stand in its rate equations."""

    airframe: eqx.AbstractVar[Airframe]

    @property
    @abc.abstractmethod
    def alpha(self) -> Parameters:
        """The parameters that the airframe's constants imply."""

    @property
    @abc.abstractmethod
    def gyroscopic_factor(self) -> Scalar:
        """What multiplies J_R above Ix and Iy in alpha2 and alpha5."""

    @property
    def is_linear(self) -> bool:
        """Whether the rate equations are linear in the parameters, as regression needs them."""
        return True

    @property
    def driving(self) -> tuple[int, ...]:
        """Which parameters the forcing depends on. On none for an OS4: its forcing is prepared once for all shots."""
        return ()

    @property
    def force_axes(self) -> tuple[int, ...]:
        """Which axes of the measured specific force the model predicts."""
        return ()

    @property
    def observes_states(self) -> bool:
        """Whether what is measured are the states themselves, with nothing added, and no specific force."""
        return True

    @property
    @abc.abstractmethod
    def parameter_units(self) -> tuple[str, ...]:
        """The unit of each parameter."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The name of each parameter."""
        return PARAMETER_NAMES

    @property
    def half_width(self) -> Parameters:
        """Half the width of a bracket for each parameter: `DEFAULT_HALF_WIDTH`, scaled to the airframe's inertia."""
        os4, own = (alpha_from_inertia(airframe.inertia, jnp.zeros(())) for airframe in (OS4, self.airframe))
        inverse_inertia = jnp.zeros(8, dtype=bool).at[jnp.array([2, 5, 7])].set(True)
        return jnp.asarray(DEFAULT_HALF_WIDTH) * jnp.where(
            inverse_inertia, own / jnp.where(inverse_inertia, os4, 1.0), 1.0
        )

    def forcing(self, omega: RotorSpeeds) -> Forcing:
        """What rotor speeds `omega` [rad/s] do, row by row: Eqs. (10)-(13) and Omega_r = sum s_i omega_i."""
        roll, pitch, yaw, thrust = (jnp.square(omega) @ self.airframe.mixer.T).T
        return Forcing(roll, pitch, yaw, thrust / self.airframe.mass, omega @ jnp.asarray(self.airframe.rotor_spins))

    def drive(self, inputs: Inputs, parameters) -> Forcing:
        """The forcing of a whole flight, a row from each sample to the next, with `parameters`."""
        del parameters
        return self.forcing(inputs.omega)

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """What sensors without noise show: the states in cascade order, then specific force along `force_axes`."""
        del forcing, parameters
        return tuple(jax.tree.leaves(state))

    @abc.abstractmethod
    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """p', q', r' [rad/s^2]: the only equations that hold the parameters (an array, or a tuple of its scalars)."""

    @abc.abstractmethod
    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """x'', y'', z'' [m/s^2]."""

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """The time derivative of as much of the cascade as `state` holds."""
        rates = self.angular_acceleration(state.rates, forcing, parameters)
        attitude = translation = None
        if state.attitude is not None:
            attitude = attitude_rates(state.rates, state.attitude)
        if state.attitude is not None and state.translation is not None:
            ax, ay, az = self.acceleration(state.attitude, forcing)
            t = state.translation
            translation = Translation(t.vx, ax, t.vy, ay, t.vz, az)
        return State(rates, attitude, translation)

    def derivative(self, state: StateVector, omega: Float[Array, "4"], parameters: Parameters) -> StateVector:
        """dX/dt of the whole state, in the paper's order, Eq. (14).

        **Arguments:**

        - `state`: X in the order of `jaxos4.STATE_NAMES`, SI units.
        - `omega`: rotor speeds [rad/s].
        - `parameters`: as named in `parameter_names`.
        """
        one = self.drive(Inputs(omega[None], jnp.ones(())), parameters)
        forcing = jax.tree.map(lambda leaf: leaf[0], one)
        derivative = stack(self.cascade(unstack(state[CASCADE_ORDER]), forcing, parameters))
        return jnp.zeros_like(derivative).at[CASCADE_ORDER].set(derivative)


def attitude_rates(rates: Rates, attitude: Attitude) -> Attitude:
    """phi', theta', psi' [rad/s] from body rates; Eqs. (4)-(6). Singular at theta = +-90 degrees."""
    sin_phi, cos_phi = sincos(attitude.phi)
    sin_theta, cos_theta = sincos(attitude.theta)
    yaw = (rates.q * sin_phi + rates.r * cos_phi) / cos_theta
    return Attitude(rates.p + sin_theta * yaw, rates.q * cos_phi - rates.r * sin_phi, yaw)


class PublishedOS4(AbstractModel):
    """The model as the paper prints it, Eqs. (1)-(13), to the letter.

    It departs from rigid-body physics, and is kept as the benchmark it is: the gyroscopic terms lack the rotor speed
    (alpha2 = J_R d / Ix multiplies q alone, in 1/s), Eq. (2) has alpha5 r where physics has alpha5 p, Eqs. (7)-(9)
    mix two earth frames. See `CorrectedOS4`.
    """

    airframe: Airframe = OS4

    @property
    def alpha(self) -> Float[Array, "8"]:
        """alpha_1..8 as defined below Eq. (13)."""
        return alpha_from_inertia(self.airframe.inertia, self.airframe.rotor_inertia * self.gyroscopic_factor)

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The drag coefficient, as the paper prints alpha2 = J_R d / Ix."""
        return jnp.asarray(self.airframe.drag_coefficient)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units; alpha2 and alpha5 have the unit that Eqs. (1)-(2) need."""
        return ("1", "1/s", "1/(kg m^2)", "1", "1/s", "1/(kg m^2)", "1", "1/(kg m^2)")

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """Eqs. (1)-(3)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * q + a3 * forcing.roll,
            p * r * a4 + r * a5 + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """Eqs. (7)-(9)."""
        sin_phi, cos_phi = sincos(attitude.phi)
        sin_theta, cos_theta = sincos(attitude.theta)
        sin_psi, cos_psi = sincos(attitude.psi)
        return (
            (sin_phi * cos_psi - sin_psi * sin_theta * cos_phi) * forcing.thrust,
            (-sin_psi * sin_phi - sin_theta * cos_phi * cos_psi) * forcing.thrust,
            cos_theta * cos_phi * forcing.thrust - self.airframe.gravity,
        )


class CorrectedOS4(AbstractModel):
    """The published model with its departures from rigid-body physics mended: x forward, y left, z up.

    alpha2 = J_R / Ix and alpha5 = J_R / Iy are dimensionless and multiply Omega_r q and Omega_r p, so that a flight
    can tell them. The reaction of accelerating rotors, -J_R Omega_r' in yaw, is left out.
    """

    airframe: Airframe = OS4

    @property
    def alpha(self) -> Float[Array, "8"]:
        """alpha_1..8 with J_R in the place of J_R d."""
        return alpha_from_inertia(self.airframe.inertia, self.airframe.rotor_inertia * self.gyroscopic_factor)

    @property
    def gyroscopic_factor(self) -> Scalar:
        """1: alpha2 = J_R / Ix."""
        return jnp.asarray(1.0)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of alpha_1..8."""
        return ("1", "1", "1/(kg m^2)", "1", "1", "1/(kg m^2)", "1", "1/(kg m^2)")

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """Euler's equations with the gyroscopic torque -omega x (0, 0, J_R Omega_r)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * forcing.residual_speed * q + a3 * forcing.roll,
            p * r * a4 + a5 * forcing.residual_speed * p + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """Thrust along the body's z axis, turned into the earth frame, and gravity."""
        sin_phi, cos_phi = sincos(attitude.phi)
        sin_theta, cos_theta = sincos(attitude.theta)
        sin_psi, cos_psi = sincos(attitude.psi)
        return (
            (cos_psi * sin_theta * cos_phi + sin_psi * sin_phi) * forcing.thrust,
            (sin_psi * sin_theta * cos_phi - cos_psi * sin_phi) * forcing.thrust,
            cos_theta * cos_phi * forcing.thrust - self.airframe.gravity,
        )


class InertialOS4(AbstractModel):
    """A model's equations with Ix, Iy, Iz and J_R as the parameters, in place of the eight alphas.

    A rigid body has no other alphas than those: four constants that are estimated know more than eight.

    **Arguments:**

    - `model`: `PublishedOS4` or `CorrectedOS4`; its alphas follow from the constants by the definitions below Eq. (13).
    """

    model: AbstractModel

    def __init__(self, model: AbstractModel):
        if not model.is_linear or len(model.parameter_names) != len(PARAMETER_NAMES):
            raise ValueError("`model` must be one in alpha_1..8: PublishedOS4 or CorrectedOS4.")
        self.model = model

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The inner model's."""
        return self.model.airframe

    @property
    def alpha(self) -> Float[Array, "4"]:
        """Ix, Iy, Iz, J_R of the airframe [kg m^2]."""
        return jnp.append(jnp.asarray(self.airframe.inertia), jnp.asarray(self.airframe.rotor_inertia))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Ix, Iy, Iz, J_R."""
        return ("Ix", "Iy", "Iz", "J_R")

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """All in kg m^2."""
        return ("kg m^2",) * 4

    @property
    def half_width(self) -> Float[Array, "4"]:
        """30 % of each inertia. Of J_R as much as the inner bracket leaves to alpha2: more than itself if need be."""
        ix = jnp.asarray(self.airframe.inertia)[0]
        return jnp.append(
            0.3 * jnp.asarray(self.airframe.inertia), self.model.half_width[1] * ix / self.model.gyroscopic_factor
        )

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The inner model's."""
        return self.model.gyroscopic_factor

    @property
    def is_linear(self) -> bool:
        """No: the alphas are ratios of the constants."""
        return False

    def alphas(self, parameters) -> tuple[Scalar, ...]:
        """alpha_1..8 that the constants imply."""
        ix, iy, iz, rotor = parameters
        return alpha_scalars(ix, iy, iz, rotor * self.gyroscopic_factor)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The inner model's, of the alphas."""
        return self.model.angular_acceleration(rates, forcing, self.alphas(parameters))

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """The inner model's."""
        return self.model.acceleration(attitude, forcing)


MODELS = {"published": PublishedOS4, "corrected": CorrectedOS4}
