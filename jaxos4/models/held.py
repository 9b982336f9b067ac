"""A model of which some parameters are known: what is left is estimated as ever."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Parameters, RotorSpeeds, Scalar, as_float
from ..airframe import Airframe
from ..flight import Inputs
from .abstract import AbstractModel
from .state import Attitude, Forcing, Rates, State


class HeldParameters(AbstractModel):
    """A model with some of its parameters held at values. Made by `hold`.

    **Arguments:**

    - `model`: the whole model.
    - `held`: which of its parameters.
    - `values`: where they are held.
    """

    model: AbstractModel
    held: tuple[int, ...] = eqx.field(static=True)
    values: Float[Array, " held"]

    def __init__(self, model: AbstractModel, *, held: tuple[int, ...], values: Float[Array, " held"]):
        self.model, self.held, self.values = model, held, as_float(values)

    @property
    def free(self) -> Int[np.ndarray, " free"]:
        """Which of the whole model's parameters are left."""
        return np.delete(np.arange(len(self.model.parameter_names)), list(self.held))

    def without(self, values: Float[Array, " whole"]) -> Float[Array, " free"]:
        """Of one value for each parameter of the whole model, those of the ones that are left."""
        return values[self.free]

    def complete(self, parameters: Float[Array, " free"]) -> Float[Array, " whole"]:
        """The whole model's parameters."""
        whole = jnp.zeros(len(self.model.parameter_names), dtype=float)
        return whole.at[self.free].set(parameters).at[np.asarray(self.held, dtype=int)].set(self.values)

    def _all(self, parameters) -> tuple[Scalar, ...]:
        given = dict(zip(self.free.tolist(), parameters, strict=True))
        given.update(zip(self.held, self.values, strict=True))
        return tuple(given[i] for i in range(len(given)))

    @property
    def airframe(self) -> Airframe:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The whole model's."""
        return self.model.airframe

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The whole model's."""
        return self.model.gyroscopic_factor

    @property
    def is_linear(self) -> bool:
        """As the whole model, or where all that its forcing depends on is held."""
        return self.model.is_linear or (bool(self.model.forcing_parameters) and not self.forcing_parameters)

    @property
    def forcing_parameters(self) -> tuple[int, ...]:
        """The whole model's, of those that are left."""
        return tuple(np.flatnonzero(np.isin(self.free, self.model.forcing_parameters)).tolist())

    @property
    def force_axes(self) -> tuple[int, ...]:
        """The whole model's."""
        return self.model.force_axes

    @property
    def observes_states(self) -> bool:
        """As the whole model."""
        return self.model.observes_states

    @property
    def alpha(self) -> Parameters:
        """The whole model's, of those that are left."""
        return self.without(self.model.alpha)

    @property
    def half_width(self) -> Parameters:
        """The whole model's, of those that are left."""
        return self.without(self.model.half_width)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The whole model's, of those that are left."""
        return tuple(self.model.parameter_names[i] for i in self.free)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """The whole model's, of those that are left."""
        return tuple(self.model.parameter_units[i] for i in self.free)

    def rotor_forcing(self, omega: RotorSpeeds) -> Forcing:
        """The whole model's."""
        return self.model.rotor_forcing(omega)

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """The whole model's, with the values in their places."""
        return self.model.forcing(inputs, self.complete(jnp.stack(list(parameters))))

    def observe(self, state: State, forcing: Forcing, parameters) -> tuple[Scalar, ...]:
        """The whole model's, with the values in their places."""
        return self.model.observe(state, forcing, self._all(parameters))

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """The whole model's, with the values in their places."""
        return self.model.cascade(state, forcing, self._all(parameters))

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """The whole model's, with the values in their places."""
        return self.model.angular_acceleration(rates, forcing, self._all(parameters))

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """The whole model's."""
        return self.model.acceleration(attitude, forcing)


def hold(model: AbstractModel, values: Mapping[str, Float[Array, ""] | float]) -> HeldParameters:
    """`model` with the parameters named in `values` known: `hold(FlightModel(airframe), {"rotor_lag": 0.06})`.

    **Raises:** `ValueError` for a name that the model does not have, or where no parameter is left.
    """
    names = model.parameter_names
    unknown = [name for name in values if name not in names]
    if unknown or len(values) == len(names):
        wrong = f"knows no {unknown[0]}" if unknown else "leaves no parameter to estimate"
        raise ValueError(f"`values` {wrong}; the parameters are {', '.join(names)}.")
    held = tuple(i for i, name in enumerate(names) if name in values)
    known = [as_float(values[names[i]]) for i in held]
    return HeldParameters(model, held=held, values=jnp.stack(known) if known else jnp.zeros(0))
