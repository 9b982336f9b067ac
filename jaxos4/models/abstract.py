"""The interface of a quadrotor model, and the base class of the two OS4 models."""

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Numeric, Parameters, Scalar, StateVector
from ..airframe import Airframe
from ..flight import Inputs
from .state import CASCADE_ORDER, Forcing, Rates, State, stack, unstack

PARAMETER_NAMES = tuple(f"alpha{i}" for i in range(1, 9))

# Half the width of a bracket around alpha_1..8 of the OS4: our choice, 45 % of alpha3, alpha6 and alpha8.
DEFAULT_HALF_WIDTH = np.array([0.35, 0.05, 60.0, 0.35, 0.05, 60.0, 0.2, 35.0])

Contradiction = Callable[[float, float], tuple[str, str] | None]
OfAirframe = float | Callable[[Airframe], Scalar]
"""A number, or a function of the airframe that gives one."""


class Parameter(NamedTuple):
    """One unknown of a model.

    - `half_width`, `center`: of the default bracket of a term's parameter.
    - `each_recording`: whether each recording has a separate value. If not, the vehicle has one value.
    - `force_axis`: if given, the parameter exists only in models that predict the specific force along this axis.
    - `in_forcing`: whether the forcing depends on it; set by the model. Rate equations are linear in every
      other parameter.
    - `nonnegative`: whether physics forbids a negative value.
    - `scales_torque`: whether the true torque is the airframe's times this parameter.
    - `nominal`: the usual value, at which the parameter is fixed unless the flights clearly contradict it.
    - `contradiction`: a function of a value and its error. It returns cause and remedy if physics or the airframe
      forbids the value, otherwise `None`.
    """

    name: str
    unit: str
    half_width: OfAirframe = 0.0
    center: OfAirframe = 0.0
    each_recording: bool = False
    force_axis: int | None = None
    in_forcing: bool = False
    nonnegative: bool = False
    scales_torque: bool = False
    nominal: float | None = None
    contradiction: Contradiction | None = None


class ByRecording(NamedTuple):
    """The parameters of each of several recordings.

    - `model`: the model of a single recording, the same for all.
    - `places`: for each recording, the indices of the parameters of `model` among the parameters of all recordings.
    - `number`: the recording of each sample, counted from 0 in order.
    """

    model: "AbstractModel"
    places: Int[np.ndarray, "recordings parameters"]
    number: Int[Numeric, " samples"]


class AbstractModel(eqx.Module):
    """A quadrotor: a table of unknown parameters, a forcing, equations of motion and sensors.

    Methods take the values of the unknowns as `parameters`: an array, or a tuple of its scalars.
    """

    airframe: eqx.AbstractVar[Airframe]

    @property
    @abc.abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The table of the unknown parameters, in the order of all arrays of parameters."""

    @property
    @abc.abstractmethod
    def alpha(self) -> Parameters:
        """The parameters that follow from the airframe's constants: the centre of the default bracket."""

    @property
    @abc.abstractmethod
    def half_width(self) -> Parameters:
        """Half the width of the default bracket of each parameter."""

    @property
    @abc.abstractmethod
    def gyroscopic_factor(self) -> Scalar:
        """The factor of J_R in alpha2 = factor J_R / Ix and alpha5 = factor J_R / Iy."""

    @property
    def force_axes(self) -> tuple[int, ...]:
        """The axes along which the model predicts the measured specific force: 0, 1, 2 for x, y, z. Default: none."""
        return ()

    @property
    def observes_states(self) -> bool:
        """Whether the sensors show the states alone: no bias, no specific force. Default: they do."""
        return True

    @abc.abstractmethod
    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The forcing of a whole flight. Row k acts from sample k to sample k + 1."""

    def centered_forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The forcing of a whole flight whose samples may be centred on their measurements, see `Forcing.early`.

        By default, samples begin with their measurements.
        """
        return self.forcing(inputs, parameters)

    @abc.abstractmethod
    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """p', q', r' [rad/s^2]: the rate equations at one sample."""

    @abc.abstractmethod
    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """The time derivative of the part of the cascade that `state` holds."""

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """The output of noise-free sensors: the states in cascade order, then the specific force along `force_axes`."""
        del forcing, parameters
        return tuple(jax.tree.leaves(state))

    def by_recording(self, stretch: Int[Numeric, " samples"] | None) -> ByRecording | None:
        """The model of one recording, if several in order have separate parameters. `stretch`: see `Flight`.

        `None`, the default: no recording has a parameter of its own.
        """
        del stretch
        return None

    @property
    def quantities(self) -> dict[str, list[str]]:
        """The physical quantities besides moments of inertia, with the names of their parameters. Default: none."""
        return {}

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The name of each parameter."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """The unit of each parameter."""
        return tuple(parameter.unit for parameter in self.parameters)

    @property
    def forcing_parameters(self) -> tuple[int, ...]:
        """The positions of the parameters on which the forcing depends."""
        return tuple(i for i, parameter in enumerate(self.parameters) if parameter.in_forcing)

    def derivative(self, state: StateVector, omega: Float[Array, "4"], parameters: Parameters) -> StateVector:
        """dX/dt in the paper's order, Eq. (14), in SI units, from the state X, `omega` [rad/s] and the parameters."""
        rows = self.forcing(Inputs(omega[None], jnp.ones(())), parameters)
        forcing = jax.tree.map(lambda leaf: leaf[0], rows)
        derivative = stack(self.cascade(unstack(state[CASCADE_ORDER]), forcing, parameters))
        return jnp.zeros_like(derivative).at[CASCADE_ORDER].set(derivative)
