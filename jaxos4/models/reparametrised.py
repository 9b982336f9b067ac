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
        """See `AbstractModel`."""
        return self.model.airframe

    @property
    def gyroscopic_factor(self) -> Scalar:
        """See `AbstractModel`."""
        return self.model.gyroscopic_factor

    @property
    def force_axes(self) -> tuple[int, ...]:
        """See `AbstractModel`."""
        return self.model.force_axes

    @property
    def observes_states(self) -> bool:
        """See `AbstractModel`."""
        return self.model.observes_states

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """See `AbstractModel`."""
        return self.model.forcing(inputs, jnp.stack(self.inner(tuple(parameters))))

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """See `AbstractModel`."""
        return self.model.angular_acceleration(rates, forcing, self.inner(parameters))

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """See `AbstractModel`."""
        return self.model.cascade(state, forcing, self.inner(parameters))

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """See `AbstractModel`."""
        return self.model.observe(state, forcing, self.inner(parameters))
