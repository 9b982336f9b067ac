"""A model in other parameters: the base class of the models that wrap a model."""

import abc

import equinox as eqx
import jax.numpy as jnp

from .._custom_types import Scalar
from ..airframe import Airframe
from ..flight import Inputs
from .abstract import AbstractModel
from .state import Forcing, Rates, State


class AbstractReparametrised(AbstractModel):
    """A model whose parameters determine the parameters of an inner model. The equations are the inner model's."""

    model: eqx.AbstractVar[AbstractModel]

    @abc.abstractmethod
    def inner(self, parameters) -> tuple[Scalar, ...]:
        """The parameters of the inner model."""

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The airframe of the inner model."""
        return self.model.airframe

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The factor of the inner model."""
        return self.model.gyroscopic_factor

    @property
    def force_axes(self) -> tuple[int, ...]:
        """The axes of the inner model."""
        return self.model.force_axes

    @property
    def observes_states(self) -> bool:
        """As in the inner model."""
        return self.model.observes_states

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The forcing of the inner model."""
        return self.model.forcing(inputs, jnp.stack(self.inner(tuple(parameters))))

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The rate equations of the inner model."""
        return self.model.angular_acceleration(rates, forcing, self.inner(parameters))

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """The time derivative by the inner model."""
        return self.model.cascade(state, forcing, self.inner(parameters))

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """The sensors of the inner model."""
        return self.model.observe(state, forcing, self.inner(parameters))
