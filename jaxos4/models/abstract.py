"""What makes a model: rate equations with parameters, on the kinematics that all quadrotors share."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters, RotorSpeeds, Scalar, StateVector
from ..airframe import OS4, Airframe, alpha_from_inertia
from ..flight import Inputs
from ..trigonometry import sincos
from .state import CASCADE_ORDER, Attitude, Forcing, Rates, State, Translation, stack, unstack

PARAMETER_NAMES = tuple(f"alpha{i}" for i in range(1, 9))


# How far from alpha a bracket reaches for the OS4: our choice, 45 % of alpha3, alpha6 and alpha8.
DEFAULT_HALF_WIDTH = np.array([0.35, 0.05, 60.0, 0.35, 0.05, 60.0, 0.2, 35.0])


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
    def forcing_parameters(self) -> tuple[int, ...]:
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

    def rotor_forcing(self, omega: RotorSpeeds) -> Forcing:
        """What rotor speeds `omega` [rad/s] do, row by row: Eqs. (10)-(13) and Omega_r = sum s_i omega_i."""
        roll, pitch, yaw, thrust = (jnp.square(omega) @ self.airframe.mixer.T).T
        return Forcing(roll, pitch, yaw, thrust / self.airframe.mass, omega @ jnp.asarray(self.airframe.rotor_spins))

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The forcing of a whole flight, a row from each sample to the next, with `parameters`."""
        del parameters
        return self.rotor_forcing(inputs.omega)

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
        one = self.forcing(Inputs(omega[None], jnp.ones(())), parameters)
        forcing = jax.tree.map(lambda leaf: leaf[0], one)
        derivative = stack(self.cascade(unstack(state[CASCADE_ORDER]), forcing, parameters))
        return jnp.zeros_like(derivative).at[CASCADE_ORDER].set(derivative)


def attitude_rates(rates: Rates, attitude: Attitude) -> Attitude:
    """phi', theta', psi' [rad/s] from body rates; Eqs. (4)-(6). Singular at theta = +-90 degrees."""
    sin_phi, cos_phi = sincos(attitude.phi)
    sin_theta, cos_theta = sincos(attitude.theta)
    yaw = (rates.q * sin_phi + rates.r * cos_phi) / cos_theta
    return Attitude(rates.p + sin_theta * yaw, rates.q * cos_phi - rates.r * sin_phi, yaw)
